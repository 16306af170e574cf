"""Whatever answers queries renders on every shape: each model, and what is none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_materials import every_model, fitted, one_thread, tiny

import btfkit
from btfkit.cli import btfkit as command
from btfkit.cli.outcome import run
from btfkit.io import images
from btfkit.io.store import writer
from btfkit.relief import file, procedural
from btfkit.shapes.catalogue import SHAPES

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
