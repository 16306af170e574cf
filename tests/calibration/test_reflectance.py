"""Demosaicing, lamp, white reference and colours, each against what was put in."""

from __future__ import annotations

import numpy as np
import pytest
from sensors import FakeSensor
from skimage import data
from skimage.transform import resize

from btfkit import colour, directions
from btfkit.calibration import colours, lamp, white
from btfkit.calibration.demosaic import CFAS, demosaic, sites
from btfkit.calibration.merge import BELOW_NOISE, DEAD, SATURATED, VALID, Merged
from btfkit.calibration.noise import NoiseModel
from btfkit.errors import CalibrationError

rng = np.random.default_rng(0)


def scene(h=96, w=128):
    """A linear picture with the detail of gravel and smooth colour."""
    grey = 0.1 + 0.5 * resize(data.gravel(), (4 * h, 4 * w), anti_aliasing=True)
    grey = grey.reshape(h, 4, w, 4).mean((1, 3))
    rows, cols = np.mgrid[:h, :w] / h
    tint = np.stack([0.8 + 0.3 * rows, 1 + 0 * rows, 0.9 - 0.3 * cols], axis=-1)
    return grey[..., None] * tint


def mosaic(picture, cfa, variance=1e-6):
    h, w = picture.shape[:2]
    plane = np.take_along_axis(picture, sites(cfa, (h, w))[..., None], axis=2)[..., 0]
    return Merged(
        plane.astype(np.float32), np.full((h, w), variance, np.float32), np.zeros((h, w), np.uint8)
    )


def psnr(one, other):
    return -10 * np.log10(np.nanmean((one - other)[4:-4, 4:-4] ** 2))


@pytest.mark.parametrize("cfa", CFAS)
def test_demosaicing_keeps_samples_and_beats_the_mean_of_neighbours(cfa):
    picture = scene()
    found = demosaic(mosaic(picture, cfa), cfa).radiance
    own = np.take_along_axis(found, sites(cfa, picture.shape[:2])[..., None], axis=2)[..., 0]
    np.testing.assert_array_equal(own, mosaic(picture, cfa).radiance)
    # One dead pixel in every 5 x 5 leaves the mean of the neighbours alone.
    bilinear = mosaic(picture, cfa)
    holes = np.zeros(picture.shape[:2], bool)
    holes[2::5, 2::5] = True
    bilinear.radiance[holes], bilinear.validity[holes] = np.nan, DEAD
    assert psnr(found, picture) > psnr(demosaic(bilinear, cfa).radiance, picture) + 3
    # The picture has detail up to the finest that pixels can hold.
    assert psnr(found, picture) > 33


def test_demosaicing_is_exact_for_colours_that_change_linearly():
    rows, cols = np.mgrid[:20, :24]
    picture = np.stack([1 + 0.01 * rows, 2 + 0.02 * cols, 3 - 0.01 * rows], axis=-1)
    found = demosaic(mosaic(picture, "GRBG"), "GRBG").radiance
    # float32; the border is mirrored, which bends a slope.
    np.testing.assert_allclose(found[3:-3, 3:-3], picture[3:-3, 3:-3], rtol=1e-6)


def test_balance_lets_the_filter_compare_channels_of_unlike_sensitivity():
    picture, sensor = scene(), np.array([0.45, 1.0, 0.6])
    plane = mosaic(picture * sensor, "RGGB")
    plain = demosaic(plane, "RGGB").radiance / sensor
    balanced = demosaic(plane, "RGGB", balance=sensor).radiance / sensor
    assert psnr(balanced, picture) > psnr(plain, picture) + 2


def test_variance_after_demosaicing_is_the_variance_that_is():
    noise = np.random.default_rng(4).normal(1, 0.01, (200, 200, 3))
    found = demosaic(mosaic(noise, "RGGB", 1e-4), "RGGB")
    for c in range(3):
        for row in range(2):
            for col in range(2):
                at = (slice(4 + row, -4, 2), slice(4 + col, -4, 2), c)
                # 9,000 values: their variance is known to 1.5 %.
                assert found.radiance[at].var() == pytest.approx(
                    found.variance[at].mean(), rel=0.06
                )


def test_a_saturated_pixel_is_lost_alone_and_a_dead_one_is_bridged():
    picture = np.full((16, 16, 3), [0.5, 1.0, 0.7])
    plane = mosaic(picture, "RGGB")
    plane.radiance[6, 6], plane.validity[6, 6] = np.nan, SATURATED
    plane.radiance[10, 3], plane.validity[10, 3] = np.nan, DEAD
    found = demosaic(plane, "RGGB")
    lost = np.isnan(found.radiance).any(axis=-1)
    assert np.argwhere(lost).tolist() == [[6, 6]]
    assert (found.validity[6, 6] == SATURATED).all()
    np.testing.assert_allclose(found.radiance[~lost], picture[~lost], rtol=1e-6)
    assert (found.validity[~lost] == VALID).all()


