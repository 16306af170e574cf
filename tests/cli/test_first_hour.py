"""What a newcomer meets in the first hour: fits, budgets, interruptions, full disks, budgets."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import btfkit
from btfkit import directions
from btfkit.btf import BTF
from btfkit.cli import btfkit as command
from btfkit.cli.outcome import run
from btfkit.fitting.fit import fit
from btfkit.fitting.neubtf import trainable as neubtf
from btfkit.heldout import fingerprint, held_out
from btfkit.io import queryfile
from btfkit.io.store import writer
from btfkit.materials import evaluation, file
from btfkit.queries import QuerySet
from btfkit.relief import procedural
from btfkit.textures import Textures

QUICK = ("--set", "batch=256")


def sample(pairs: int = 40, size: int = 16) -> BTF:
    """A glossy, structured sample, clamped: pairs x size x size."""
    rng = np.random.default_rng(0)
    light, view = (
        directions.normalize(rng.normal(size=(pairs, 3)) * [1, 1, 0.3] + [0, 0, 1.2])
        for _ in range(2)
    )
    light, view = np.abs(light), np.abs(view)
    albedo = 0.2 + 0.6 * rng.random((size, size, 3))
    half = directions.normalize(light + view)
    lobe = half[:, 2, None, None, None] ** 40
    textures = (albedo + lobe) * light[:, 2, None, None, None]
    return BTF(textures.astype(np.float32), light.astype("f4"), view.astype("f4"))


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of one's own with one store, and in it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("BTFKIT_THREADS", "1")
    writer.write(sample(), tmp_path / "wool.btf.zarr")
    return tmp_path


def typed(capsys: pytest.CaptureFixture[str], *arguments: object, code: int = 0) -> dict[str, Any]:
    """The JSON answer of a command line."""
    assert run(command, [*map(str, arguments), "--json"]) == code
    answer: dict[str, Any] = json.loads(capsys.readouterr().out.splitlines()[-1])
    return answer


# --- what eval compares


@pytest.mark.slow
def test_eval_takes_what_the_fit_held_out(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = typed(capsys, "fit", "--model", "interpolation", "--holdout", 0.2, "--seed", 3)
    train, test = btfkit.split(40, 0.2, 3)
    assert report["held_out"] == test.tolist()
    assert sorted([*train, *test]) == list(range(40))
    model = "wool.interpolation.safetensors"
    held = typed(capsys, "eval", model, "wool.btf.zarr")
    assert held["which"] == "held out: 8 of 40"
    assert (held["pairs"], held["held_out"]) == (8, test.tolist())
    assert held["psnr"] == pytest.approx(report["psnr"])
    everything = typed(capsys, "eval", model, "wool.btf.zarr", "--all")
    assert everything["which"] == "all 40, 32 of them trained on"
    # What was trained on is kept as it is: nearly all of the error is on the rest.
    assert everything["mse"] == pytest.approx(held["mse"] * 8 / 40, rel=0.01)


def test_eval_takes_all_of_other_data(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    typed(capsys, "fit", "--model", "lambert")
    other = sample().subset(np.arange(10))
    writer.write(other, here / "other.btf.zarr")
    found = typed(capsys, "eval", "wool.lambert.safetensors", "other.btf.zarr")
    assert (found["pairs"], found["which"]) == (10, "all 10: not the data of the fit")
    assert "held_out" not in found


def test_eval_says_when_pairs_may_have_been_trained_on(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    typed(capsys, "ingest", "wool.btf.zarr", "-o", "whole.btf.zarr")
    typed(capsys, "ingest", "wool.btf.zarr", "-o", "part.btf.zarr", "--lights", "0:20")
    typed(capsys, "fit", "whole.btf.zarr", "--model", "lambert")
    found = typed(capsys, "eval", "whole.lambert.safetensors", "part.btf.zarr")
    assert found["which"] == "all 20: another part of the source of the fit, perhaps trained on"


def test_eval_of_a_fit_that_held_nothing_out_asks_for_all(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    typed(capsys, "fit", "--model", "lambert", "--holdout", 0)
    assert run(command, ["eval", "wool.lambert.safetensors", "wool.btf.zarr"]) == 1
    assert "no error but that of training; --all gives it" in capsys.readouterr().err
    found = typed(capsys, "eval", "wool.lambert.safetensors", "wool.btf.zarr", "--all")
    assert found["pairs"] == 40


def test_eval_of_queries_takes_held_out_rows(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(0)
    up = directions.normalize(rng.normal(size=(200, 3)) * [1, 1, 0] + [0, 0, 1]).astype("f4")
    rows = QuerySet(rng.random((200, 2)), up, up[::-1], rgb=rng.random((200, 3)), size=(4, 4))
    queryfile.write(rows, here / "q.npz")
    typed(capsys, "fit", "q.npz", "--model", "lambert")
    found = typed(capsys, "eval", "q.lambert.safetensors", "q.npz")
    assert (found["rows"], found["which"]) == (10, "held out: 10 of 200")


def test_a_store_is_the_folder_that_it_was_made_of_and_no_other(tmp_path: Path) -> None:
    btf = sample()
    stored = btfkit.open(writer.write(btf, tmp_path / "a.btf.zarr"))
    assert fingerprint(stored) == fingerprint(btf)
    changed = replace(btf, textures=np.stack([btf.texture(i) for i in range(40)]) * 1.01)
    for other in (changed, btf.subset(np.arange(39)), btf.crop(slice(0, 8), slice(0, 16))):
        assert fingerprint(other)["sha256"] != fingerprint(btf)["sha256"]
    material = fit(btf, model="lambert").material
    assert held_out(material.header.provenance, changed) is None
    np.testing.assert_array_equal(held_out(material.header.provenance, stored), btfkit.split(40)[1])


# --- what a budget means


@pytest.mark.slow
def test_a_budget_is_what_one_waits_for(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    start = time.perf_counter()
    report = typed(capsys, "fit", "--model", "neubtf", "--budget", "6s", *QUICK)
    wall = time.perf_counter() - start
    phases = report["phases"]
    assert list(phases) == ["reading", "starting", "training", "writing", "evaluating"]
    after_reading = sum(phases.values()) - phases["reading"]
    # One step, one look or one pair may end late: seconds, and tens of them on a busy machine.
    assert after_reading < 18
    assert phases["training"] > 1
    assert sum(phases.values()) < wall
    # 2 of 40 pairs of 16 x 16 fit into 2 s.
    assert report["pairs"] == report["of_pairs"] == 2


def test_a_budget_is_shared_by_its_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    from btfkit.fitting import phases as parts

    now, told = [50.0], []
    monkeypatch.setattr(parts.time, "perf_counter", lambda: now[0])
    phases = parts.Phases(60.0, lambda name, left: told.append((name, left)))
    for name, seconds in (("reading", 7), ("starting", 4), ("training", 50), ("writing", 1)):
        phases.begin(name)
        if name == "training":
            # A tenth is for the evaluation; reading is not counted.
            assert phases.training_s() == 60 - 4 - 6
        now[0] += seconds
    phases.begin("evaluating")
    assert phases.evaluating_s() == 6
    assert told == [("reading", None), ("starting", 60), ("training", 56), ("writing", 6),
                    ("evaluating", 5)]  # fmt: skip
    assert phases.seconds == {"reading": 7, "starting": 4, "training": 50, "writing": 1}
    assert not phases.late()
    hurried = parts.Phases(4.0, None)
    for name in ("reading", "starting", "training"):
        hurried.begin(name)
        now[0] += 5
    # Whatever starting takes, something is trained; the report says that it ended late.
    assert hurried.training_s() == 1
    assert hurried.late()
    # At least 2 s of a short budget, and none without one.
    assert parts.Phases(5.0, None).evaluating_s() == 2
    assert parts.Phases(None, None).evaluating_s() is None


def test_an_evaluation_ends_in_its_time_and_says_of_how_many_pairs() -> None:
    material, btf = fit(sample(), model="lambert").material, sample()
    few = evaluation.errors_on_btf(material, btf, within_s=1e-9)
    assert (few["pairs"], few["of_pairs"]) == (1, 40)
    told: list[tuple[int, int]] = []
    every = evaluation.errors_on_btf(
        material, btf, within_s=60, progress=lambda done, total: told.append((done, total))
    )
    assert every["pairs"] == 40
    assert told == sorted(told)
    assert told[-1] == (1000, 1000)


def test_large_textures_are_told_by_windows_where_time_is_short(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(evaluation, "_WINDOW", 8)
    btf = sample()
    material = fit(btf, model="lambert").material
    short = evaluation.errors_on_btf(material, btf, within_s=60)
    whole = evaluation.errors_on_btf(material, btf)
    assert (short["window"], short["pairs"]) == ([8, 8], 40)
    assert "window" not in whole
    # A quarter of the texels of each of 40 pairs: the same to a few per cent.
    assert short["mse"] == pytest.approx(whole["mse"], rel=0.1)
    assert short["mse"] != whole["mse"]


@pytest.mark.parametrize(("more", "pairs"), [((), 1), (("--full-report",), 8)])
def test_a_full_report_is_of_all_held_out_pairs(
    more: tuple[str, ...], pairs: int, here: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setattr("btfkit.fitting.phases._LEAST_EVALUATING_S", 1e-9)
    monkeypatch.setattr("btfkit.fitting.phases._EVALUATING", 1e-9)
    arguments = ("fit", "--model", "lambert", "--holdout", 0.2, "--budget", "9s", *more)
    assert run(command, list(map(str, arguments))) == 0
    said = capsys.readouterr().out
    assert ("(1 of 8 pairs)" in said) == (pairs == 1)
    assert json.loads((here / "wool.lambert.report.json").read_text())["pairs"] == pairs


class Counted(Textures):
    """Textures that note how often each is decoded."""

    def __init__(self, btf: BTF) -> None:
        self.shape, self._btf = btf.shape, btf
        self.read: list[int] = []

    def _read(self, index: int) -> np.ndarray:
        self.read.append(index)
        return self._btf.texture(index)


@pytest.mark.parametrize("model", ["auto", "neubtf", "neubtf-paper", "rainer19", "lambert"])
def test_no_texture_is_decoded_twice(model: str) -> None:
    btf = sample()
    counted = Counted(btf)
    settings = {"pairs": 4, "texels": 32} if model in ("neubtf-paper", "rainer19") else {}
    fit(replace(btf, textures=counted), model=model, steps=2, settings=settings)
    assert sorted(counted.read) == list(range(40))


def test_the_bar_names_its_part_and_the_time_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    from btfkit.cli import bar as bars

    now = [100.0]
    monkeypatch.setattr(bars.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(bars.sys.stderr, "isatty", lambda: True, raising=False)
    with bars.Bar("fit", quiet=False) as bar:
        bar.phase("reading")
        now[0] += 12
        bar(1, 2)
        assert bar.clock() == "0:12"
        bar.phase("training", left_s=78)
        assert bar.clock() == "0:12 of 1:30"
        assert bar._drawn is not None
        (task,) = bar._drawn.tasks
        assert (task.description, task.total) == ("fit: training", None)
        bar(3, 1000)
        assert (task := bar._drawn.tasks[0]).completed == 3
        assert task.total == 1000


def test_without_a_terminal_lines_tell_how_far_it_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import time

    from btfkit.cli import bar as bars

    monkeypatch.setattr(bars, "_FIRST_S", 0.02)
    monkeypatch.setattr(bars, "_EVERY_S", 0.02)
    told = {}
    for lines in (False, True):
        with bars.Bar("fit", quiet=False, lines=lines) as bar:
            bar.phase("reading")
            time.sleep(0.2)
            bar(120, 300)
            time.sleep(0.2)
        told[lines] = capsys.readouterr().err.splitlines()
        # Nothing is told when it is over.
        time.sleep(0.05)
        assert capsys.readouterr().err == ""
    assert told[False] == []
    assert told[True][0] == "fit: reading, 0:00"
    assert told[True][-1] == "fit: reading, 120 of 300, 0:00"
    with bars.Bar("fit", quiet=True, lines=True):
        time.sleep(0.05)
    assert capsys.readouterr().err == ""


# --- interruptions


def stopped_after(monkeypatch: pytest.MonkeyPatch, count: int) -> Callable[[], None]:
    """Ctrl-C at a step of a NeuBTF; what is returned takes it back."""
    original, taken = neubtf.NeuBTF.step, [0]

    def step(self: Any, progress: float) -> float:
        if taken[0] == count:
            raise KeyboardInterrupt
        taken[0] += 1
        return original(self, progress)

    monkeypatch.setattr(neubtf.NeuBTF, "step", step)
    return lambda: monkeypatch.setattr(neubtf.NeuBTF, "step", original)


def test_an_interrupted_neubtf_says_what_is_not_trained_and_how_to_go_on(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    go_on = stopped_after(monkeypatch, 6)
    arguments = ["fit", "wool.btf.zarr", "--model", "neubtf", "--steps", "40", *QUICK]
    assert run(command, arguments) == 130
    said = capsys.readouterr().out
    again = "btfkit fit wool.btf.zarr --model neubtf --steps 40 " + " ".join(QUICK) + " --resume"
    assert "6 steps" in said
    assert "; interrupted" in said
    assert "not trained: the encoder: its stage had not begun" in said
    assert "state: wool.neubtf.safetensors.state" in said
    assert f"go on: {again}\n" in said
    report = json.loads((here / "wool.neubtf.report.json").read_text())
    assert report["interrupted"]
    assert report["untrained"][0].startswith("the encoder")
    header = file.header_of(here / "wool.neubtf.safetensors")
    assert "the encoder" in json.dumps(header["provenance"]["untrained"])

    from skimage.io import imsave

    imsave(here / "guidance.png", np.full((24, 24, 3), 128, np.uint8), check_contrast=False)
    assert run(command, ["propagate", "guidance.png"]) == 1
    assert "of a fit that ended early: the encoder: its stage had not" in capsys.readouterr().err

    go_on()
    assert run(command, [*again.split()[1:]]) == 0  # as it was said, without --force
    report = json.loads((here / "wool.neubtf.report.json").read_text())
    assert (report["steps"], report["interrupted"]) == (40, False)
    assert not (here / "wool.neubtf.safetensors.state").exists()
    # So few steps carry nothing: that is said, too, and propagation warns.
    assert "steps of 100 at least; it carries poorly" in report["untrained"][0]
    capsys.readouterr()
    assert run(command, ["propagate", "guidance.png"]) == 0
    assert "it carries poorly" in capsys.readouterr().err


def test_a_state_that_nobody_resumes_is_not_overwritten(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    go_on = stopped_after(monkeypatch, 3)
    arguments = ["fit", "--model", "neubtf", "--steps", "6", *QUICK]
    assert run(command, arguments) == 130
    go_on()
    (here / "wool.neubtf.safetensors").unlink()
    capsys.readouterr()
    assert run(command, arguments) == 1
    assert "of an interrupted fit: --resume (resume=True) goes on" in capsys.readouterr().err
    assert run(command, [*arguments, "--force"]) == 0


def test_an_evaluation_that_is_interrupted_keeps_the_model(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stopped(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("btfkit.fitting.fit.errors_on_btf", stopped)
    assert run(command, ["fit", "--model", "lambert"]) == 0
    assert "not evaluated, because interrupted: btfkit eval does it" in capsys.readouterr().out
    assert btfkit.load(here / "wool.lambert.safetensors").model == "lambert"


# --- what cannot be written


@contextmanager
def as_nobody() -> Iterator[None]:
    """Root may write everywhere: for a moment, somebody who may not."""
    if os.geteuid() != 0:
        yield
        return
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


def never(*_: Any, **__: Any) -> None:
    raise AssertionError("training began")


@pytest.mark.parametrize("model", ["lambert", "neubtf"])
def test_a_missing_folder_is_found_before_training(
    model: str, here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("btfkit.fitting.training.loaded", never)
    assert run(command, ["fit", "--model", model, "-o", "no/where.safetensors"]) == 1
    assert "no is not a folder; create it first" in capsys.readouterr().err


def test_a_folder_that_cannot_be_written_is_found_before_training(tmp_path: Path) -> None:
    from btfkit.files import refuse_existing

    locked = tmp_path / "locked"
    locked.mkdir(mode=0o555)
    # The fixture's folders are for root alone.
    for folder in (tmp_path, *list(tmp_path.parents)[:2]):
        folder.chmod(folder.stat().st_mode | 0o055)
    with as_nobody(), pytest.raises(PermissionError) as caught:
        refuse_existing(locked / "m.safetensors", force=False)
    assert caught.value.filename == str(locked / "m.safetensors")


@pytest.mark.parametrize("model", ["interpolation", "neubtf"])
def test_a_disk_without_room_is_found_before_training(
    model: str, here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    usage = shutil.disk_usage(here)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=1000))
    monkeypatch.setattr(neubtf.NeuBTF, "step", never)
    assert run(command, ["fit", "--model", model, *(QUICK if model == "neubtf" else ())]) == 1
    said = capsys.readouterr().err
    assert "No space left on device" in said
    assert f"wool.{model}.safetensors" in said
    assert list(here.glob("*.safetensors")) == []


def test_what_was_trained_is_kept_elsewhere_where_its_place_fails(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    full = here / "full"
    full.mkdir()
    packed = file._packed

    def crowded(*arguments: Any) -> bytes:
        # The disk fills up while the model is being trained.
        if "full" in sys._getframe(1).f_locals["path"].parts:
            raise OSError(errno.ENOSPC, "No space left on device")
        return packed(*arguments)

    monkeypatch.setattr(file, "_packed", crowded)
    assert run(command, ["fit", "--model", "lambert", "-o", "full/m.safetensors"]) == 1
    said = capsys.readouterr().err
    assert "full/m.safetensors: No space left on device; what was trained is kept as" in said
    (kept,) = here.glob("m.*.safetensors")
    assert str(kept) in said
    assert btfkit.load(kept).model == "lambert"


def test_a_full_disk_names_the_file_that_was_to_be_written(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("zarr.Array.__setitem__", full)
    assert run(command, ["ingest", "wool.btf.zarr", "-o", "b.btf.zarr"]) == 1
    said = capsys.readouterr().err
    assert "b.btf.zarr" in said
    assert "No space left on device" in said


def test_a_state_that_cannot_be_written_costs_no_training(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("btfkit.fitting.loop.save_state", full)
    monkeypatch.setattr("btfkit.fitting.loop._SAVE_EVERY_S", 0)
    assert run(command, ["fit", "--model", "neubtf", "--steps", "3", *QUICK]) == 0
    assert "no --resume from here" in capsys.readouterr().err
    assert (here / "wool.neubtf.safetensors").is_file()


# --- the same from Python


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"budget_s": -1}, "budget_s = -1; expected seconds above 0"),
        ({"budget_s": float("nan")}, "budget_s = nan; expected seconds above 0"),
        ({"steps": -5}, "steps = -5; expected 0 or more"),
        ({"holdout": 1.0}, "holdout = 1.0; expected 0 up to"),
        ({"device": "gpu"}, r"no device 'gpu'.*; there are auto, cpu, cuda"),
        ({"model": "neumop"}, r"no model 'neumop' \(did you mean neumip\?\); there are auto, "),
        ({"settings": {"bach": 3}, "model": "neubtf", "steps": 1}, "did you mean batch"),
    ],
)
def test_python_checks_what_the_command_line_checks(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        btfkit.fit(sample(), **options)


def test_most_of_the_pairs_may_be_held_out() -> None:
    assert len(btfkit.fit(sample(), model="lambert", holdout=0.9).held_out) == 36


def test_settings_may_be_numbers_in_python() -> None:
    report = btfkit.fit(sample(), model="pca", settings={"rank": 3})
    assert report.settings == {"rank": "3"}
    assert report.material.spec.ranks == (3,)


@pytest.mark.parametrize("given", [None, "ACTIVE"])
def test_threads_sleep_at_barriers_from_python_too(given: str | None) -> None:
    environment = {k: v for k, v in os.environ.items() if k != "OMP_WAIT_POLICY"}
    environment |= {"OMP_WAIT_POLICY": given} if given else {}
    code = "import os, btfkit; print(os.environ['OMP_WAIT_POLICY'])"
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == (given or "PASSIVE")


@pytest.mark.parametrize("given", [None, "3"])
def test_the_command_leaves_numpy_one_thread_unless_told(given: str | None) -> None:
    environment = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
    environment |= {"OPENBLAS_NUM_THREADS": given} if given else {}
    code = (
        "import os, sys, btfkit.cli; assert 'numpy' not in sys.modules; "
        "print(os.environ['OPENBLAS_NUM_THREADS'])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == (given or "1")


def test_reports_and_materials_say_themselves_in_a_line() -> None:
    report = btfkit.fit(sample(), model="lambert")
    for value in (report, report.material, sample()):
        assert len(repr(value)) < 300
    assert "40 textures of 16 x 16, 3 channels" in repr(sample())
    up = np.tile(np.float32([0, 0, 1]), (5, 1))
    rows = QuerySet(np.full((5, 2), 0.5), up, up, rgb=up)
    assert repr(rows) == "QuerySet(5 queries, with rgb)"
    assert repr(procedural.make("print", 8)).startswith("Relief(8 x 8 texels, wrap, heights ")
    assert "Lambert(16 x 16" in repr(report.material)


@pytest.mark.parametrize("model", ["lambert", "interpolation", "pca", "rainer19"])
def test_every_model_counts_what_is_not_measured(model: str) -> None:
    btf = sample()
    textures = np.stack([btf.texture(i) for i in range(40)])
    textures[:, 2, 3:5] = np.nan
    settings = {"pairs": 4, "texels": 32} if model == "rainer19" else {}
    broken = replace(btf, textures=textures)
    report = btfkit.fit(broken, model=model, steps=2, settings=settings)
    assert report.masked_texels == 2 * (40 - 2)  # of the pairs that are trained on


@pytest.mark.parametrize(("dark", "exact"), [(2, 20), (1, 40)])
def test_pairs_that_are_exact_are_counted_and_leave_no_infinite_mean(
    dark: int, exact: int, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    textures = np.stack([sample().texture(i) for i in range(40)])
    textures[::dark] = 0
    btf = replace(sample(), textures=textures)
    writer.write(btf, here / "dark.btf.zarr")
    # A model that is black under every light is exact where it is dark.
    black = replace(btf, textures=np.zeros_like(textures))
    file.save(fit(black, model="lambert").material, here / "black.safetensors")
    found = typed(capsys, "eval", "black.safetensors", "dark.btf.zarr", "--all")
    assert found["exact_pairs"] == exact
    assert (found["mean_psnr"] is None) == (exact == 40)


@pytest.mark.slow
def test_ctrl_c_ends_a_fit_with_what_it_has(here: Path) -> None:
    """The real signal, in a process of its own."""
    code = textwrap.dedent(
        """
        import signal, sys
        signal.signal(signal.SIGINT, signal.default_int_handler)
        from btfkit.fitting import loop
        step = loop.Run.progress
        from btfkit.fitting.neubtf.trainable import NeuBTF
        original, told = NeuBTF.step, []
        def stepped(self, progress):
            if len(told) == 3: print("three", flush=True)
            told.append(progress)
            return original(self, progress)
        NeuBTF.step = stepped
        from btfkit.cli import main
        sys.argv = "btfkit fit wool.btf.zarr --model neubtf --budget 60s".split()
        main()
        """
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"three\n"
        process.send_signal(signal.SIGINT)
        said = process.stdout.read().decode()
        assert process.wait(60) == 130
    assert "go on: btfkit fit wool.btf.zarr --model neubtf --budget 60s --resume" in said
    assert (here / "wool.neubtf.safetensors").is_file()
    assert (here / "wool.neubtf.safetensors.state").is_file()


# --- tile


def dotted() -> np.ndarray:
    """(128, 128, 3) codes: dark dots on pure white, thicker towards one end."""
    rows, cols = np.indices((128, 128))
    rng = np.random.default_rng(1)
    image = np.full((128, 128, 3), 255, np.uint8)
    for y, x in rng.integers(0, 128, (30, 2)):
        image[(rows - y) ** 2 + (cols - x) ** 2 < 4 + y / 4] = (40, 80, 160)
    return image


def drawn(path: Path, image: np.ndarray) -> None:
    from skimage.io import imsave

    imsave(path, image, check_contrast=False)


def test_white_paper_stays_white_when_it_is_tiled(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from skimage.io import imread

    drawn(here / "dots.png", dotted())
    assert run(command, ["tile", "dots.png"]) == 0
    said = capsys.readouterr().out
    assert "taken away (--no-drift leaves it)" in said
    assert run(command, ["tile", "dots.png", "--no-drift", "-o", "plain.png"]) == 0
    assert "taken away" not in capsys.readouterr().out
    bent, plain = imread(here / "dots.tile.png"), imread(here / "plain.png")
    # Equal maps: what the plain tile takes from white paper is white in the bent one.
    white = plain == 255
    assert white.mean() > 0.5
    assert (bent[white] == 255).all()
    assert (bent != plain).any()
    # Without the correction every texel is one of the picture.
    assert set(np.unique(plain)) <= set(np.unique(dotted()))


def test_both_ends_of_a_range_stay_and_what_lies_between_keeps_its_order() -> None:
    from btfkit.synthesis.textures import within

    values = np.linspace(0, 1, 1001, dtype=np.float32)
    for gain in (0.5, 0.84, 1.0, 1.2, 1.9):
        bent = within(values, np.full_like(values, gain), 1.0)
        assert (bent[0], bent[-1]) == (0, 1)
        assert (np.diff(bent) > 0).all()
        dark = values < 0.9 / 1.9
        np.testing.assert_allclose(bent[dark], gain * values[dark], rtol=1e-6)  # float32


def test_a_store_can_keep_its_drift(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ramp = np.linspace(0.5, 1, 32, dtype=np.float32)[:, None, None]
    rng = np.random.default_rng(2)
    textures = ramp * (0.3 + 0.5 * rng.random((4, 32, 32, 3), np.float32))
    up = np.tile([0, 0, 1.0], (4, 1))
    writer.write(BTF(textures, up, up), here / "shaded.btf.zarr")
    for more in ((), ("--no-drift",)):
        found = typed(capsys, "tile", "shaded.btf.zarr", "--force", *more)
        assert (found["drift"] > 0.1) == (not more)
    # Half precision: the store's own values.
    tile = btfkit.open(here / "shaded.tile.btf.zarr").texture(0)
    assert np.isin(tile, btfkit.open(here / "shaded.btf.zarr").texture(0)).all()


def test_a_chequerboard_that_tiles_has_no_seam(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    board = (np.indices((64, 64)) // 8).sum(axis=0) % 2 * 255
    drawn(here / "board.png", board.astype(np.uint8))
    found = typed(capsys, "tile", "board.png")
    assert found["seam_ratio"] == pytest.approx(1)


# --- small things


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("1m30s", 90), ("1h", 3600), ("1h2m3s", 3723), ("90", 90), ("0.5m", 30), ("1m 30s", 90)],
)
def test_a_time_may_be_said_in_parts(text: str, seconds: float) -> None:
    from btfkit.cli.options import DurationType

    assert DurationType().convert(text, None, None) == seconds


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["ingst", "x"], "no verb 'ingst' (did you mean ingest?); there are "),
        (["fit", "wool.btf.zarr", "--model", "neubft"], "(did you mean neubtf?)"),
        (["fit", "wool.btf.zarr", "--model", "pca", "--set", "rnk=3"], "(did you mean rank?)"),
        (["fit", "wool.btf.zarr", "--bugdet", "3s"], "Did you mean one of: '--budget'"),
        (["synth", "wovn", "-o", "x"], "no material 'wovn' (did you mean woven?)"),
        (["render", "wool.btf.zarr", "--shape", "sphear"], "(did you mean sphere?)"),
        (["ingest", "wool.btf.zarr", "-o", "x", "--format", "ubo203"], "(did you mean ubo2003?)"),
        (["bench", "coblles"], "(did you mean cobbles?)"),
    ],
)
def test_a_name_that_is_nearly_one_is_answered_with_it(
    arguments: list[str], said: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(command, arguments) in (1, 2)
    assert said in capsys.readouterr().err


def test_help_of_fit_lists_models_with_their_settings(capsys: pytest.CaptureFixture[str]) -> None:
    from btfkit.fitting import MODELS, SETTINGS, settings_of

    assert set(SETTINGS) == set(MODELS)
    assert run(command, ["fit", "--help"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    for model in MODELS:
        assert f" {model}: " in said
        for name, value in settings_of(model).items():
            assert f"{name}={value}" in said


def test_an_empty_folder_says_what_comes_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(command, ["fit"]) == 1
    assert "first: btfkit ingest FOLDER" in capsys.readouterr().err
    assert run(command, ["propagate", "a.png"]) == 1
    assert "first: btfkit fit --model neubtf" in capsys.readouterr().err


def test_a_folder_of_photographs_says_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("a.png", "b.png"):
        drawn(tmp_path / name, dotted())
    assert run(command, ["ingest", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert "no reader knows this folder of 2 pictures: nothing says where light and view" in said
    assert "manifest.csv" in said
    assert ".lp" in said


def test_sizes_are_width_by_height_where_people_read_them(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    writer.write(sample().crop(slice(0, 8), slice(0, 16)), here / "wide.btf.zarr")
    assert run(command, ["ingest", "wide.btf.zarr", "-o", "w.btf.zarr"]) == 0
    assert "40 textures of 16 x 8, 3 channels" in capsys.readouterr().out
    assert "40 textures of 16 x 8" in repr(btfkit.open(here / "wide.btf.zarr"))
    assert "(16 x 8 texels" in repr(
        fit(btfkit.open(here / "wide.btf.zarr"), model="lambert").material
    )


@pytest.mark.parametrize(("more", "size"), [((), (512, 256)), (("--size", "40x30"), (40, 30))])
def test_a_wide_material_makes_a_wide_picture(
    more: tuple[str, ...], size: tuple[int, int], here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from skimage.io import imread

    wide = sample().crop(slice(0, 8), slice(0, 16))
    file.save(fit(wide, model="lambert").material, here / "wide.safetensors")
    assert run(command, ["render", "wide.safetensors", "-o", "x.jpg", *more]) == 0
    assert imread(here / "x.jpg").shape == (size[1], size[0], 3)
    assert (here / "x.jpg").read_bytes()[:2] == b"\xff\xd8"


def test_a_query_file_is_answered_beside_it_by_default(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    up = np.tile(np.float32([0, 0, 1]), (5, 1))
    queryfile.write(QuerySet(np.full((5, 2), 0.5), up, up), here / "ask.npz")
    found = typed(capsys, "query", "wool.btf.zarr", "ask.npz")
    assert found["out"] == "ask.answers.npz"
    assert queryfile.read(here / "ask.answers.npz").rgb is not None


@pytest.mark.slow
def test_auto_names_the_model_that_it_took(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    writer.write(sample(9), here / "nine.btf.zarr")
    assert run(command, ["fit", "nine.btf.zarr"]) == 0
    assert capsys.readouterr().out.startswith("nine.auto.safetensors: interpolation, held-out")


@pytest.mark.parametrize(
    ("arguments", "then"),
    [
        (["ingest", "wool.btf.zarr", "-o", "b.btf.zarr"], "btfkit fit b.btf.zarr"),
        (["fit", "--model", "lambert"], "btfkit view wool.lambert.safetensors"),
        (["view", "wool.btf.zarr"], "open wool.html in a browser"),
        (["convert", "wool.btf.zarr", "-o", "u", "--as", "manifest"], "btfkit info u"),
        (["synth", "print", "-o", "p.exr", "--as", "relief", "--size", "8"],
         "btfkit render p.exr --shape sphere"),
        (["tile", "wool.btf.zarr"], "btfkit fit wool.tile.btf.zarr"),
        (["eval", "wool.btf.zarr", "wool.btf.zarr"], "btfkit render wool.btf.zarr --shape sphere"),
        (["render", "wool.btf.zarr", "--size", "8x8"], "open it; --env"),
    ],
)  # fmt: skip
def test_every_verb_says_what_one_may_do_next(
    arguments: list[str], then: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(command, arguments) == 0
    caught = capsys.readouterr()
    assert f"next: {then}" in caught.err
    assert "next:" not in caught.out
    assert run(command, [*arguments, *(() if arguments[0] == "eval" else ("--force",)),
                         "--quiet"]) == 0  # fmt: skip
    assert "next:" not in capsys.readouterr().err


def test_guidance_that_is_clear_in_places_says_what_becomes_of_them() -> None:
    from btfkit import propagation

    rng = np.random.default_rng(0)
    image = rng.random((16, 16, 4)).astype(np.float32)
    image[..., 3] = 1
    image[:4, :, 3] = 0
    image[:4, :, :3] = 9  # whatever lies there must not guide anything
    with pytest.warns(UserWarning, match="no opacity: 64 texels that are clear throughout"):
        given = propagation.prepare(image)
    mean = image[4:, :, :3].mean(axis=(0, 1))
    filled = image[..., :3].copy()
    filled[:4] = mean
    np.testing.assert_allclose(given, propagation.prepare(filled), atol=1e-6)


def test_alpha_of_a_picture_is_seen(tmp_path: Path) -> None:
    from btfkit.fitting.neubtf import pictures

    codes = np.full((8, 8, 4), 200, np.uint8)
    codes[..., 3] = 255
    drawn(tmp_path / "opaque.png", codes)
    assert pictures.read_guidance(tmp_path / "opaque.png")[0].shape == (8, 8, 3)
    codes[2, 3, 3] = 0
    drawn(tmp_path / "clear.png", codes)
    alpha = pictures.read_guidance(tmp_path / "clear.png")[0][..., 3]
    assert (alpha == 0).sum() == 1
    assert alpha[2, 3] == 0


def test_the_readme_says_where_the_command_is_after_make() -> None:
    text = (Path(__file__).parents[2] / "README.md").read_text()
    assert ".venv/bin/activate" in text
