"""Noise models fitted from frames of a made-up sensor, against what it was made of."""

from __future__ import annotations

import numpy as np
import pytest
from sensors import FakeSensor

from btfkit.calibration.dark import fit_dark, unrounded_variance
from btfkit.calibration.noise import NoiseModel
from btfkit.calibration.response import fit_linearity, fit_sensitivity
from btfkit.calibration.transfer import (
    exposure_pairs,
    lacks_photon_noise,
    photon_transfer,
)
from btfkit.errors import CalibrationError

SIZE = (192, 256)
ROWS, COLS = np.mgrid[: SIZE[0], : SIZE[1]]
SHADING = 1 - 0.3 * ((ROWS / 191 - 0.5) ** 2 + (COLS / 255 - 0.5) ** 2) * 2
NOISE = NoiseModel(15, 0.4, 4095, 200.0)


def darks(sensor, exposure, temperature, seed=0, offset=0.0):
    rng = np.random.default_rng(seed)
    none = np.zeros(SIZE)
    return [
        sensor.shoot(none, t, rng, temperature_c=c, offset=offset)
        for t, c in zip(exposure, temperature, strict=True)
    ]


def flat_pairs(sensor, exposure, seed=0, drift=1.003):
    rng = np.random.default_rng(seed)
    return [
        (sensor.shoot(4e4 * SHADING, t, rng), sensor.shoot(4e4 * drift * SHADING, t, rng))
        for t in exposure
    ]


def test_dark_current_black_and_read_noise_are_those_of_the_sensor():
    sensor = FakeSensor(dark_e_s=30)
    exposure = [0.01, 0.01, 0.1, 0.1, 1, 1, 4, 4]
    temperature = [20, 20.1, 21, 22, 24, 26, 28, 29]
    pattern = np.random.default_rng(3).normal(0, 0.3, SIZE)
    found = fit_dark(darks(sensor, exposure, temperature, offset=pattern), exposure, temperature)
    # 50,000 pixels of half a count each
    assert found.black.mean() == pytest.approx(200, abs=0.02)
    assert found.rate(24) == pytest.approx(2.0, rel=0.01)
    assert found.rate(30) == pytest.approx(4.0, rel=0.02)
    assert found.doubling_k == pytest.approx(6, abs=0.1)
    assert found.read == pytest.approx(0.4, rel=0.02)
    assert np.corrcoef(found.black.ravel(), pattern.ravel())[0, 1] > 0.7
    assert not found.fitted.held


def test_without_a_range_of_temperatures_the_doubling_is_held_and_named():
    sensor = FakeSensor(dark_e_s=30)
    found = fit_dark(darks(sensor, [0.1, 1, 4], [24] * 3), [0.1, 1, 4])
    assert found.rate() == pytest.approx(2.0, rel=0.02)
    assert "less than 3 kelvin" in found.fitted.held["doubling_k"]
    assert found.read is None


def test_darks_of_one_exposure_tell_no_current_and_say_so():
    found = fit_dark(darks(FakeSensor(dark_e_s=30), [1, 1], [24] * 2), [1, 1])
    assert found.current == 0
    assert "same exposure" in found.fitted.held["current"]
    assert found.black.mean() == pytest.approx(202, abs=0.05)


def test_hot_pixels_are_found_and_do_not_move_the_level():
    sensor = FakeSensor()
    frames = darks(sensor, [1, 1, 2], [24] * 3)
    for frame in frames:
        frame[5, 9] = frame[100, 3] = 3000
    found = fit_dark(frames, [1, 1, 2])
    assert found.hot[5, 9]
    assert found.hot[100, 3]
    assert found.hot.sum() == 2
    assert found.black.mean() == pytest.approx(200, abs=0.02)


def test_few_darks_do_not_bring_their_noise_into_the_black_level():
    found = fit_dark(darks(FakeSensor(), [1, 1], [24] * 2), [1, 1])
    # Two frames of 0.5 counts have a mean of 0.35; a sensor without pattern has none.
    assert found.black.std() < 0.1