def test_negative_values_stay_negative_through_demosaicing():
    found = demosaic(mosaic(np.full((8, 8, 3), -0.01), "BGGR"), "BGGR")
    np.testing.assert_allclose(found.radiance, -0.01, rtol=1e-5)
    assert (found.validity == BELOW_NOISE).all()


def test_an_unknown_mosaic_is_refused():
    with pytest.raises(ValueError, match="mosaic 'XTRANS'; expected one of RGGB"):
        demosaic(mosaic(np.ones((8, 8, 3)), "RGGB"), "XTRANS")


def test_the_monitor_is_normalised_to_its_median_and_a_dark_lamp_is_named():
    found = lamp.from_monitor([1.0, 1.02, 0.98], ["a", "b", "c"], [0, 1, 2])
    np.testing.assert_allclose(found.factor, [1.0, 1.02, 0.98])
    assert found.drift == pytest.approx(0.04)
    with pytest.raises(CalibrationError, match=r"b\.png: the lamp monitor read 0\.001, the median"):
        lamp.from_monitor([1, 0.001, 1], ["a.png", "b.png", "c.png"], [0, 1, 2])
    with pytest.raises(CalibrationError, match=r"a\.png: the lamp monitor read nan"):
        lamp.from_monitor([np.nan, 1, 1], ["a.png", "b.png", "c.png"], [0, 1, 2])


def test_drift_is_followed_between_references():
    time = np.linspace(0, 3600, 25)

    def true(t):
        return 1 - 0.05 * np.exp(-t / 900) + 0.01 * np.sin(t / 600)

    level = 80 * true(time) * (1 + np.random.default_rng(1).normal(0, 2e-4, 25))
    at = np.linspace(0, 3600, 301)
    found = lamp.from_references(time, level, 0.016 * np.ones(25), at)
    ratio = found.factor / true(at)
    assert np.std(ratio / ratio.mean()) < 1e-3
    assert 2e-4 < found.sd < 4e-3
    assert not found.note


def test_a_lamp_that_does_not_drift_is_held_constant_and_says_so():
    noise = np.random.default_rng(2).normal(0, 1e-3, 12)
    found = lamp.from_references(np.arange(12), 1 + noise, 1e-3 * np.ones(12), np.arange(40) / 4)
    np.testing.assert_array_equal(found.factor, 1)
    assert "held constant" in found.note


def test_one_reference_says_nothing_of_what_lies_between():
    found = lamp.from_references([5.0], [3.0], [0.01], [0.0, 9.0])
    np.testing.assert_array_equal(found.factor, 1)
    assert "anything" in found.note
    with pytest.raises(CalibrationError, match="0 reference frames"):
        lamp.from_references([], [], [], [0.0])


def test_flicker_between_exposures_is_found_from_their_overlap():
    sensor, photons = FakeSensor(), 10 ** rng.uniform(2, 5.5, (256, 256))
    gain = [1.0, 1.03, 0.97]
    exposure = [0.5, 0.125, 0.031]
    frames = [sensor.shoot(photons * g, t, rng) for g, t in zip(gain, exposure, strict=True)]
    found, sd = lamp.overlap_gains(frames, exposure, NoiseModel(15, 0.4, 4095, 200.0))
    np.testing.assert_allclose(found, gain, atol=1.5e-3)
    assert (sd < 1e-3).all()


def oren_nayar(light, view, albedo=0.99, sigma=0.35):
    """pi times the BRDF of a rough diffuser, its qualitative model; not what the fit is made of."""
    t_l, _ = directions.to_angles(light)
    t_v, _ = directions.to_angles(view)
    side = light[..., 0] * view[..., 0] + light[..., 1] * view[..., 1]
    cos_phi = side / np.maximum(np.sin(t_l) * np.sin(t_v), 1e-9)
    a = 1 - 0.5 * sigma**2 / (sigma**2 + 0.33)
    b = 0.45 * sigma**2 / (sigma**2 + 0.09)
    high, low = np.maximum(t_l, t_v), np.minimum(t_l, t_v)
    return albedo * (a + b * np.maximum(cos_phi, 0) * np.sin(high) * np.tan(low))


def upper(count, steepest, seed):
    r = np.random.default_rng(seed)
    theta = np.arccos(r.uniform(np.cos(np.radians(steepest)), 1, count))
    return directions.from_angles(theta, r.uniform(0, 2 * np.pi, count))


