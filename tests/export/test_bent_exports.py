"""Exports that follow bent rays answer as the material does, each run by its own example."""

from __future__ import annotations

import base64
import copy
import json
import shutil
import subprocess
import sys
import warnings
from pathlib import Path
from unittest import mock

import needs
import numpy as np
import pytest
from cases import BENT, directions, made
from test_buffers import device, example
from test_onnx import session

from btfkit.export import slang, wgsl
from btfkit.export.glsl import drawable, encoded
from btfkit.export.glsl.atlas import quantised
from btfkit.export.package import export
from btfkit.export.sections import whole_text
from btfkit.materials.base import Material
from btfkit.materials.sbtf.material import SBTF
from btfkit.materials.sbtf.paper import SBTFPaper
from btfkit.native.neural import plain
from btfkit.queries import Response

__all__ = ["device"]
COMPILER = shutil.which("g++") or shutil.which("c++")
every_case = pytest.mark.parametrize("name", list(BENT))
Asked = dict[str, np.ndarray]


def asked(count: int = 1500) -> Asked:
    rng = np.random.default_rng(4)
    light, view = directions(rng, count), directions(rng, count)
    light[:400, 2] *= -1
    view[400:420] = [0, 0, 1]
    size = np.exp(rng.uniform(np.log(0.5), np.log(200), count))
    curvature = (rng.choice([1, 1, -1, 0], count) * size).astype(np.float32)
    curvature[420:425] = np.nan, np.inf, -np.inf, 1e30, -1e30
    view[430:440, 2] = -0.5
    return {
        "uv": rng.uniform(-2, 3, (count, 2)).astype(np.float32), "light": light, "view": view,
        "footprint": rng.choice([0.5, 1.3, 7], count).astype(np.float32), "curvature": curvature,
    }  # fmt: skip


def wanted(material: Material, queries: Asked) -> Response:
    """Answers of single rays, which exports follow: of no footprint's several.

    Of the program itself: the kernel reads heights in steps of 1/65535 of their range.
    """
    material = copy.copy(material)
    if isinstance(material, SBTF):
        material._kernel = None
    sharp = mock.patch.object(SBTF, "_may_pass", return_value=np.empty(0, np.intp))
    with warnings.catch_warnings(), sharp:
        # Counts of what is masked, and of curvature that no surface has.
        warnings.simplefilter("ignore", UserWarning)
        return material.evaluate(**queries)


def settled(material: Material, queries: Asked) -> np.ndarray:
    """Rows whose rays end at one place, however their numbers are rounded."""
    uv, view, bend = reduced(material, queries)
    if isinstance(material, SBTFPaper):
        if material.spec.opacity == "direct":
            return np.ones(len(uv), bool)
        program = material.program()
        assert program.cover is not None
        edge = plain._looked_up(program, program.cover, uv, view, bend)[:, 0]
        return np.abs(view[:, 2] - edge) > 1e-5
    ends = []
    # Beyond the border of a sample many looks are equally far above it: which is the closest is
    # left to rounding.
    for kind, off in ((np.float32, 0), (np.float64, 0), (np.float64, 3e-7), (np.float64, -3e-7)):
        program = material.program().in_dtype(kind)
        near = view.astype(kind) * np.array([1, 1, 1 + off], kind)
        ends.append(plain.marched(program, uv.astype(kind), near, bend.astype(kind)))
    (one, first, _), *others = ends
    # The moved view itself moves an end by less than 1e-5 where it is steady.
    return np.logical_and.reduce(
        [(np.abs(one - end) < limit) & (first == opaque)
         for limit, (end, opaque, _) in zip((1e-6, 1e-5, 1e-5), others, strict=True)]
    )  # fmt: skip


def reduced(material: Material, queries: Asked) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """uv in one tile, views of length 1, and the curvature that is answered."""
    uv = queries["uv"] - np.floor(queries["uv"])
    uv = uv if material.header.wrap == "wrap" else queries["uv"].clip(0, 1)
    view = queries["view"] / np.linalg.norm(queries["view"], axis=1, keepdims=True)
    low, high = getattr(material, "sharpest", (-1e30, 1e30))
    return uv, view, np.nan_to_num(queries["curvature"]).clip(low, high).astype(np.float32)


def agree(rgb: np.ndarray, opacity: np.ndarray, response: Response, rows: np.ndarray) -> None:
    assert np.isfinite(rgb).all()
    assert rows.mean() > 0.9
    np.testing.assert_allclose(opacity[rows], response.opacity[rows], atol=1e-6)
    # A place that is off by 1e-6 of a tile, in textures of random texels.
    limit = 3e-4 * np.maximum(1, np.abs(response.reflectance))
    assert (np.abs(rgb - response.reflectance) <= limit)[rows].all()
    masked = slice(420, 423), slice(430, 440)
    assert not any(opacity[part].any() or rgb[part].any() for part in masked)
    assert 0.02 < (opacity[rows] < 0.5).mean() < 0.7
    assert (rgb[:400] > 0).any()


