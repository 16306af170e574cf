"""A student: what it takes over from its teacher, what it learns, what it costs."""

from __future__ import annotations

import json
import time
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from btfkit import metrics
from btfkit.btf import BTF
from btfkit.cli import btfkit
from btfkit.cli.outcome import run
from btfkit.errors import FitError
from btfkit.fitting.fit import fit
from btfkit.fitting.loop import Generators
from btfkit.fitting.student.lessons import Lessons, Pairs, queries_of
from btfkit.fitting.student.trainable import Student
from btfkit.materials.base import Header, Material
from btfkit.materials.file import save
from btfkit.materials.lambert import Lambert, LambertSpec
from btfkit.materials.neumip.material import NeuMIP
from btfkit.materials.neumip.spec import NeuMIPSpec
from btfkit.native import neural
from btfkit.relief.synth import synth_btf
from btfkit.settings import as_text

SIZE = 16


@cache
def flat() -> Material:
    """A teacher that is flat: rows of grey from dark to bright."""
    texture = np.linspace(0.1, 0.9, SIZE * SIZE * 3, dtype=np.float32).reshape(SIZE, SIZE, 3)
    header = Header((SIZE, SIZE), licence="CC0-1.0", texel_mm=0.5)
    return Lambert(LambertSpec((SIZE, SIZE)), {"texture": texture}, header)


@cache
def rough(seed: int = 0) -> Material:
    """A teacher of the kind that a student takes over: random numbers, half a texel deep."""
    spec = NeuMIPSpec(
        (SIZE, SIZE), levels=3, features=8, heights=True, frames=2, hidden=(28,) * 3,
        activation="leaky", directions=("lx", "ly", "lz", "vx", "vy", "vz"), precision="float16",
    )  # fmt: skip
    header, rng = Header((SIZE, SIZE)), np.random.default_rng(seed)
    weights = {
        name: (rng.normal(0, 0.3 if "texture" in name else 1 / np.sqrt(shape[-1]), shape))
        .astype(np.float16 if name.startswith("texture") else np.float32)
        for name, shape in NeuMIP.shapes(spec, header).items()
    }  # fmt: skip
    return NeuMIP(spec, weights, header)


@cache
def cobbles() -> BTF:
    return synth_btf("cobbles", size=32, lights="13", views="13", samples=4)


def begun(teacher: Material, **settings: object) -> Student:
    source = queries_of(teacher, seed=0)
    rows = np.arange(len(source))
    return Student(
        source, rows[100:], rows[:100], settings=as_text(settings), generators=Generators(0),
        teacher=teacher,
    )  # fmt: skip


def test_a_student_begins_with_its_teachers_relief_and_features() -> None:
    teacher, student = rough(), begun(rough()).material()
    for level in range(3):
        name = f"texture.0.{level}"
        np.testing.assert_array_equal(student.weights[name], teacher.weights[name])
    heights = teacher.weights["texture.heights"][..., 0]
    np.testing.assert_array_equal(student.weights["texture.offset"][..., 0], heights)
    across = np.gradient(heights.astype(np.float32), axis=1)
    ratio = student.weights["texture.offset"][..., 1].astype(np.float32) / across
    # One factor for all, in float16.
    np.testing.assert_allclose(ratio, np.median(ratio), rtol=5e-3)
    assert student.spec.hidden == (16, 16)
    assert (student.spec.features, student.spec.frames) == (8, 2)
    # At first a ray is as deep as the teacher's relief is high where it enters.
    v, u = np.mgrid[:SIZE, :SIZE] + 0.5
    uv = np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float32) / SIZE
    depth = student.depths(uv, np.float32([[0, 0, 1]] * len(uv)))
    reach = heights.reshape(-1) * teacher.spec.depth_scale
    assert np.corrcoef(depth, reach)[0, 1] > 0.95


def test_a_teacher_of_another_kind_gives_its_answers_alone() -> None:
    student = begun(flat())
    assert not student._taken
    assert student.material().header == flat().header
    assert student.spec.levels == 1


