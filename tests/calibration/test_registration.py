"""Sub-pixel registration: textures shifted exactly in frequency, cut out of larger ones."""

import numpy as np
import pytest
from scipy import ndimage

from btfkit.calibration.registration import period_of, register
from btfkit.errors import CalibrationError


def texture(kind, rng, size=384):
    fibres = rng.standard_normal((size, size))
    y, x = np.mgrid[:size, :size]
    if kind in ("sharp", "defocused"):
        blurred = ndimage.gaussian_filter(fibres, 0.7 if kind == "sharp" else 3, mode="wrap")
        return 0.5 + 0.12 * blurred / blurred.std()
    period = size / round(size / {"weave 9": 9, "weave 4": 4}[kind])
    threads = np.sin(2 * np.pi * x / period) + np.cos(2 * np.pi * y / period)
    blurred = ndimage.gaussian_filter(fibres, 1, mode="wrap")
    return 0.5 + 0.1 * threads + 0.03 * blurred / blurred.std()


def shifted(picture, by):
    down, across = (np.fft.fftfreq(size) for size in picture.shape)
    wave = np.exp(-2j * np.pi * (down[:, None] * by[0] + across * by[1]))
    return np.fft.ifft2(np.fft.fft2(picture) * wave).real


@pytest.mark.parametrize(
    ("kind", "within"), [("sharp", 4.0), ("defocused", 4.0), ("weave 9", 4.4), ("weave 4", 1.9)]
)
def test_shifts_are_found_to_a_hundredth_of_a_texel_on_periodic_and_aperiodic_textures(
    kind, within
):
    rng = np.random.default_rng(0)
    off, deviations = [], []
    for _ in range(8):
        picture, by = texture(kind, rng), rng.uniform(-0.9 * within, 0.9 * within, 2)
        first = picture[64:320, 64:320] + 0.01 * rng.standard_normal((256, 256))
        second = 0.8 * shifted(picture, by)[64:320, 64:320] + 0.01 * rng.standard_normal((256, 256))
        found = register(first, second, within=within)
        off.append([found.rows - by[0], found.columns - by[1]])
        deviations.append(found.sd)
        assert found.gain == pytest.approx(0.8, rel=0.02)
    assert np.linalg.norm(off, axis=1).mean() <= 0.01
    # What it says of its own error is that error, within the scatter of sixteen numbers.
    assert 0.4 < np.sqrt(np.mean(np.square(off))) / np.mean(deviations) < 2.5


def test_a_purely_periodic_texture_is_registered_within_its_bound_and_never_a_period_off():
    y, x = np.mgrid[:128, :128]

    def weave(down, across):
        return np.sin(2 * np.pi * (x - across) / 9) + np.cos(2 * np.pi * (y - down) / 9)

    assert period_of(weave(0, 0)) == 9
    found = register(weave(0, 0), weave(-0.7, 4.0), within=4.4)
    assert (found.rows, found.columns) == pytest.approx((-0.7, 4.0), abs=1e-3)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_constant_texture_says_that_it_cannot_tell(noise):
    rng = np.random.default_rng(1)
    first, second = 0.5 + noise * rng.standard_normal((2, 128, 128))
    with pytest.raises(CalibrationError, match=r"constant.*tells a shift|shifted by .* beyond"):
        register(first, second, within=3)


def test_stripes_say_along_which_direction_they_cannot_tell():
    rng = np.random.default_rng(2)
    stripes = np.tile(np.sin(np.arange(128) / 2), (128, 1))
    first, second = stripes + 0.01 * rng.standard_normal((2, 128, 128))
    with pytest.raises(CalibrationError, match="constant along its columns"):
        register(first, second, within=3)


def test_invalid_texels_are_left_out():
    rng = np.random.default_rng(3)
    picture = texture("sharp", rng)
    first, second = picture[64:192, 64:192].copy(), shifted(picture, (0.4, -0.3))[64:192, 64:192]
    first[40:60, 30:80] = np.nan
    second[:, 100:] = np.nan
    found = register(first, second, within=2)
    # Half the area is left of noise-free pictures; the rest is the mask's soft edge.
    assert (found.rows, found.columns) == pytest.approx((0.4, -0.3), abs=0.02)
    with pytest.raises(CalibrationError, match=r"only .* of the texels are valid"):
        register(np.where(np.arange(128) < 20, first, np.nan), second, within=2)


def test_a_shift_beyond_the_bound_is_refused():
    picture = texture("sharp", np.random.default_rng(4))
    first, second = picture[64:192, 64:192], shifted(picture, (5.0, 0.0))[64:192, 64:192]
    with pytest.raises(CalibrationError, match=r"beyond the bound of 3|constant"):
        register(first, second, within=3)
    for bad in (0.0, 40.0):
        with pytest.raises(ValueError, match="quarter"):
            register(first, second, within=bad)
    with pytest.raises(ValueError, match="expected two"):
        register(first, second[1:], within=3)


def test_a_texture_without_period_has_none():
    assert period_of(texture("sharp", np.random.default_rng(5))) is None
    assert period_of(np.full((64, 64), 0.3)) is None