@pytest.mark.parametrize("phase", [0.0, 0.25, 0.5])
@pytest.mark.parametrize("deviation", [0.3, 0.4, 0.6, 2.0])
def test_rounding_is_taken_out_of_noise_below_a_count(phase, deviation):
    x = np.rint(np.random.default_rng(0).normal(40 + phase, deviation, 200_000))
    found = unrounded_variance(float(x.mean()), float(x.var()))
    # The deviation of 200,000 values is known to 0.2 %; rounding hides some of it.
    assert np.sqrt(found) == pytest.approx(deviation, rel=0.01)


def test_photon_transfer_finds_gain_and_read_noise():
    pairs = flat_pairs(FakeSensor(), (0.02, 0.1, 0.4, 1, 1.4))
    found = photon_transfer(pairs, 200.0, 4095, read=0.4)
    assert found.gain == pytest.approx(15, abs=4 * found.fitted.sd["gain_e_per_count"])
    assert found.gain == pytest.approx(15, rel=0.01)
    free = photon_transfer(pairs, 200.0, 4095)
    assert free.gain == pytest.approx(15, rel=0.01)
    # At 50 counts of signal shot noise is five times the read noise.
    assert free.read == pytest.approx(0.4, abs=0.1)
    assert free.fitted.condition < 1e3


def test_frames_without_photon_noise_are_told_from_those_with_it():
    pairs = flat_pairs(FakeSensor(), (0.02, 0.1, 0.4, 1))
    assert not lacks_photon_noise(pairs, 200.0, 4095)
    mean = [np.rint(200 + 1500 * t * SHADING).astype(np.uint16) for t in (0.1, 0.4, 1)]
    assert lacks_photon_noise([(frame, frame) for frame in mean], 200.0, 4095)
    # Read noise alone is the same everywhere; known from the darks, it leaves nothing.
    rng = np.random.default_rng(0)
    quiet = [[frame + np.rint(rng.normal(0, 2, SIZE)) for _ in range(2)] for frame in mean]
    assert lacks_photon_noise([tuple(pair) for pair in quiet], 200.0, 4095, read=2.01)
    # Frames that saturate say neither.
    full = np.full(SIZE, 4095, np.uint16)
    assert not lacks_photon_noise([(full, full)], 200.0, 4095)


