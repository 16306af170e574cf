"""Merging against the bound of the noise it is made of, and in the corners where it may fail."""

from __future__ import annotations

import numpy as np
import pytest
from sensors import FakeSensor, information

from btfkit.calibration.exposures import refine_exposures
from btfkit.calibration.merge import (
    BELOW_NOISE,
    DEAD,
    SATURATED,
    VALID,
    merge_exposures,
    merge_plainly,
)  # fmt: skip
from btfkit.calibration.noise import NoiseModel
from btfkit.errors import CalibrationError

SENSOR = FakeSensor()
NOISE = NoiseModel(gain=15, read=6 / 15, white=4095, black=200.0)
EXPOSURE = np.array([1, 1 / 4, 1 / 16, 1 / 64])


def bracket(photons, seed=0, exposure=EXPOSURE):
    rng = np.random.default_rng(seed)
    return [SENSOR.shoot(photons, t, rng) for t in exposure]


def five_decades(size=512, seed=1):
    return 10 ** np.random.default_rng(seed).uniform(np.log10(20), np.log10(2e6), (size, size))


@pytest.mark.parametrize("decade", [20, 200, 2e3, 2e4, 2e5])
def test_deviation_is_within_3_percent_of_the_cramer_rao_bound_in_every_decade(decade):
    rng = np.random.default_rng(int(decade))
    photons = 10 ** rng.uniform(np.log10(decade), np.log10(10 * decade), (500, 500))
    merged = merge_exposures(bracket(photons, seed=2), EXPOSURE, NOISE)
    error = 15 * merged.radiance / photons - 1
    # The exact information of rounded, clipped counts, on a grid of radiances.
    grid = np.geomspace(decade, 10 * decade, 80)
    bound = []
    for x in grid:
        told = sum(
            information(200 + x * t / 15, (36 + x * t) / 225, t / 15, t / 225, 4095)
            for t in EXPOSURE
        )
        bound.append(1 / told / x**2)
    deviation = np.sqrt(np.mean(error**2))
    # 250,000 pixels: the deviation itself is known to 0.3 %, its mean to 0.0005.
    assert deviation < 1.03 * np.sqrt(np.mean(bound))
    assert abs(error.mean()) < 0.01
    # The variance that is said is the variance that is.
    said = np.sqrt(np.mean(merged.variance * 225 / photons**2))
    assert said == pytest.approx(deviation, rel=0.03)


def test_the_blocked_merge_agrees_with_its_plain_twin():
    rng = np.random.default_rng(5)
    photons = five_decades(200)
    photons[:3] = 1e7
    noise = NoiseModel(
        15, 0.4, 4095, black=200 + rng.normal(0, 0.3, photons.shape), dark=2.0,
        sensitivity=1 + rng.normal(0, 0.01, photons.shape), curve=(0.01, 0.002),
    )  # fmt: skip
    lamp = [1.0, 0.98, 1.01, 1.0]
    fast = merge_exposures(bracket(photons), EXPOSURE, noise, lamp=lamp)
    plain = merge_plainly(bracket(photons), EXPOSURE, noise, lamp=lamp)
    np.testing.assert_array_equal(fast.validity, plain.validity)
    seen = np.isfinite(plain.radiance)
    # Three rounds against fifty: the rest is a hundredth of the noise.
    off = np.abs(fast.radiance - plain.radiance)[seen] / np.sqrt(plain.variance[seen])
    assert off.max() < 0.01


def test_the_order_of_the_frames_does_not_matter():
    frames = bracket(five_decades(64))
    one = merge_exposures(frames, EXPOSURE, NOISE)
    two = merge_exposures(frames[::-1], EXPOSURE[::-1], NOISE)
    np.testing.assert_array_equal(one.radiance, two.radiance)


def test_a_brighter_lamp_and_a_longer_exposure_are_the_same_to_the_merge():
    photons = np.full((200, 200), 3000.0)
    frames = bracket(photons, exposure=[1.1, 0.25])
    lamp = merge_exposures(frames, [1.0, 0.25], NOISE, lamp=[1.1, 1.0])
    assert 15 * lamp.radiance.mean() == pytest.approx(3000, rel=1e-3)


def test_all_samples_saturated_are_not_a_number_and_counted():
    photons = np.full((8, 8), 100.0)
    photons[2, 3:5] = 1e9
    merged = merge_exposures(bracket(photons), EXPOSURE, NOISE)
    assert merged.counts()["saturated"] == 2
    assert np.isnan(merged.radiance[2, 3:5]).all()
    assert np.isinf(merged.variance[2, 3:5]).all()
    assert np.isfinite(np.delete(merged.radiance.ravel(), [19, 20])).all()


def test_all_samples_below_the_noise_keep_their_mean_and_their_negative_values():
    photons = np.full((300, 300), 0.2)
    merged = merge_exposures(bracket(photons), EXPOSURE, NOISE)
    assert (merged.radiance < 0).mean() > 0.3
    assert (merged.validity == BELOW_NOISE).mean() > 0.8
    # 90,000 pixels of 0.5 counts a second
    assert merged.radiance.mean() == pytest.approx(0.2 / 15, abs=0.006)


