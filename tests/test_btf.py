"""The BTF: checked once, lazy throughout, and its parts are what slicing gives."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from btfkit import directions
from btfkit.btf import BTF
from btfkit.textures import Textures


class Counting(Textures):
    """Random textures that remember which were read."""

    def __init__(self, n: int, h: int = 5, w: int = 7, c: int = 3) -> None:
        self.shape = (n, h, w, c)
        self.data = np.random.default_rng(0).random(self.shape, np.float32)
        self.read: list[int] = []

    def _read(self, index: int) -> np.ndarray:
        self.read.append(index)
        return self.data[index]


def product_btf(**changes: Any) -> BTF:
    """Four lights by three views, light running fastest."""
    light, view = directions.bonn81()[1:5], directions.bonn81()[7:10]
    fields: dict[str, Any] = {
        "textures": Counting(12),
        "light": np.tile(light, (3, 1)),
        "view": np.repeat(view, 4, axis=0),
    }
    return BTF(**(fields | changes))


def test_nothing_is_read_that_was_not_asked_for() -> None:
    btf = product_btf()
    textures: Any = btf.textures
    part = btf.select(lights=slice(1, 3), views=slice(2, 3)).crop(slice(1, 4), slice(2, 6))
    assert textures.read == []
    np.testing.assert_array_equal(part.texture(1), textures.data[10, 1:4, 2:6])
    assert textures.read == [10]


def test_texels_and_abrdf_are_what_the_textures_hold() -> None:
    btf = product_btf()
    textures: Any = btf.textures
    pairs, rows, cols = np.array([3, 0, 3, 11]), np.array([0, 4, 2, 1]), np.array([6, 0, 3, 2])
    np.testing.assert_array_equal(btf.texels(pairs, rows, cols), textures.data[pairs, rows, cols])
    assert textures.read == [0, 3, 11]
    np.testing.assert_array_equal(btf.abrdf(2, 3), textures.data[:, 2, 3])


def test_subset_takes_masks_and_keeps_every_array_in_step() -> None:
    btf = product_btf(footprint=np.arange(12, dtype=np.float32), validity=np.ones((12, 5, 7), bool))
    part = btf.subset(np.arange(12) % 5 == 0)
    assert part.footprint is not None
    np.testing.assert_array_equal(part.footprint, [0, 5, 10])
    np.testing.assert_array_equal(part.light, btf.light[[0, 5, 10]])
    assert part.validity is not None
    assert part.validity.shape == (3, 5, 7)


def test_a_near_light_stands_at_the_same_place_after_a_crop() -> None:
    position = np.tile(np.float32([3, 4, 50]), (12, 1))
    btf = product_btf(light_position=position, texel_mm=2.0)
    window = btf.crop(slice(1, 4), slice(3, 7))
    # float32 positions of tens of millimetres
    np.testing.assert_allclose(window.light_at(0), btf.light_at(0)[1:4, 3:7], atol=1e-6)
    # at the column right of the light, the light is to the left
    assert btf.light_at(0)[2, 6, 0] < 0
    # row 0 lies at y = +4 mm, as high as the light: no y component there
    assert abs(btf.light_at(0)[0, 0, 1]) < 1e-6


def test_far_directions_are_the_same_at_every_texel() -> None:
    btf = product_btf()
    assert btf.view_at(5).shape == (5, 7, 3)
    np.testing.assert_array_equal(btf.view_at(5)[3, 2], btf.view[5])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"light": np.eye(3)}, r"light has shape \(3, 3\); 12 textures need \(12, 3\)"),
        ({"view": -np.ones((12, 3))}, r"view\[0\] = .* points below the surface"),
        ({"channels": ("R",)}, r"1 channel names \('R',\) for 3 channels"),
        ({"texel_mm": -1.0}, r"texel_mm = -1.0; expected a positive length"),
        ({"wrap": "mirror"}, r"wrap = 'mirror'; expected 'wrap' or 'clamp'"),
        ({"validity": np.ones((12, 5, 8), bool)}, r"validity has shape \(12, 5, 8\)"),
        ({"footprint": np.ones(3, np.float32)}, r"footprint has shape \(3,\); expected \(12,\)"),
        ({"variance": np.ones((1, 5, 7, 3))}, r"variance has shape \(1, 5, 7, 3\)"),
        ({"textures": np.ones((12, 5, 7))}, r"textures have shape \(12, 5, 7\)"),
        ({"textures": np.ones((12, 0, 7, 3))}, r"every size must be > 0"),
    ],
)
def test_a_btf_that_does_not_fit_itself_is_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        product_btf(**change)


def test_parts_that_are_empty_are_refused() -> None:
    btf = product_btf()
    with pytest.raises(ValueError, match="leave none of 12 pairs"):
        btf.select(lights=slice(9, 10))
    with pytest.raises(ValueError, match="of a 5 x 7 texture is empty"):
        btf.crop(slice(5, 9), slice(None))
    with pytest.raises(ValueError, match="no pair of 12 is left"):
        btf.subset(np.zeros(12, bool))
    with pytest.raises(IndexError, match="pair 12 of 12"):
        btf.texture(12)


def test_positions_need_a_scale() -> None:
    btf = product_btf(light_position=np.ones((12, 3), np.float32))
    with pytest.raises(ValueError, match="positions in mm need texel_mm"):
        btf.light_at(0)


def test_xarray_reads_only_the_pair_that_is_taken() -> None:
    btf = product_btf(texel_mm=0.5)
    textures: Any = btf.textures
    data = btf.to_xarray()
    assert textures.read == []
    values = data["texture"].isel(pair=7, row=slice(1, 3), channel=0).values
    np.testing.assert_array_equal(values, textures.data[7, 1:3, :, 0])
    assert textures.read == [7]
    np.testing.assert_array_equal(
        data["texture"].isel(pair=[2, 4], column=3).values, textures.data[[2, 4], :, 3]
    )
    assert data.attrs["texel_mm"] == 0.5
    assert data["view"].dims == ("pair", "xyz")


@pytest.mark.parametrize("whole", [True, False])
def test_a_batch_is_its_textures_masks_included(whole: bool) -> None:
    rng = np.random.default_rng(0)
    validity = rng.random((1 if whole else 5, 4, 6)) > 0.3
    btf = BTF(
        rng.random((5, 4, 6, 2), np.float32), np.tile([0, 0, 1.0], (5, 1)),
        np.tile([0, 0, 1.0], (5, 1)), channels=("a", "b"), validity=validity,
    )  # fmt: skip
    pairs = [3, 0, 3, 4]
    np.testing.assert_array_equal(btf.batch(pairs), np.stack([btf.texture(i) for i in pairs]))


def test_a_subset_by_slice_mask_or_index_is_the_same() -> None:
    light = np.random.default_rng(0).normal(size=(6, 3)) + [0, 0, 4]
    btf = BTF(np.arange(6.0)[:, None, None, None] + np.zeros((6, 2, 2, 3)), light, light)
    mask = np.array([False, True, False, True, False, True])
    for pairs in (slice(1, None, 2), mask, [1, 3, 5]):
        found = btf.subset(pairs)
        np.testing.assert_array_equal(found.light, btf.light[1::2])
        assert found.texture(2)[0, 0, 0] == 5
    with pytest.raises(ValueError, match="no pair of 6 is left"):
        btf.subset(slice(3, 3))
