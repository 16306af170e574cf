"""A material in ONNX Runtime answers as the material does."""

from __future__ import annotations

import builtins
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import needs
import numpy as np
import pytest
from cases import SPECS, made
from test_export import agree, asked, wanted

from btfkit.export.onnx import built
from btfkit.export.package import export
from btfkit.materials.neumip.material import in_precision

pytestmark = pytest.mark.slow


def session(program: Any) -> Any:
    needs.module("onnx", install='"btfkit[onnx]"')
    runtime = needs.module("onnxruntime", install='"btfkit[onnx]"')
    model = built(program, name="case", about="{}")
    return runtime.InferenceSession(model.SerializeToString())


def answers(found: Any, queries: Any) -> tuple[np.ndarray, np.ndarray]:
    asked_ = {name: np.asarray(part, np.float32) for name, part in queries._asdict().items()}
    rgb, opacity = found.run(None, asked_)
    return rgb, opacity


@pytest.mark.parametrize("name", list(SPECS))
def test_a_graph_answers_as_the_material(name: str) -> None:
    material, queries = made(name), asked()
    agree(*answers(session(material.program()), queries), wanted(material, queries))


def test_networks_in_bfloat16_are_rounded_in_the_graph_too() -> None:
    material, queries = in_precision(made("neumip"), "float16", "bfloat16"), asked()
    rgb, _ = answers(session(material.program()), queries)
    error = np.abs(rgb - wanted(material, queries).reflectance)
    # A sum on the edge between two numbers of eight bits falls to either side.
    assert np.quantile(error, 0.95) <= 1e-5
    assert error.max() <= 2e-2
    unrounded = np.abs(rgb - wanted(made("neumip"), queries).reflectance)
    assert np.quantile(unrounded, 0.9) > 1e-4


def test_the_example_answers_a_query_file_and_papers_lie_in_the_model(tmp_path: Path) -> None:
    onnx = needs.module("onnx", install='"btfkit[onnx]"')
    needs.module("onnxruntime", install='"btfkit[onnx]"')
    material, queries, out = made("lambert"), asked(), tmp_path / "out"
    export(material, "onnx", out)
    np.savez(tmp_path / "q.npz", **queries._asdict())
    command = [sys.executable, out / "evaluate.py", tmp_path / "q.npz", tmp_path / "a.npz"]
    subprocess.run(command, check=True)
    with np.load(tmp_path / "a.npz") as found:
        agree(found["rgb"], found["opacity"], wanted(material, queries))
    (said,) = onnx.load(out / "material.onnx").metadata_props
    assert json.loads(said.value)["licence"] == "CC0-1.0"


def test_without_the_package_the_export_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        if name == "onnx":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ValueError, match=r"missing: pip install .btfkit\[onnx\]"):
        export(made("lambert"), "onnx", tmp_path / "out")
    assert not (tmp_path / "out").exists()