def test_lessons_are_those_of_their_step_and_lie_where_the_data_do() -> None:
    pair = np.float32([[0, 0.6, 0.8]]), np.float32([[0.6, 0, 0.8]])
    lessons = Lessons(rough(), levels=3, seed=4, pairs=Pairs(*pair))
    first, again, next_ = lessons.batch(3, 400), lessons.batch(3, 400), lessons.batch(4, 400)
    np.testing.assert_array_equal(first.target, again.target)
    assert not np.array_equal(first.uv, next_.uv)
    # Three of four lie within four deviations of 0.05 of the pair.
    near = np.linalg.norm(first.light - pair[0], axis=1) < 0.3
    assert 300 <= near.sum() < 340
    blurred = first.footprint > 0.5
    assert 120 < blurred.sum() < 280
    assert first.footprint.max() <= 2
    wanted = rough().evaluate(first.uv, first.light, first.view, first.footprint).reflectance
    np.testing.assert_array_equal(first.target, wanted)


def test_who_teaches_whom_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(
        ValueError, match="neumip learns from data alone; from a model does: student"
    ):
        fit(cobbles(), model="neumip", teacher=flat(), steps=1)
    with pytest.raises(ValueError, match="neither data nor a teacher is named"):
        fit(None, model="student", steps=1)
    with pytest.raises(FitError, match=r"grid \(16, 16\).*the data \(32, 32\).*or none"):
        fit(cobbles(), model="student", teacher=flat(), steps=1)
    with pytest.raises(ValueError, match="depth_width = 1; expected 2 to 128"):
        fit(None, model="student", teacher=flat(), steps=1, settings={"depth_width": 1})
    path = tmp_path / "flat.lambert.safetensors"
    save(flat(), path)
    call = ["fit", "--model", "student", "--from", str(path), "--steps", "2", "--no-preview"]
    assert run(btfkit, [*call, "--cluster", "local:1"]) == 1
    assert "leave out one" in capsys.readouterr().err


def test_the_verb_names_a_student_after_its_teacher(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    save(flat(), tmp_path / "flat.lambert.safetensors")
    call = ["fit", "--model", "student", "--from", "flat.lambert.safetensors", "--json", "--quiet"]
    assert run(btfkit, [*call, "--steps", "60", "--set", "batch=512", "--no-preview"]) == 0
    said = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert said["out"] == "flat.student.safetensors"
    report = json.loads((tmp_path / "flat.student.report.json").read_text())
    assert report["psnr"] > 15
    from btfkit.materials.file import load

    header = load("flat.student.safetensors").header
    assert header.licence == "CC0-1.0"
    assert header.provenance["teacher"]["model"] == "lambert"


@pytest.mark.slow
@pytest.mark.skipif(not neural.available(), reason="the kernel was not built")
def test_a_student_is_near_its_teacher_at_half_its_time() -> None:
    btf = cobbles()
    settings = {"levels": "1", "batch": "4096"}
    teacher = fit(btf, model="neumip", steps=1200, settings=settings)
    student = fit(btf, model="student", teacher=teacher.material, steps=900, settings=settings)
    assert student.errors["psnr"] > teacher.errors["psnr"] - 1.5
    rng = np.random.default_rng(0)
    way = rng.normal(size=(2, 60000, 3))
    way[..., 2] = np.abs(way[..., 2]) + 0.2
    uv = rng.random((60000, 2))
    spent = {}
    for name, material in (("teacher", teacher.material), ("student", student.material)):
        times = []
        for _ in range(9):
            start = time.process_time()
            material.evaluate(uv, *way)
            times.append(time.process_time() - start)
        spent[name] = min(times)
    # Asked is half; preparing a query costs both the same, and neighbours disturb the clock.
    assert spent["student"] < 0.65 * spent["teacher"]
    answers = [m.material.evaluate(uv, *way).reflectance for m in (teacher, student)]
    assert metrics.psnr(float(np.square(answers[0] - answers[1]).mean())) > 25
