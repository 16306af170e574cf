"""A material in WGSL, run by wgpu on whatever Vulkan there is, and in Slang, compiled for the CPU."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import needs
import numpy as np
import pytest
from cases import SPECS, made
from test_export import agree, asked, compiler, wanted

from btfkit.export import slang, wgsl
from btfkit.export.package import export
from btfkit.materials.neumip.material import in_precision

pytestmark = pytest.mark.slow
# Mesa's software renderer takes all processors otherwise.
os.environ.setdefault("LP_NUM_THREADS", "1")


@pytest.fixture(scope="module")
def device() -> None:
    """A device of WebGPU, or the test is skipped."""
    wgpu = needs.module("wgpu")
    try:
        wgpu.gpu.request_adapter_sync().request_device_sync()
    except RuntimeError:
        needs.lacking("wgpu", "it finds no device: apt-get install mesa-vulkan-drivers")


def example(folder: Path) -> Any:
    """The module `evaluate.py` of an export."""
    spec = importlib.util.spec_from_file_location("example", folder / "evaluate.py")
    assert spec is not None
    assert spec.loader is not None
    found = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(found)
    return found


@pytest.mark.parametrize("name", list(SPECS))
def test_wgsl_answers_as_the_material(name: str, device: None, tmp_path: Path) -> None:
    material, queries = made(name), asked()
    wgsl.write(material, material.program(), tmp_path)
    agree(*example(tmp_path).evaluate(*queries), wanted(material, queries))


@pytest.mark.parametrize("name", ["neumip", "rainer20", "neubtf-paper"])
def test_slang_answers_as_the_material(name: str, tmp_path: Path) -> None:
    needs.module("slangpy")
    compiler()
    material, queries = made(name), asked()
    slang.write(material, material.program(), tmp_path)
    agree(*example(tmp_path).evaluate(*queries), wanted(material, queries))


def test_networks_in_bfloat16_are_rounded_in_the_shader_too(device: None, tmp_path: Path) -> None:
    material, queries = in_precision(made("neumip"), "float32", "bfloat16"), asked()
    wgsl.write(material, material.program(), tmp_path)
    rgb, _ = example(tmp_path).evaluate(*queries)
    error = np.abs(rgb - wanted(material, queries).reflectance)
    # A sum on the edge between two numbers of eight bits falls to either side.
    assert np.quantile(error, 0.95) <= 1e-5
    assert error.max() <= 2e-2


def test_the_example_in_wgsl_answers_a_query_file(device: None, tmp_path: Path) -> None:
    material, queries, out = made("lambert"), asked(), tmp_path / "out"
    export(material, "wgsl", out)
    np.savez(tmp_path / "q.npz", **queries._asdict())
    command = [sys.executable, out / "evaluate.py", tmp_path / "q.npz", tmp_path / "a.npz"]
    subprocess.run(command, check=True)
    with np.load(tmp_path / "a.npz") as found:
        agree(found["rgb"], found["opacity"], wanted(material, queries))


def test_a_shader_has_the_parts_that_its_material_needs(tmp_path: Path) -> None:
    texts = {}
    for name in ("lambert", "neumip"):
        (folder := tmp_path / name).mkdir()
        wgsl.write(made(name), made(name).program(), folder)
        texts[name] = (folder / "material.wgsl").read_text()
        files = {path.name for path in folder.glob("*.bin")}
        assert files == {"texels.bin"} | (
            {"weights.bin", "heights.bin"} if name == "neumip" else set()
        )
    for part in ("crossing", "halfway", "frame0", "leaky", "sigmoid", "log2"):
        assert (part in texts["neumip"]) == (part not in ("leaky",))
        assert part not in texts["lambert"]