def test_a_lambertian_reference_has_its_reflectance_from_everywhere():
    diffuser = white.lambertian(0.98)
    light, view = upper(20, 85, 1), upper(20, 85, 2)
    np.testing.assert_allclose(diffuser.factor(light, view), 0.98)
    assert diffuser.reflectance(0.5) == pytest.approx(0.98, abs=1e-12)


def test_the_angular_model_follows_a_rough_diffuser_and_its_certificate():
    light, view = upper(400, 70, 3), upper(400, 70, 4)
    table = 0.37 * oren_nayar(light, view)
    found = white.fit_diffuser(light, view, table, reflectance=0.99, theta=np.radians(8))
    assert found.reflectance(np.radians(8)) == pytest.approx(0.99, abs=1e-9)
    light, view = upper(200, 65, 5), upper(200, 65, 6)
    np.testing.assert_allclose(found.factor(light, view), found.factor(view, light), rtol=1e-12)
    true = oren_nayar(light, view)
    ratio = found.factor(light, view) / true
    # Eight smooth terms against a model with a kink at phi = 90 degrees
    assert np.std(ratio / ratio.mean()) < 0.02
    flat = 0.99 / true
    assert np.std(flat / flat.mean()) > 2 * np.std(ratio / ratio.mean())


def test_grey_patches_are_absolute_within_half_a_percent():
    # A fixed camera, a light at several angles and distances, a white that is no Lambertian.
    light, view = upper(12, 60, 7), np.broadcast_to([0.6, 0.0, 0.8], (12, 3))
    distance = np.linspace(300, 330, 12)
    irradiance = (310 / distance) ** 2
    table_light, table_view = upper(300, 60, 8), upper(300, 60, 9)
    table = oren_nayar(table_light, table_view)
    from btfkit.calibration.white import Diffuser

    ideal = white.fit_diffuser(table_light, table_view, table, reflectance=0.99, theta=0.14)
    level = 5000 * (ideal.factor(light, view) * light[:, 2] * irradiance)[:, None] * [0.5, 1, 0.7]
    level *= 1 + np.random.default_rng(1).normal(0, 1e-3, level.shape)
    found = white.fit_scale(
        level, 1e-3 * level, ideal, light=light, view=view, irradiance=irradiance,
        files=[f"{i}.png" for i in range(12)],
    )  # fmt: skip
    grey = np.array([0.03, 0.18, 0.6])[:, None] * 5000 * np.array([0.5, 1, 0.7]) * 1.1
    factor = found.reflectance(grey, np.full(3, 1.1))
    np.testing.assert_allclose(factor, np.array([0.03, 0.18, 0.6])[:, None] * np.ones(3), rtol=5e-3)
    lambert = white.fit_scale(
        level, 1e-3 * level, Diffuser((0.99,)), light=light, view=view, irradiance=irradiance,
        files=[f"{i}.png" for i in range(12)],
    )  # fmt: skip
    assert np.abs(lambert.value / [2500, 5000, 3500] - 1).max() > 5e-3


def test_a_saturated_white_reference_is_named():
    up = np.array([[0, 0, 1.0]] * 2)
    level = np.array([[100.0] * 3, [np.nan] * 3])
    with pytest.raises(CalibrationError, match=r"w1\.png: the white reference saturates"):
        white.fit_scale(
            level, 0.01 * level, white.lambertian(0.99), light=up, view=up,
            files=["w0.png", "w1.png"],
        )  # fmt: skip


def test_white_frames_that_are_missing_dark_or_disagree_are_refused():
    up = np.array([[0, 0, 1.0]] * 4)

    def fit(level):
        level = np.array(level, float).reshape(-1, 1)
        return white.fit_scale(
            level, np.abs(0.01 * level), white.lambertian(0.99), light=up[: len(level)],
            view=up[: len(level)], files="abcd",
        )  # fmt: skip

    with pytest.raises(CalibrationError, match="no white frame: reflectance stays relative"):
        fit([])
    with pytest.raises(CalibrationError, match=r"b: the white reference shows \[-1.0\] counts"):
        fit([10, -1])
    with pytest.raises(CalibrationError, match=r"c: the white reference is \+29.9 % off"):
        fit([10, 10.01, 13, 10])


@pytest.mark.parametrize(
    ("section", "match"),
    [
        ({}, "says no reflectance; add it"),
        ({"reflectance": 99}, "has reflectance 99; expected 0.01 to 1.05"),
        ({"reflectance": "high"}, "is no white reference"),
        ({"reflectance": 0.99, "table": [[1, 2, 3]]}, "is no white reference"),
        ({"reflectance": 0.99, "table": [[0, 0, 0, 1]] * 5}, "5 directions of the white reference"),
        ({"reflectance": 0.99, "table": [[0, 0, 0, 1]] * 50}, "do not tell its 8 terms apart"),
    ],
)
def test_documents_that_describe_no_white_reference_are_refused(section, match):
    with pytest.raises(CalibrationError, match=match):
        white.from_document(section)