def test_photon_transfer_leaves_a_pair_out_that_moved():
    pairs = flat_pairs(FakeSensor(), (0.02, 0.1, 0.4, 1))
    pairs[1] = (pairs[1][0], np.roll(pairs[2][0], 40, axis=1) // 4)
    found = photon_transfer(pairs, 200.0, 4095, read=0.4)
    assert found.gain == pytest.approx(15, rel=0.02)
    assert not found.used.all()


def test_variance_0_copies_of_one_frame_are_refused():
    frame = flat_pairs(FakeSensor(), (0.4,))[0][0]
    with pytest.raises(CalibrationError, match="do not differ"):
        photon_transfer([(frame, frame)], 200.0, 4095, read=0.4)


def test_saturated_flats_are_refused():
    pairs = flat_pairs(FakeSensor(), (40.0,))
    with pytest.raises(CalibrationError, match="none of 1 pairs of flat frames has 200 pixels"):
        photon_transfer(pairs, 200.0, 4095)


def test_one_level_of_light_tells_no_gain_without_darks():
    rng = np.random.default_rng(0)
    even = [FakeSensor().shoot(np.full(SIZE, 2e4), 1, rng) for _ in range(2)]
    with pytest.raises(CalibrationError, match="cannot be told apart; add dark frames"):
        photon_transfer([tuple(even)], 200.0, 4095)


def test_noise_that_does_not_grow_with_signal_is_refused():
    rng = np.random.default_rng(0)
    pairs = [tuple(200 + s + rng.normal(0, 5 - s / 500, SIZE) for _ in "ab") for s in (100, 1500)]
    with pytest.raises(CalibrationError, match="does not grow with their signal"):
        photon_transfer(pairs, 200.0, 4095)


def test_pairs_are_frames_of_one_exposure_and_group():
    assert exposure_pairs([1, 2, 1, 1, 2], [0, 0, 0, 0, 1]) == [(0, 2)]


@pytest.mark.parametrize("bend", [0.0, 0.02])
def test_linearity_is_found_within_a_tenth_of_a_percent(bend):
    sensor, rng = FakeSensor(bend=bend), np.random.default_rng(1)
    exposure = [0.02, 0.05, 0.1, 0.2, 0.4, 0.8, 1.2, 1.4]
    frames = [sensor.shoot(4e4 * SHADING, t, rng) for t in exposure]
    found = fit_linearity(frames, exposure, NOISE)
    assert found.after < 1e-3
    assert found.curve[0] == pytest.approx(bend, abs=2e-3)
    assert (found.before > 5e-3) == (bend > 0)


def test_linearity_needs_a_ramp():
    frames = [FakeSensor().shoot(4e4 * SHADING, t, np.random.default_rng(0)) for t in (1, 1)]
    with pytest.raises(CalibrationError, match="at 1 usable exposures from 1 to 1 s"):
        fit_linearity(frames, [1, 1], NOISE)
    bright = [np.full(SIZE, 4095, np.uint16)] * 3
    with pytest.raises(CalibrationError, match="at 0 usable exposures"):
        fit_linearity(bright, [1, 2, 8], NOISE)


@pytest.mark.parametrize("period", [(1, 1), (2, 2)])
def test_sensitivity_of_pixels_is_told_from_the_shading_of_the_lens(period):
    rng = np.random.default_rng(2)
    pixel = 1 + rng.normal(0, 0.01, SIZE)
    pixel[7, 11] = 0.01
    colour = np.ones(SIZE)
    if period == (2, 2):
        colour[::2, ::2], colour[1::2, 1::2] = 0.6, 0.4
    frames = [FakeSensor().shoot(5e4 * SHADING * colour * pixel, 1, rng) for _ in range(6)]
    found = fit_sensitivity(frames, [1] * 6, NOISE, period=period)
    assert found.dead == 1
    assert found.pixel[7, 11] == 0
    assert found.sd == pytest.approx(0.01, rel=0.05)
    good = found.pixel > 0
    # Noise of six frames is 0.002 to 0.004; a tenth of a percent is the smooth part's.
    assert np.std(found.pixel[good] / pixel[good]) < 1.2 * found.noise + 1e-3


def test_flats_that_saturate_everywhere_are_refused():
    with pytest.raises(CalibrationError, match="all 1 flat frames saturate everywhere"):
        fit_sensitivity([np.full(SIZE, 4095)], [1], NOISE, period=(1, 1))


def test_sizes_that_differ_are_refused_by_frame():
    with pytest.raises(CalibrationError, match=r"dark frame 1 has shape \(3, 3\)"):
        fit_dark([np.zeros((4, 4)), np.zeros((3, 3))], [1, 1])
    with pytest.raises(CalibrationError, match="0 dark frames"):
        fit_dark([], [])
    with pytest.raises(CalibrationError, match="flat pair 0 has frames of"):
        photon_transfer([(np.zeros((4, 4)), np.zeros((3, 3)))], 0, 100)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"gain": 0.0}, "has gain 0; expected a positive number"),
        ({"gain": float("nan")}, "has gain nan"),
        ({"black": 5000.0}, "leave no range between them"),
    ],
)
def test_noise_models_that_no_sensor_has_are_refused(change, match):
    with pytest.raises(CalibrationError, match=match):
        NoiseModel(**{"gain": 15, "read": 0.4, "white": 4095, "black": 200.0} | change)
