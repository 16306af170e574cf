"""Lights from photographs of mirror spheres, against the lamps that the photographs were made with."""

from __future__ import annotations

import functools

import cv2
import numpy as np
import pytest
from balls import Scene, dome, gravel

import btfkit
from btfkit.calibration import falloff, photographs
from btfkit.calibration.highlights import Spot
from btfkit.calibration.lights import locate
from btfkit.calibration.rti import calibrate_lights
from btfkit.calibration.spheres import Optics, find_spheres
from btfkit.colour import to_srgb
from btfkit.errors import CalibrationError

pytestmark = pytest.mark.slow

THREE = (((-45, 25), 12.5), ((40, -22), 12.5), ((35, 28), 10.0))
FAR = Scene(THREE, width=480, height=320)
NEAR = Scene(THREE, width=480, height=320, camera_mm=800.0)
LAMPS = dome(8, lowest=30)


@functools.cache
def pictures(scene):
    return [scene.photograph(lamp, i) for i, lamp in enumerate(LAMPS)]


def write(folder, taken, suffix=".png"):
    folder.mkdir(parents=True, exist_ok=True)
    for i, picture in enumerate(taken):
        codes = np.rint(255 * to_srgb(picture)).astype(np.uint8)
        cv2.imwrite(str(folder / f"light {i + 1}{suffix}"), codes)
    return folder


def angles(directions, lamps):
    true = lamps / np.linalg.norm(lamps, axis=1, keepdims=True)
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return np.degrees(np.arccos(np.clip(np.sum(unit * true, axis=1), -1, 1)))


@pytest.mark.parametrize("scene", [FAR, NEAR])
@pytest.mark.slow
def test_outlines_are_found_to_a_twentieth_of_a_pixel(scene):
    stack = np.stack(pictures(scene))
    optics = Optics(scene.width, scene.height, scene.focal_px())
    found = find_spheres([stack.mean(0), stack.max(0), stack.std(0)], optics)
    for (x, y), r in THREE:
        # A far camera sees every sphere where it is; a near one sees its centre at its height.
        scale = 4.0 if scene.camera_mm is None else 4 * 800 / (800 - r)
        at = np.array([239.5 + x * scale, 159.5 - y * scale])
        near = min(found, key=lambda s: np.hypot(*(s.pixel - at)))
        assert near.coverage > 0.9
        if scene.camera_mm is None:
            np.testing.assert_allclose(near.pixel, at, atol=0.05)
            assert near.radius_px == pytest.approx(4 * r, abs=0.06)
            continue
        seen = near.centre / near.centre[2] * -optics.focal_px
        np.testing.assert_allclose(seen[:2] * [1, -1] + [239.5, 159.5], at, atol=0.05)
        assert near.axis_ratio > 1.0005


def test_lights_before_a_near_camera_are_found_with_their_positions(tmp_path):
    folder = write(tmp_path / "dome", pictures(NEAR))
    found = calibrate_lights(folder, sphere_mm=25.0, focal_px=NEAR.focal_px())
    assert len(found.spheres) == 3
    assert found.unit == "mm"
    positions = np.array([light.position for light in found.lights])
    assert angles(positions, LAMPS).max() < 0.5
    off = np.linalg.norm(positions - LAMPS, axis=1)
    # 400 mm away, seen on spheres of 50 pixels' radius 90 mm apart.
    assert np.sqrt(np.mean(off**2)) < 12
    said = np.array([light.distance_sd * 400 for light in found.lights])
    assert (off < 4 * said + 4).all()
    truth = np.sqrt(np.mean(angles(positions, LAMPS) ** 2))
    assert 0.3 * truth < found.error_deg < 5 * truth + 0.05


def test_the_light_file_of_a_folder_is_read_back_as_a_btf(tmp_path):
    folder = write(tmp_path / "dome", pictures(FAR))
    found = calibrate_lights(folder)
    assert found.unit == "px"
    found.write_lp(tmp_path / "dome" / "lights.lp")
    btf = btfkit.open(tmp_path / "dome" / "lights.lp")
    assert len(btf) == len(LAMPS)
    # Natural order: "light 10" after "light 9"; these are one digit.
    assert angles(btf.light, LAMPS).max() < 0.8
    assert btf.texture(0).shape == (320, 480, 1)
    record = found.record()
    assert record["lights"] == record["positions"] == 8
    assert record["without_light"] == []


