"""Heights from slopes: exact ones, steps, masks, and heights that are known besides."""

from __future__ import annotations

import numpy as np
import pytest

from btfkit.relief.integration import curl, integrate


def surface(h: int, w: int) -> tuple[np.ndarray, np.ndarray]:
    """Heights in texels and their slopes dz/dx, dz/dy; it tiles."""
    row, col = np.mgrid[:h, :w]
    x, y = 2 * np.pi * col / w, 2 * np.pi * row / h
    height = 8 * np.sin(2 * x) * np.cos(3 * y) + 3 * np.cos(5 * x)
    dx = (16 * np.cos(2 * x) * np.cos(3 * y) - 15 * np.sin(5 * x)) * 2 * np.pi / w
    down = -24 * np.sin(2 * x) * np.sin(3 * y) * 2 * np.pi / h
    return height, np.stack([dx, -down], axis=-1)


@pytest.mark.parametrize("wrap", [True, False])
@pytest.mark.parametrize("size", [(128, 128), (96, 160), (61, 83)])
def test_exact_normals_integrate_within_a_thousandth_of_the_range(
    wrap: bool, size: tuple[int, int]
) -> None:
    height, slope = surface(*size)
    found = integrate(slope, wrap=wrap)
    error = found.height - height + height.mean()
    assert np.abs(error).max() < 1e-3 * np.ptp(height)
    # slopes of a surface have next to no curl, mirrored ones have
    assert found.curl < 0.05 * curl(slope * [1, -1], wrap=wrap)


def test_a_step_is_kept_where_the_robust_error_sees_it() -> None:
    height, slope = surface(96, 96)
    stepped = height + 6.0 * (np.arange(96) >= 48)
    # What photometric stereo sees of a wall between two texels: nothing of its height.
    known = stepped.copy()
    weight = np.full(height.shape, 1e-2)
    rng = np.random.default_rng(0)
    noisy = slope + rng.normal(0, 0.01, slope.shape)
    soft, hard = (
        integrate(noisy, wrap=False, known=known, by_known=weight, robust=robust).height
        for robust in (True, False)
    )
    soft_error, hard_error = (np.sqrt(np.mean(np.square(f - stepped))) for f in (soft, hard))
    assert soft_error < 0.3 * hard_error
    # slopes' noise of 0.01, added up over as far as the known heights do not reach
    assert soft_error < 0.05


def test_masked_texels_do_not_pull() -> None:
    height, slope = surface(96, 96)
    bad = np.zeros((96, 96), bool)
    bad[30:45, 50:70] = True
    spoiled = np.where(bad[..., None], 5.0, slope)
    unknown = np.where(bad[..., None], np.nan, slope)
    for values, weight in ((spoiled, np.where(bad, 0.0, 1.0)), (unknown, None)):
        found = integrate(values, weight, wrap=True).height
        error = (found - height)[~bad]
        # one texel beside the mask is integrated to second order only
        assert np.abs(error - error.mean()).max() < 0.02 * np.ptp(height)


def test_known_heights_bring_the_offset() -> None:
    height, slope = surface(64, 64)
    known = np.full_like(height, np.nan)
    known[10, 10] = height[10, 10] + 3.0
    found = integrate(slope, wrap=True, known=known, by_known=np.ones_like(height)).height
    assert abs(float((found - height).mean()) - 3.0) < 0.02


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (5, 1), (2, 2)])
@pytest.mark.parametrize("wrap", [True, False])
def test_the_smallest_samples_are_flat_where_their_slopes_are(
    size: tuple[int, int], wrap: bool
) -> None:
    found = integrate(np.zeros((*size, 2)), wrap=wrap)
    np.testing.assert_array_equal(found.height, 0)
    assert found.curl == 0


def test_no_slopes_at_all_give_a_plane() -> None:
    found = integrate(np.full((16, 16, 2), np.nan), wrap=True)
    np.testing.assert_array_equal(found.height, 0)
