"""Whatever answers queries renders on every shape: each model, and what is none."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_materials import every_model, fitted, one_thread, tiny

import btfkit
from btfkit.cli import btfkit as command
from btfkit.cli.outcome import run
from btfkit.directions import from_angles
from btfkit.io import images
from btfkit.io.store import writer
from btfkit.relief import file, procedural
from btfkit.render.preview import Scene, render
from btfkit.shapes.catalogue import SHAPES, shape_of

__all__ = ["one_thread"]

SQUARE = """v -1 -1 0
v 1 -1 0
v 1 1 0
v -1 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
f 1/1 2/2 3/3 4/4
"""
every_shape = pytest.mark.parametrize("shape", SHAPES)


def rendered(source: Path, shape: str) -> np.ndarray:
    """(h, w, c) what the command line draws."""
    out = source.parent / "seen.exr"
    name = shape
    if shape == "FILE.obj|ply":
        (source.parent / "square.obj").write_text(SQUARE)
        name = str(source.parent / "square.obj")
    arguments = ["render", str(source), "-o", str(out), "--shape", name, "--size", "12x10"]
    assert run(command, arguments) == 0
    values, names, _ = images.read_exr(out.name, out.read_bytes())
    return values[..., [names.index(each) for each in "RGB"]]


@every_model
@every_shape
def test_every_model_renders_on_every_shape(model: str, shape: str, tmp_path: Path) -> None:
    btfkit.materials.file.save(fitted(model), tmp_path / "m.safetensors")
    seen = rendered(tmp_path / "m.safetensors", shape)
    assert seen.shape == (10, 12, 3)
    assert np.isfinite(seen).all()
    assert seen.max() > 0


@every_shape
@pytest.mark.parametrize("kind", ["store", "relief"])
def test_a_store_and_a_relief_render_on_every_shape(kind: str, shape: str, tmp_path: Path) -> None:
    if kind == "store":
        source = writer.write(tiny(), tmp_path / "a.btf.zarr")
    else:
        source = tmp_path / "a.exr"
        file.write(procedural.make("knit", 16), source)
    seen = rendered(source, shape)
    assert np.isfinite(seen).all()
    assert seen.max() > 0


@pytest.mark.parametrize("model", ["lambert", "neumip", "sbtf", "neubtf"])
def test_lights_together_are_lights_one_by_one(model: str) -> None:
    material, form = fitted(model), shape_of("torus")
    ways = from_angles(*np.radians([(20 + 14 * k, 70 * k) for k in range(8)]).T)
    options: dict[str, Any] = {"size": (24, 24), "samples": 2, "view": ways[1]}
    both = render(Scene(material, form, ways), **options)
    each = [render(Scene(material, form, way[None]), **options) for way in ways]
    # Sums of 8 in another order; the stage of the view in the same kernel.
    total = sum(seen.radiance for seen in each)
    np.testing.assert_allclose(both.radiance, total, rtol=1e-4, atol=2e-6)
    np.testing.assert_array_equal(both.cover, each[0].cover)


@pytest.mark.parametrize("model", ["neumip", "sbtf", "pca"])
def test_lights_of_each_view_answer_as_queries_do(model: str) -> None:
    material = fitted(model)
    rng = np.random.default_rng(1)
    m, b = 5, 700
    ways = rng.normal(size=(m + 1, b, 3))
    ways /= np.linalg.norm(ways, axis=2, keepdims=True)
    ways[..., 2] = np.abs(ways[..., 2])
    lights, view = ways[:m].astype(np.float32), ways[m]
    lights[rng.random((m, b)) < 0.3] = 0
    # A whole tile of queries without the first light.
    lights[0, :300] = 0
    uv, blur = rng.random((b, 2)), 0.5 + rng.random(b)
    bend = rng.uniform(-0.5, 0.5, b) if material.has_curvature else np.zeros(b)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rgb, opacity = material.under_lights(uv, lights, view, blur, bend)
        asked = lights.any(axis=2)
        for k in range(m):
            rows = asked[k]
            single = material.evaluate(
                uv[rows], lights[k, rows], view[rows], blur[rows], bend[rows]
            )
            # The same sums; the compiler may join products otherwise.
            np.testing.assert_allclose(rgb[k, rows], single.reflectance, rtol=1e-4, atol=1e-6)
            np.testing.assert_array_equal(opacity[rows], single.opacity)
        assert not rgb[~asked].any()