@pytest.mark.slow
def test_one_sphere_tells_directions_and_says_that_it_knows_no_distance(tmp_path):
    scene = Scene((((0, 0), 20.0),), width=360, height=360)
    folder = write(tmp_path / "one", [scene.photograph(x, i) for i, x in enumerate(LAMPS[:4])])
    found = calibrate_lights(folder, sphere_mm=40)
    assert all(light.position is None for light in found.lights)
    assert "one sphere tells no distance" in found.lights[0].note
    directions = np.array([light.direction for light in found.lights])
    # The lamp is 400 mm from the table, and the sphere's surface 40 mm above it: parallax.
    assert angles(directions, LAMPS[:4] - [0, 0, 20]).max() < 2.5


def test_spheres_photographed_before_the_object_give_its_lights(tmp_path):
    balls = write(tmp_path / "balls", pictures(FAR)[:3])
    objects = tmp_path / "object"
    objects.mkdir()
    for i in range(3):
        cv2.imwrite(str(objects / f"coin_{i}.png"), np.full((200, 300, 3), 50 + i, np.uint8))
    found = calibrate_lights(objects, spheres=balls)
    assert [p.name for p in found.files] == ["coin_0.png", "coin_1.png", "coin_2.png"]
    assert angles(np.array([x.direction for x in found.lights]), LAMPS[:3]).max() < 0.8
    (objects / "coin_2.png").unlink()
    with pytest.raises(CalibrationError, match="3 photographs of spheres for 2 of the object"):
        calibrate_lights(objects, spheres=balls)


def test_a_photograph_without_a_light_is_left_out_and_named(tmp_path):
    taken = [*pictures(FAR)[:4], 0.02 * pictures(FAR)[0]]
    folder = write(tmp_path / "dark", taken)
    with pytest.warns(UserWarning, match="1 of 5 photographs show no light .* 'light 5.png'"):
        found = calibrate_lights(folder)
    assert found.lights[4] is None
    found.write_lp(folder / "x.lp")
    assert (folder / "x.lp").read_text().startswith("4\nlight 1.png ")


def test_photographs_without_a_sphere_are_refused(tmp_path):
    plain = [np.full((120, 160), 0.3) for _ in range(3)]
    folder = write(tmp_path / "none", plain)
    with pytest.raises(CalibrationError, match="no mirror sphere is seen; a shiny ball"):
        calibrate_lights(folder)


def test_a_printed_disc_is_no_mirror(tmp_path):
    rows, cols = np.mgrid[:200, :240]
    disc = np.hypot(rows - 100, cols - 120) < 40
    taken = [np.where(disc, 0.05, 0.5 + 0.05 * i) for i in range(4)]
    for picture in taken:
        picture[98:101, 119:122] = 1.0
    folder = write(tmp_path / "disc", taken)
    with pytest.raises(CalibrationError, match="round outlines: no mirror sphere is seen"):
        calibrate_lights(folder)


def test_photographs_of_another_size_are_named(tmp_path):
    folder = write(tmp_path / "sizes", pictures(FAR)[:2])
    cv2.imwrite(str(folder / "light 3.png"), np.zeros((10, 12), np.uint8))
    with pytest.raises(CalibrationError, match=r"light 3\.png: 12 x 10 pixels; the first"):
        calibrate_lights(folder)


def test_folders_without_photographs_are_refused(tmp_path):
    with pytest.raises(CalibrationError, match="no photographs; expected"):
        photographs.listed(tmp_path)
    (tmp_path / "a.nef").write_bytes(b"x")
    assert [p.name for p in photographs.listed(tmp_path)] == ["a.nef"]
    (tmp_path / "a.jpg").write_bytes(b"x")
    assert [p.name for p in photographs.listed(tmp_path)] == ["a.jpg"]


def test_numbers_in_names_count_as_numbers(tmp_path):
    for name in ("p10.png", "p2.png", "P1.png", "._p3.png"):
        (tmp_path / name).write_bytes(b"")
    assert [p.name for p in photographs.listed(tmp_path)] == ["P1.png", "p2.png", "p10.png"]


def spots(lamp, places, sd=2e-3, seed=0):
    rng = np.random.default_rng(seed)
    found = []
    for place in np.array(places, float):
        light = lamp - place
        light = light / np.linalg.norm(light) + rng.normal(0, sd, 3)
        found.append(Spot(place, light / np.linalg.norm(light), np.zeros(2), sd))
    return found


