"""Lambert under a gloss, fitted a texel: the kernel against its twin, and against the tracer."""

from __future__ import annotations

import numpy as np
import pytest

from btfkit import directions, native
from btfkit.native.lobe import Lobes, Start, _model, _packed, fit_lobes, shaded, shaded_plain
from btfkit.relief.relief import Relief
from btfkit.relief.trace import answer

compiled = pytest.mark.skipif(native.load("lobe") is None, reason="the kernel was not built")
LIGHT = directions.bonn81().astype(np.float32)
VIEW = np.tile(np.float32([0, 0, 1]), (81, 1))


def texels(count: int, channels: int, seed: int = 0) -> Start:
    rng = np.random.default_rng(seed)
    return Start(
        rng.normal(0, 0.35, (count, 2)).astype(np.float32),
        rng.uniform(0.2, 0.6, count).astype(np.float32),
        rng.uniform(0.1, 0.6, (count, channels)).astype(np.float32),
        np.full((count, channels), 0.06, np.float32),
    )


def begun(truth: Start, seed: int = 1) -> Start:
    rng = np.random.default_rng(seed)
    slope = truth.slope + rng.normal(0, 0.1, truth.slope.shape)
    return Start(
        slope.astype(np.float32),
        np.full_like(truth.roughness, 0.4),
        np.full_like(truth.albedo, 0.3),
        np.full_like(truth.specular, 0.04),
    )


def spoiled(values: np.ndarray, share: float, seed: int = 2) -> np.ndarray:
    """Values with noise, some in shadow, some not measured."""
    rng = np.random.default_rng(seed)
    noisy = values + rng.normal(0, 0.002, values.shape)
    noisy[rng.random(values.shape[:2]) < share] = 0
    noisy[rng.random(values.shape[:2]) < 0.02] = np.nan
    return noisy.astype(np.float32)


@compiled
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("near", [False, True])
@pytest.mark.parametrize("slopes", [True, False])
def test_kernel_and_twin_fit_the_same(
    channels: int, near: bool, slopes: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = texels(40, channels)
    values = spoiled(shaded_plain(truth, LIGHT, VIEW), 0.15)
    weight = np.ones(values.shape[:2], np.float32)
    light = LIGHT * 500 if near else LIGHT
    place = np.random.default_rng(3).normal(0, 20, (40, 3)).astype(np.float32)

    def fit() -> Lobes:
        return fit_lobes(
            values,
            weight,
            light,
            VIEW,
            begun(truth),
            slopes=slopes,
            place=place,
            near=(near, False),
        )

    ours = fit()
    monkeypatch.setenv("BTFKIT_PLAIN", "1")
    theirs = fit()
    for name in Lobes._fields:
        # float32 against float64; a step that is taken or not at the limit moves a texel by 1e-3
        off = np.abs(getattr(ours, name) - getattr(theirs, name))
        assert np.median(off) < 1e-5, name
        assert np.quantile(off, 0.98) < 2e-3, name


def test_derivatives_are_those_of_the_answers() -> None:
    theta = _packed(texels(6, 3)).astype(float)
    rays = [np.broadcast_to(d.astype(float), (6, 81, 3)) for d in (LIGHT, VIEW)]
    zero = np.zeros((6, 81, 3))
    base, rows = _model(theta, rays[0], rays[1], zero)
    for column, row, channel in ((0, 0, 0), (1, 1, 2), (2, 2, 1), (3, 3, 0), (8, 4, 2)):
        moved = theta.copy()
        moved[:, column] += 1e-6
        numeric = (_model(moved, rays[0], rays[1], zero)[0] - base)[..., channel] / 1e-6
        # one-sided differences in float64: the second derivative times 1e-6
        np.testing.assert_allclose(rows[:, :, channel, row], numeric, atol=5e-5)


@compiled
def test_answers_are_the_twins_and_the_tracers() -> None:
    lobes = Start(
        np.zeros((1, 2), np.float32), np.float32([0.3]), np.float32([[0.5]]), np.float32([[0.05]])
    )
    view = np.tile(directions.from_angles(0.6, 1.1).astype(np.float32), (81, 1))
    ours = shaded(lobes, LIGHT, view)[0, :, 0]
    # float32 against float64
    np.testing.assert_allclose(ours, shaded_plain(lobes, LIGHT, view)[0, :, 0], rtol=2e-5)
    flat = np.ones((8, 8, 3), np.float32)
    relief = Relief(0 * flat[..., 0], 0.5 * flat, 0.05 * flat, 0.3 * flat[..., 0])
    traced = answer(relief, [0.5, 0.5], LIGHT, view, samples=1).reflectance[:, 0]
    np.testing.assert_allclose(ours, traced, rtol=1e-4)


def test_shadows_and_missing_values_leave_the_normal_alone() -> None:
    truth = texels(60, 1)
    values = spoiled(shaded_plain(truth, LIGHT, VIEW), 0.25)
    found = fit_lobes(values, np.ones(values.shape[:2], np.float32), LIGHT, VIEW, begun(truth))
    off = np.linalg.norm(found.slope - truth.slope, axis=1)
    # noise of 0.002 over some 50 values of about 0.3
    assert np.median(off) < 0.004
    # those in shadow and those not measured; attached shadows fit as they are
    assert 0.6 < np.median(found.kept) < 0.9


def test_too_few_values_are_no_fit() -> None:
    truth = texels(2, 1)
    values = shaded_plain(truth, LIGHT, VIEW)
    values[0, 2:] = np.nan
    found = fit_lobes(values, np.ones(values.shape[:2], np.float32), LIGHT, VIEW, begun(truth))
    assert np.isnan(found.deviation[0])
    assert np.isfinite(found.deviation[1])
