"""The evaluator that docs/model-file.md prints, run as it stands there."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

import btfkit
from btfkit.relief.synth import synth_btf

PAGE = Path(__file__).parents[2] / "docs" / "model-file.md"


def upper(rng: np.random.Generator, count: int) -> np.ndarray:
    direction = rng.normal(size=(count, 3)).astype(np.float32)
    direction[:, 2] = np.abs(direction[:, 2]) + 0.2
    return direction / np.linalg.norm(direction, axis=1, keepdims=True)


def test_the_printed_evaluator_answers_as_the_toolkit_does(tmp_path: Path) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    printed: dict[str, Any] = {}
    exec(compile(code, str(PAGE), "exec"), printed)
    btf = synth_btf("woven", size=24, lights="7", views="7", samples=1)
    path = tmp_path / "woven.neumip.safetensors"
    material = btfkit.fit(btf, model="neumip", steps=60, out=path).material
    rng = np.random.default_rng(0)
    uv, light, view = rng.random((500, 2), np.float32), upper(rng, 500), upper(rng, 500)
    wanted = material.evaluate(uv, light, view).reflectance
    found = printed["evaluate"](path, uv, light, view)
    # float32 kernels beside float64 here, magnified by the last exponential.
    np.testing.assert_allclose(found, wanted, rtol=1e-3, atol=1e-4)
    assert wanted.std() > 0.01
