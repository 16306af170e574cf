"""Materials: what the public face guards, and model files that are damaged or hostile."""

from __future__ import annotations

import json
import struct
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from btfkit import materials
from btfkit.errors import FormatError
from btfkit.materials import file
from btfkit.materials.base import Header, Material
from btfkit.queries import Query

UP = [0.0, 0.0, 1.0]


@dataclass(frozen=True)
class RampSpec:
    """A ramp of a number of steps."""

    steps: int


class Ramp(Material):
    """Answers u, and has half opacity where v > 0.5: enough to see what reaches a model."""

    model: ClassVar[str] = "ramp"
    spec_type: ClassVar[type] = RampSpec

    @classmethod
    def shapes(cls, spec: RampSpec, header: Header) -> dict[str, tuple[int, ...]]:
        return {"ramp": (spec.steps,)}

    def _answer(self, query: Query) -> tuple[np.ndarray, np.ndarray | None]:
        assert query.uv.dtype == np.float32
        assert np.all((query.uv >= 0) & (query.uv <= 1))
        assert np.all(query.light[:, 2] > 0)
        rgb = np.repeat(query.uv[:, :1] + 1, 3, axis=1)
        return rgb, np.where(query.uv[:, 1] > 0.5, np.float32(0), np.float32(1))


def ramp(**header: Any) -> Ramp:
    weights = {"ramp": np.arange(4, dtype=np.float32)}
    return Ramp(RampSpec(4), weights, Header(grid=(8, 16), **header))


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(materials.MODELS, "ramp", f"{__name__}:Ramp")


@given(st.floats(-1e6, 1e6), st.integers(-1000, 1000))
def test_uv_wraps_without_losing_its_texel(u: float, turns: int) -> None:
    first = ramp().evaluate([u, 0.25], UP, UP).reflectance[0]
    again = ramp().evaluate([u + turns, 0.25], UP, UP).reflectance[0]
    # u + turns is rounded in float64: 1e6 has spacing 1.2e-10; and 1 wraps to 0
    assert min(abs(first - again), 1 - abs(first - again)) < 1e-6


def test_uv_clamps_where_the_material_does_not_tile() -> None:
    answer = ramp(wrap="clamp").evaluate([[-3, 0.2], [7, 0.2]], UP, UP)
    np.testing.assert_array_equal(answer.reflectance[:, 0], [1, 2])


def test_what_cannot_be_answered_is_0_with_opacity_0_and_counted() -> None:
    view = [UP, [0, 1, -0.1], [np.nan, 0, 1], [0, 0, 0], UP]
    uv = [[0.5, 0.2]] * 4 + [[np.inf, 0]]
    with pytest.warns(UserWarning, match="4 of 5 queries are not finite or seen from below"):
        rgb, opacity = ramp().evaluate(uv, UP, view)
    np.testing.assert_array_equal(opacity, [1, 0, 0, 0, 0])
    np.testing.assert_array_equal(rgb[1:], 0)


def test_light_below_the_horizon_answers_0_and_covers() -> None:
    rgb, opacity = ramp().evaluate([0.5, 0.2], [0, 1, -0.5], UP)
    np.testing.assert_array_equal(rgb, 0)
    assert opacity == 1


def test_reflectance_is_0_where_opacity_is() -> None:
    rgb, opacity = ramp().evaluate([0.5, 0.9], UP, UP)
    assert (rgb.sum(), opacity) == (0, 0)


def test_directions_of_any_length_are_directions() -> None:
    for scale in (1e-20, 1e20):
        answer = ramp().evaluate([0.5, 0.2], np.float32(UP) * np.float32(scale), UP)
        assert answer.reflectance[0] == 1.5