def test_negative_radiance_has_the_variance_of_no_light():
    merged = merge_exposures([np.full((2, 2), 190, np.uint16)], [0.5], NOISE)
    assert merged.radiance.tolist() == [[-20, -20]] * 2
    np.testing.assert_allclose(merged.variance, NOISE.floor / 0.25, rtol=1e-6)
    assert (merged.validity == BELOW_NOISE).all()


def test_one_exposure_only_is_that_exposure():
    frame = SENSOR.shoot(np.full((9, 7), 5000.0), 0.5, np.random.default_rng(0))
    merged = merge_exposures([frame], [0.5], NOISE)
    np.testing.assert_allclose(merged.radiance, (frame - 200.0) / 0.5, rtol=1e-6)
    assert (merged.validity == VALID).all()


def test_variance_zero_is_never_said_even_of_a_noiseless_sensor():
    quiet = NoiseModel(gain=1e12, read=0.0, white=4095, black=200.0)
    merged = merge_exposures([np.full((2, 2), 1200)] * 2, [1, 0.5], quiet)
    assert (merged.variance > 0).all()
    assert np.isfinite(merged.radiance).all()


def test_pixels_without_a_finite_count_are_dead_and_infinity_does_not_spread():
    frames = [f.astype(np.float32) for f in bracket(np.full((4, 4), 900.0))]
    for frame in frames:
        frame[0, 0] = np.nan
        frame[0, 1] = -np.inf
    frames[1][3, 3] = np.inf
    merged = merge_exposures(frames, EXPOSURE, NOISE)
    assert merged.validity[0, :2].tolist() == [DEAD, DEAD]
    assert merged.counts()["dead"] == 2
    assert np.isfinite(merged.radiance[3, 3])
    assert merge_plainly(frames, EXPOSURE, NOISE).validity.tolist() == merged.validity.tolist()


def test_a_pixel_of_no_sensitivity_is_dead():
    sensitivity = np.ones((3, 3))
    sensitivity[1, 1] = 0
    noise = NoiseModel(15, 0.4, 4095, 200.0, sensitivity=sensitivity)
    merged = merge_exposures(bracket(np.full((3, 3), 900.0)), EXPOSURE, noise)
    assert merged.validity[1, 1] == DEAD
    assert merged.counts()["dead"] == 1
    assert merged.counts()["saturated"] == 0


def test_counts_near_saturation_are_not_chosen_by_their_own_noise():
    # Half of the longest exposure's counts are cut off: those that are not are all too low.
    photons = np.full((300, 300), 3893.0 * 15)
    merged = merge_exposures(bracket(photons), EXPOSURE, NOISE)
    error = 15 * merged.radiance.mean() / photons[0, 0] - 1
    # The deviation of a pixel is 1 %; a twentieth of it may be bias.
    assert abs(error) < 5e-4
    assert SATURATED not in merged.validity


def test_colours_of_a_pixel_are_merged_each_by_itself():
    photons = np.full((40, 40, 3), [100.0, 1e4, 1e6])
    merged = merge_exposures(bracket(photons), EXPOSURE, NOISE)
    assert merged.radiance.shape == (40, 40, 3)
    np.testing.assert_allclose(15 * merged.radiance.mean((0, 1)) / [100, 1e4, 1e6], 1, atol=0.01)


@pytest.mark.parametrize(
    ("frames", "exposure", "match"),
    [
        ([np.zeros((4, 4)), np.zeros((4, 5))], [1, 2], r"frame 1 .* shape \(4, 5\), the first"),
        ([np.zeros((4, 4))], [1, 2], "1 frames and 2 exposure times"),
        ([np.zeros((4, 4))], [0.0], "frame 0 .* exposure time 0; expected a positive"),
        ([], [], "0 frames and 0"),
    ],
)
def test_series_that_contradict_themselves_are_refused(frames, exposure, match):
    with pytest.raises(CalibrationError, match=match):
        merge_exposures(frames, exposure, NOISE)


def test_maps_of_another_sensor_are_refused():
    noise = NoiseModel(15, 0.4, 4095, np.full((2, 2), 200.0))
    with pytest.raises(CalibrationError, match=r"map of the sensor is \(2, 2\), the frames are"):
        merge_exposures([np.zeros((4, 4))], [1.0], noise)


def test_exposure_times_are_found_from_overlaps():
    true = EXPOSURE * [1, 1.04, 0.96, 1.005]
    frames = [bracket(five_decades(256, seed), seed, true) for seed in (1, 2)]
    found = refine_exposures(frames, EXPOSURE, NOISE)
    off = np.abs(found.factor / [1, 1.04, 0.96, 1.005] - 1)
    assert (off < np.maximum(4 * found.sd, 1e-9)).all()
    assert off.max() < 1e-3


def test_exposures_without_overlap_are_named():
    frames = [bracket(np.full((64, 64), 100.0), exposure=[1, 1e-3])]
    with pytest.raises(CalibrationError, match=r"exposures 1 s and 0\.001 s share 0 pixels"):
        refine_exposures(frames, [1, 1e-3], NOISE)