@pytest.mark.slow
@every_case
@pytest.mark.parametrize("target", ["npz", pytest.param("exr", marks=pytest.mark.slow)])
def test_the_reader_in_numpy_follows_bent_rays(target: str, name: str, tmp_path: Path) -> None:
    material, queries = made(name), asked()
    export(material, target, tmp_path / "out")
    np.savez(tmp_path / "q.npz", **queries)  # type: ignore[arg-type]
    command = [sys.executable, tmp_path / "out" / "evaluate.py", tmp_path / "q.npz"]
    subprocess.run([*command, tmp_path / "a.npz"], check=True)
    with np.load(tmp_path / "a.npz") as answers:
        rows = settled(material, queries)
        agree(answers["rgb"], answers["opacity"], wanted(material, queries), rows)


@every_case
@pytest.mark.slow
@pytest.mark.skipif(COMPILER is None, reason="no C++ compiler: apt-get install g++")
def test_the_header_follows_bent_rays(name: str, tmp_path: Path) -> None:
    material, queries, out = made(name), asked(), tmp_path / "out"
    export(material, "cpp", out)
    flags = ["-O1", "-std=c++17", "-Wall", "-Wextra", "-Werror"]
    subprocess.run([COMPILER, *flags, "example.cpp", "-o", "example"], cwd=out, check=True)
    np.column_stack(list(queries.values())).astype("<f4").tofile(out / "q.bin")
    subprocess.run(["./example", "q.bin", "a.bin"], cwd=out, check=True)
    answers = np.fromfile(out / "a.bin", "<f4").reshape(len(queries["uv"]), -1)
    rows = settled(material, queries)
    agree(answers[:, :-1], answers[:, -1], wanted(material, queries), rows)


@every_case
@pytest.mark.slow
def test_wgsl_follows_bent_rays(name: str, device: None, tmp_path: Path) -> None:
    material, queries = made(name), asked()
    wgsl.write(material, material.program(), tmp_path)
    rgb, opacity = example(tmp_path).evaluate(**queries)
    agree(rgb, opacity, wanted(material, queries), settled(material, queries))


@pytest.mark.parametrize("name", ["sbtf with holes", "sbtf-paper"])
@pytest.mark.slow
@pytest.mark.skipif(COMPILER is None, reason="no C++ compiler: apt-get install g++")
def test_slang_follows_bent_rays(name: str, tmp_path: Path) -> None:
    needs.module("slangpy")
    material, queries = made(name), asked()
    slang.write(material, material.program(), tmp_path)
    rgb, opacity = example(tmp_path).evaluate(**queries)
    agree(rgb, opacity, wanted(material, queries), settled(material, queries))


@every_case
@pytest.mark.slow
def test_a_graph_follows_bent_rays(name: str) -> None:
    material, queries = made(name), asked()
    rgb, opacity = session(material.program()).run(None, queries)
    agree(rgb, opacity, wanted(material, queries), settled(material, queries))


@pytest.mark.parametrize("name", ["sbtf with holes", "sbtf-paper"])
def test_a_scene_of_blender_has_no_form_for_them(name: str, tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="which OSL is not written for"):
        export(made(name), "blender", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.browser
@pytest.mark.slow
def test_the_shader_follows_bent_rays(tmp_path: Path) -> None:
    import browser
    from test_glsl import _PAGE

    queries = asked(1200)
    plain_rows = [k for k in range(1200) if not 420 <= k < 440]
    queries = {name: part[plain_rows] for name, part in queries.items()}
    n, shaders = len(plain_rows), []
    packed = np.zeros((n, 3, 4), np.float32)
    packed[:, 0, :2], packed[:, 0, 2] = queries["uv"], queries["footprint"]
    packed[:, 0, 3] = queries["curvature"]
    packed[:, 1, :3], packed[:, 2, :3] = queries["light"], queries["view"]
    for name in BENT:
        shader = drawable(made(name).program(), model=name)
        shaders.append({
            "about": shader.about, "source": shader.source, "channels": 3,
            "data": {key: encoded(data) for key, data in shader.data.items()},
        })  # fmt: skip
    page = tmp_path / "page.html"
    asking = _PAGE.replace("q[0].z, value", "q[0].z, q[0].w, value")
    page.write_text(asking % {
        "upload": whole_text("upload.js"), "n": n, "queries": encoded(packed.tobytes()),
        "shaders": json.dumps(shaders),
    })  # fmt: skip
    seen = browser.load(page)
    assert seen.errors == []
    for name, text in zip(BENT, seen.text("out").split(","), strict=True):
        found = np.frombuffer(base64.b64decode(text), "<f4").reshape(n, 4)
        material = made(name)
        near = quantised(material.program(), "half")
        uv, view, bend = reduced(material, queries)
        rgb, opacity = plain.answer(near, uv, queries["light"], view, queries["footprint"], bend)
        rows = settled(material, queries)
        same = np.abs(found[:, 3] - opacity) < 1e-5
        assert same[rows].mean() > 0.995
        off = np.abs(found[:, :3] - rgb) / np.maximum(1, np.abs(rgb))
        # Polynomials of 1e-7 and divisions of 2.5 units: a place of 1e-6 tiles, random texels.
        assert np.mean(off[rows & same].max(axis=1) < 2e-3) > 0.99
        assert 0.02 < (opacity < 0.5).mean() < 0.7