def test_a_table_in_degrees_is_that_of_its_directions():
    light, view = upper(60, 60, 1), upper(60, 60, 2)
    t_l, p_l = directions.to_angles(light)
    t_v, p_v = directions.to_angles(view)
    factor = oren_nayar(light, view)
    table = np.stack([*np.degrees([t_l, t_v, p_v - p_l]), factor], axis=-1).tolist()
    found = white.from_document({"reflectance": 0.99, "incidence_deg": 8, "table": table})
    ideal = white.fit_diffuser(light, view, factor, reflectance=0.99, theta=np.radians(8))
    np.testing.assert_allclose(found.factor(view, light), ideal.factor(view, light), rtol=1e-9)


def chart():
    """Linear BT.709 of a ColorChecker under D65, and what a real camera's channels make of it."""
    import colour as science

    camera = science.MSDS_CAMERA_SENSITIVITIES["Nikon 5100 (NPL)"].copy()
    camera = camera.align(science.SpectralShape(400, 700, 10))
    light = science.SDS_ILLUMINANTS["D65"].copy().align(camera.shape).values
    eye = science.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(camera.shape).values
    patches = science.SDS_COLOURCHECKERS["BabelColor Average"].values()
    lit = np.array([p.copy().align(camera.shape).values for p in patches]) * light
    xyz = lit @ eye / (light @ eye[:, 1])
    return lit @ camera.values / (light @ camera.values), colour.xyz_to_rgb(xyz)


def test_lab_and_its_difference_are_those_of_colour_science():
    import colour as science

    _, rgb = chart()
    xyz = colour.rgb_to_xyz(rgb)
    illuminant = science.XYZ_to_xy(colour.rgb_to_xyz(np.ones(3)))
    np.testing.assert_allclose(colours.lab(rgb), science.XYZ_to_Lab(xyz, illuminant), atol=1e-9)


def test_the_root_polynomial_is_that_of_colour_science():
    from colour.characterisation import polynomial_expansion_Finlayson2015

    rgb = rng.random((7, 3))
    ours, theirs = colours.root_polynomial(rgb, 2), polynomial_expansion_Finlayson2015(rgb, 2, True)
    np.testing.assert_allclose(np.sort(ours), np.sort(theirs), rtol=1e-12)


def test_colours_of_a_real_camera_are_corrected_better_than_by_a_matrix():
    camera, rgb = chart()
    found = colours.fit_colour(camera, rgb)
    matrix = colours.fit_colour(camera, rgb, degree=1)
    assert found.degree == 2
    assert found.left_out.mean() < 0.8 < matrix.left_out.mean()


def test_colours_of_a_camera_that_mixes_channels_are_corrected_within_half_a_step():
    _, rgb = chart()
    mix = np.array([[0.7, 0.25, 0.05], [0.15, 0.75, 0.1], [0.02, 0.2, 0.78]])
    camera = rgb @ mix.T * (1 + np.random.default_rng(0).normal(0, 2e-3, rgb.shape))
    found = colours.fit_colour(camera, rgb)
    assert found.left_out.mean() < 0.5


@pytest.mark.parametrize("exposure", [1e-3, 7.0])
def test_the_correction_is_the_same_at_every_exposure(exposure):
    camera, rgb = chart()
    found = colours.fit_colour(camera, rgb)
    np.testing.assert_allclose(found.apply(camera * exposure), found.apply(camera) * exposure)


def test_negative_and_missing_colours_go_through_the_correction():
    camera, rgb = chart()
    found = colours.fit_colour(camera, rgb)
    dark = found.apply(np.array([[-1e-3, 2e-3, 1e-3], [np.nan, 1, 1]]))
    assert np.isfinite(dark[0]).all()
    assert np.isnan(dark[1]).all()


def test_patches_that_are_saturated_few_or_grey_are_refused():
    camera, rgb = chart()
    holed = camera.copy()
    holed[3] = np.nan
    with pytest.raises(CalibrationError, match=r"colour patch 3 reads .*; 1 of 24 patches"):
        colours.fit_colour(holed, rgb)
    with pytest.raises(CalibrationError, match="4 colour patches; at least 5 are needed"):
        colours.fit_colour(camera[:4], rgb[:4])
    grey = np.linspace(0.1, 0.9, 6)[:, None] * np.ones(3)
    with pytest.raises(CalibrationError, match="do not tell colours apart"):
        colours.fit_colour(grey, grey)
