"""Numerically dangerous spots of sampling and marching, as exports meet them, group by group."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import needs
import numpy as np
import pytest
from cases import GRID, directions, made
from test_buffers import device, example
from test_export import agree, asked, wanted
from test_onnx import answers, session

from btfkit.export import npz, wgsl
from btfkit.export.package import export
from btfkit.materials.base import Material
from btfkit.materials.lobes import LobeTable
from btfkit.materials.neumip.material import NeuMIP

__all__ = ["device"]


def level_ground(*, size: tuple[int, int] = GRID) -> Material:
    """A material whose heights are all the same, so that no march has anything to march through."""
    rough = made("neumip")
    spec = replace(rough.spec, size=size, levels=1)
    weights = dict(rough.weights)
    for name, shape in NeuMIP.shapes(spec, rough.header).items():
        if name.startswith("texture"):
            stored = np.resize(rough.weights.get(name, np.zeros(1)), shape)
            weights[name] = (0 * stored + 0.3 if "heights" in name else stored).astype(np.float16)
    names = NeuMIP.shapes(spec, rough.header)
    return NeuMIP(spec, {name: weights[name] for name in names}, rough.header)


@pytest.mark.parametrize("name", ["lambert", "neumip"])
def test_group_26_exported_lobes_have_a_density_wherever_they_draw(
    name: str, tmp_path: Path
) -> None:
    material = made(name)
    export(material, "npz", tmp_path / "out")
    said = json.loads((tmp_path / "out" / "about.json").read_text())["lobes"]
    w, h = said["size"]
    stored = np.fromfile(tmp_path / "out" / said["file"], "<f2").astype(np.float32)
    table = LobeTable.of(stored.reshape(h, w, -1), grid=GRID, wrap="wrap")
    carried = material.with_lobes(table)
    rng = np.random.default_rng(0)
    uv, view = rng.random((600, 2)), directions(rng, 600, 1e-4)
    numbers = rng.random((600, 3))
    # The ends of every range, where logarithms and roots have none.
    numbers[:60] = rng.integers(0, 2, (60, 3))
    light, pdf = carried.sample(uv, view, numbers)
    assert np.isfinite(light).all()
    assert (light[:, 2] > 0).all()
    assert (pdf > 0).all()
    assert np.isfinite(pdf).all()
    # What is drawn is found again as densely, to the rounding of a light at the horizon.
    np.testing.assert_allclose(carried.pdf(uv, light, view), pdf, rtol=1e-3)
    assert (carried.pdf(uv, light * [1, 1, -1], view) == 0).all()
    rgb = material.evaluate(uv, light, view).reflectance
    assert np.isfinite(rgb / pdf[:, None]).all()


@pytest.mark.parametrize("size", [GRID, (1, 1), (1, 7)])
def test_group_27_a_march_through_level_ground_ends(size: tuple[int, int], tmp_path: Path) -> None:
    material, queries = level_ground(size=size), asked()
    (tmp_path / "out").mkdir()
    npz.write(material, material.program(), tmp_path / "out")
    agree(*example(tmp_path / "out").evaluate(*queries), wanted(material, queries))


@pytest.mark.slow
@pytest.mark.parametrize("size", [GRID, (1, 7)])
def test_group_27_so_does_one_in_a_graph(size: tuple[int, int]) -> None:
    material, queries = level_ground(size=size), asked()
    agree(*answers(session(material.program()), queries), wanted(material, queries))


@pytest.mark.slow
@pytest.mark.parametrize("size", [GRID, (1, 7)])
def test_group_27_and_in_a_shader(size: tuple[int, int], device: None, tmp_path: Path) -> None:
    needs.module("wgpu")
    material, queries = level_ground(size=size), asked()
    wgsl.write(material, material.program(), tmp_path)
    agree(*example(tmp_path).evaluate(*queries), wanted(material, queries))