def test_a_model_without_levels_or_curvature_warns_once() -> None:
    material = ramp()
    with pytest.warns(UserWarning, match="ramp knows no footprint: it answers at its finest level"):
        material.evaluate([0.5, 0.2], UP, UP, footprint=4.0)
    with pytest.warns(UserWarning, match="ramp knows no curvature: it answers on the plane"):
        material.evaluate([0.5, 0.2], UP, UP, curvature=1.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        material.evaluate([0.5, 0.2], UP, UP, footprint=4.0, curvature=1.0)


def test_weights_that_do_not_fit_the_spec_are_refused() -> None:
    with pytest.raises(ValueError, match=r"do not fit the spec of ramp: ramp: \(3,\) for \(4,\)"):
        Ramp(RampSpec(4), {"ramp": np.zeros(3, np.float32)}, Header(grid=(8, 8)))


@pytest.mark.usefixtures("known")
def test_a_file_gives_back_spec_weights_header_and_training_arrays(tmp_path: Path) -> None:
    material = ramp(
        texel_mm=0.2, licence="CC0", provenance={"a": [1]}, steps=7, channels=("R", "G", "B")
    )
    file.save(material, tmp_path / "m.safetensors", training={"encoder": np.ones(2, np.float32)})
    back = file.load(tmp_path / "m.safetensors")
    assert (back.spec, back.header) == (material.spec, material.header)
    np.testing.assert_array_equal(back.weights["ramp"], material.weights["ramp"])
    assert list(file.training_arrays(tmp_path / "m.safetensors")) == ["encoder"]
    described = file.header_of(tmp_path / "m.safetensors")
    assert described["shapes"] == {"ramp": [4], "training.encoder": [2]}
    with pytest.raises(FileExistsError, match="exists; --force"):
        file.save(material, tmp_path / "m.safetensors")


def _with_metadata(**changes: str) -> bytes:
    metadata = {
        "btfkit": "1",
        "model": "ramp",
        "spec": '{"steps": 1}',
        "grid": "[4, 4]",
        "channels": '["R"]',
        "wrap": '"wrap"',
        "texel_mm": "null",
        "licence": "null",
        "provenance": "{}",
        "steps": "0",
        "quantity": '"q"',
    } | changes
    metadata = {key: value for key, value in metadata.items() if value}
    array = {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}
    header = json.dumps({"__metadata__": metadata, "ramp": array}).encode()
    return struct.pack("<Q", len(header)) + header + bytes(4)


@pytest.mark.usefixtures("known")
@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a readable safetensors file"),
        (b"\xff" * 64, "not a readable safetensors file"),
        (_with_metadata()[:-2], "not a readable safetensors file"),
        (_with_metadata(btfkit=""), "not a btfkit material"),
        (_with_metadata(btfkit="99"), "file version 99; this version reads up to 1"),
        (_with_metadata(model="nonsense"), "model 'nonsense'; this version knows"),
        (_with_metadata(spec="{"), "the header does not describe a material"),
        (_with_metadata(spec='{"other": 1}'), "the header does not describe a material"),
        (_with_metadata(spec='{"steps": 2}'), r"ramp: \(1,\) for \(2,\)"),
        (_with_metadata(grid="[4]"), r"grid = \(4,\); expected \(h, w\)"),
        (_with_metadata(wrap='"mirror"'), "wrap = 'mirror'"),
        (_with_metadata(channels="[]"), r"channels = \(\)"),
        (_with_metadata(grid=""), "the header does not describe a material: 'grid'"),
        (
            _with_metadata()[:-4] + struct.pack("<f", np.nan),
            "ramp holds values that are not finite",
        ),
    ],
)
def test_a_damaged_model_file_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "m.safetensors").write_bytes(content)
    with pytest.raises(FormatError, match=message):
        file.load(tmp_path / "m.safetensors")


def test_a_missing_model_file_is_missing(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no such file"):
        file.load(tmp_path / "m.safetensors")


def test_an_unknown_model_lists_the_known() -> None:
    with pytest.raises(ValueError, match="no model 'nonsense'; there are"):
        materials.material_class("nonsense")