def test_collinear_spheres_place_a_light_beside_their_line_and_not_one_on_it():
    places = [[-40, 0, 12], [0, 0, 12], [40, 0, 12]]
    beside = locate(spots(np.array([30, 120, 200.0]), places), np.zeros(3))
    assert np.linalg.norm(beside.position - [30, 120, 200]) < 4 * 250 * beside.distance_sd
    along = locate(spots(np.array([500, 0, 12.0]), places), np.zeros(3))
    assert along.position is None
    assert "in line with them" in along.note
    np.testing.assert_allclose(along.direction, [1, 0, 0], atol=0.01)


def test_a_light_too_far_for_its_distance_keeps_its_direction():
    light = locate(spots(np.array([0, 3e5, 4e5]), [[0, 0, 0], [60, 0, 0], [0, 60, 0]]), np.zeros(3))
    assert light.position is None
    np.testing.assert_allclose(light.direction, [0, 0.6, 0.8], atol=5e-3)


def test_one_wrong_spot_of_five_is_left_out():
    places = [[0, 0, 0], [80, 0, 0], [0, 80, 0], [80, 80, 0], [40, 40, 0]]
    lamp = np.array([60, 20, 300.0])
    found = spots(lamp, places)
    wrong = np.array([0.5, 0.5, 0.7])
    found[2] = Spot(found[2].point, wrong / np.linalg.norm(wrong), np.zeros(2), 2e-3)
    light = locate(found, np.zeros(3))
    assert light.spheres == 4
    assert np.linalg.norm(light.position - lamp) < 10


def white_frames(lens=True):
    rows, cols = np.mgrid[:320, :480]
    x, y = (cols - 239.5) / 4, (159.5 - rows) / 4
    table = np.stack([x, y, np.zeros_like(x)], axis=-1)
    vignette = 1 - 0.2 * (x**2 + y**2) / 5200 if lens else 1.0
    return [0.7 * Scene._lambert(table, lamp) * vignette for lamp in LAMPS], vignette


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.slow
def test_fall_off_is_divided_out_by_white_frames(tmp_path, single):
    whites, vignette = white_frames()
    taken = [p * vignette for p in pictures(FAR)]
    folder = write(tmp_path / "dome", taken)
    found = calibrate_lights(folder, sphere_mm=25)
    frames = write(tmp_path / "white", whites[:1] if single else whites)
    source = frames / "light 1.png" if single else frames
    report, files = falloff.correct(found, source, tmp_path / "even")
    assert report.residual.max() < 0.01
    # Under lights at 30 degrees the picture had been far from even.
    assert report.range.max() > 1.5
    paper = 0.25 + 0.35 * cv2.resize(gravel((960, 1440)), (480, 320), interpolation=cv2.INTER_AREA)
    clear = np.ones((320, 480), bool)
    for (x, y), r in THREE:
        rows, cols = np.ogrid[:320, :480]
        clear &= np.hypot(cols - 239.5 - 4 * x, rows - 159.5 + 4 * y) > 4.5 * r
    for lamp, name in zip(LAMPS, files, strict=True):
        even = photographs.grey(name, "linear")
        cosine = lamp[2] / np.linalg.norm(lamp)
        ratio = cv2.GaussianBlur((even / paper / cosine).astype(np.float32), (0, 0), 6)[clear]
        # Eight bits and 0.4 % of noise under gravel; positions are known to some mm.
        assert np.std(ratio) / np.mean(ratio) < (0.02 if single else 0.01)
        if not single:
            assert np.mean(ratio) == pytest.approx(1 / 0.7, rel=0.02)


def test_white_frames_that_saturate_or_match_no_light_are_refused(tmp_path):
    folder = write(tmp_path / "dome", pictures(FAR)[:3])
    found = calibrate_lights(folder)
    bright = write(tmp_path / "bright", [np.ones((320, 480))] * 3)
    with pytest.raises(CalibrationError, match="100 % of the white frame saturates"):
        falloff.correct(found, bright, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    (bright / "light 3.png").rename(bright / "other.png")
    (bright / "light 1.png").unlink()
    with pytest.raises(CalibrationError, match="2 white frames for 3 photographs"):
        falloff.correct(found, bright, tmp_path / "out")
    with pytest.raises(CalibrationError, match="one white frame for 3 lights, named like none"):
        falloff.correct(found, bright / "other.png", tmp_path / "out")
