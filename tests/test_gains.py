"""Nuisance gains: what is found of them, and what nothing can tell from reflectance."""

from __future__ import annotations

import numpy as np
import pytest

from btfkit import directions, gains


def pairs() -> tuple[np.ndarray, np.ndarray]:
    table = directions.bonn81()[:37]
    return np.tile(table, (37, 1)), np.repeat(table, 37, axis=0)


def measured(
    rng: np.random.Generator, gain: np.ndarray, noise: float
) -> tuple[np.ndarray, np.ndarray]:
    """Texels as a good model answers them, and as they were measured with gains."""
    answer = rng.uniform(0.05, 0.9, (len(gain), 200, gain.shape[1]))
    truth = answer * (1 + noise * rng.standard_normal(answer.shape))
    return answer, gain[:, None] * truth


def test_independent_gains_are_recovered_to_their_standard_error_and_have_mean_1():
    rng = np.random.default_rng(0)
    light, view = pairs()
    known = 1 + 0.04 * rng.standard_normal((len(light), 3))
    known /= known.mean(axis=0)
    ratio, error = gains.ratios(*measured(rng, known, 0.04))
    found = gains.estimated(ratio, error, light, view)
    np.testing.assert_allclose(found.values.mean(axis=0), 1, atol=1e-12)
    # 4 % of noise over 200 texels is 0.3 %; the smooth part takes 4 % sqrt(17 / 1369) = 0.4 %.
    off = found.values / known - 1
    assert np.sqrt(np.square(off).mean()) < 0.0055
    np.testing.assert_allclose(found.deviation, 0.04, rtol=0.1)
    assert np.median(found.error) == pytest.approx(0.003, rel=0.3)


def test_the_smooth_part_is_stated_and_left_with_reflectance():
    rng = np.random.default_rng(1)
    light, view = pairs()
    slope = np.exp(0.2 * light[:, :1] - 0.1 * view[:, 1:2] * light[:, :1])
    ratio, error = gains.ratios(*measured(rng, np.repeat(slope, 3, axis=1), 0.02))
    found = gains.estimated(ratio, error, light, view)
    assert np.abs(found.values - 1).max() < 0.005
    np.testing.assert_allclose(found.smooth, np.repeat(slope, 3, axis=1), rtol=0.005)


def test_gains_of_what_cannot_be_told_are_drawn_to_1():
    rng = np.random.default_rng(2)
    light, view = pairs()
    answer, truth = measured(rng, np.ones((len(light), 3)), 0.5)
    answer[5], truth[6], answer[7] = 0, np.nan, 1e-9
    ratio, error = gains.ratios(answer, truth)
    assert np.isnan(ratio[[5, 6, 7]]).all()
    assert np.isinf(error[[5, 6, 7]]).all()
    found = gains.estimated(ratio, error, light, view)
    np.testing.assert_allclose(found.values[[5, 6, 7]], 1, atol=1e-3)
    # Ratios scatter by 3.5 %; no gain is behind it.
    assert np.nanstd(ratio) > 0.03
    assert np.abs(found.values - 1).max() < 0.02


def test_few_pairs_have_a_smooth_part_of_few_terms():
    light, view = pairs()
    assert gains.smooth_terms(light, view).shape[1] == 17
    assert gains.smooth_terms(light[:60], view[:60]).shape[1] <= 10
    assert gains.smooth_terms(light[:3], view[:3]).shape[1] == 1
    # One view only: what depends on it alone is no term.
    above = np.tile([0.0, 0.0, 1.0], (1369, 1))
    assert gains.smooth_terms(light, above).shape[1] == 7


def test_each_half_is_scored_with_the_gain_of_the_other():
    rng = np.random.default_rng(3)
    answer = rng.uniform(0.1, 1, (32, 24, 3)).astype(np.float32)
    truth = answer * np.array([1.1, 0.9, 1.0], np.float32)
    np.testing.assert_allclose(gains.crossed(answer, truth), truth, rtol=1e-5)
    half = gains.halves(32, 24)
    assert 0.4 < half.mean() < 0.6
    odd = np.where(half[..., None], truth, answer)
    found = gains.crossed(answer, odd)
    np.testing.assert_allclose(found[half], answer[half], rtol=1e-5)
    np.testing.assert_allclose(found[~half], (answer * [1.1, 0.9, 1.0])[~half], rtol=1e-5)
    # A single texel has no other half.
    np.testing.assert_array_equal(gains.crossed(answer[:1, :1], truth[:1, :1]), answer[:1, :1])
