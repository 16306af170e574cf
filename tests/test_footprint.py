from __future__ import annotations

import numpy as np
import pytest

from btfkit.footprint import (
    FINEST,
    blur_of,
    blurred,
    gaussian,
    level_of,
    level_sizes,
    most_levels,
    of_level,
    resolved_level,
)  # fmt: skip


def test_a_texel_is_level_zero_and_every_doubling_a_level() -> None:
    np.testing.assert_array_equal(level_of([0.0, 0.25, FINEST, 1.0, 2.0, 4.0]), [0, 0, 0, 1, 2, 3])
    np.testing.assert_array_equal(of_level([0, 1, 2]), [0.5, 1, 2])
    levels = np.linspace(0, 9, 50)
    # float64: a logarithm of what a power gave.
    np.testing.assert_allclose(level_of(of_level(levels)), levels, atol=1e-14)


def test_a_texture_needs_no_blur_for_one_texel() -> None:
    assert blur_of(FINEST) == 0
    assert blur_of(1.0) == 0.75


def test_half_the_rows_and_columns_resolve_a_level_less() -> None:
    assert resolved_level((64, 32), (128, 64)) == 1.0
    assert resolved_level((256, 128), (128, 64)) == 0.0


def test_pyramids_end_in_one_texel() -> None:
    assert level_sizes((5, 12), most_levels((5, 12))) == ((5, 12), (2, 6), (1, 3), (1, 1))
    assert most_levels((1, 1)) == 1
    assert most_levels((512, 512)) == 10


@pytest.mark.parametrize("wrap", [True, False])
@pytest.mark.parametrize("side", [1, 2, 5, 64])
def test_blurs_keep_constants_and_add_variance(side: int, wrap: bool) -> None:
    for variance in (0.0, 0.1, 3.0, 400.0):
        matrix = gaussian(side, variance, wrap=wrap)
        # float32 weights.
        np.testing.assert_allclose(matrix.sum(axis=1), 1, atol=1e-6)
    if side == 64:
        row = gaussian(side, 9.0, wrap=wrap)[32]
        # Four standard deviations hold all but 1e-4 of the variance.
        assert row @ (np.arange(side) - 32.0) ** 2 == pytest.approx(9.0, rel=2e-3)


def test_what_is_not_measured_does_not_bleed_into_blurred_textures() -> None:
    image = np.ones((16, 16, 1), np.float32)
    image[3:5, 3:5] = np.nan
    matrix = gaussian(16, 2.0, wrap=True)
    image = blurred(image, matrix, matrix)
    # float32, two products.
    np.testing.assert_allclose(image[np.isfinite(image)], 1, rtol=1e-5)
    assert np.isnan(image).sum() < 16
