"""The twin obeys its physics, each imperfection alone, and agrees with the tracer's truth."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from btfkit.devices.base import Axis
from btfkit.devices.poses import Chains, Motion, rotation
from btfkit.devices.twin import layout
from btfkit.devices.twin.imperfections import IMPERFECTIONS, Imperfections
from btfkit.devices.twin.lamp import LAMP, NONE, Lamp
from btfkit.devices.twin.log import Twin, everything
from btfkit.devices.twin.motion import Motor, Profile
from btfkit.devices.twin.sensor import FULL_E, Sensor
from btfkit.devices.twin.truth import NearTextures
from btfkit.devices.twin.world import Setup, World

AXIS = Axis("a", -1.0, 3.0, velocity=0.5, acceleration=0.25)
PERFECT, STANDARD = Imperfections.none(), Imperfections()


@given(way=st.floats(-4, 4), time=st.floats(0, 1))
def test_an_axis_keeps_to_its_velocity_and_acceleration(way, time):
    profile = Profile(0.3, way, 2.0, AXIS.velocity, AXIS.acceleration)
    assert profile.ends_s - 2.0 == pytest.approx(AXIS.travel_s(way), abs=1e-9)
    at = 2.0 + time * (profile.ends_s - 2.0)
    step = 1e-4
    left, middle, right = (profile.at(at + k * step) for k in (-1, 0, 1))
    # Differences of float64 positions over 1e-4 s carry 1e-11, over its square 1e-7.
    assert abs(right - left) / (2 * step) <= AXIS.velocity + 1e-9
    assert abs(right - 2 * middle + left) / step**2 <= AXIS.acceleration + 1e-5
    assert profile.at(profile.ends_s) == pytest.approx(0.3 + way)


def a_motor(imperfections: Imperfections) -> Motor:
    motor = Motor(AXIS, imperfections, np.random.default_rng(1))
    motor.home(0.0)
    return motor


def test_backlash_shows_downwards_and_not_from_below():
    motor = a_motor(Imperfections(frozenset({"backlash"})))
    motor.start(1.0, 100.0)
    assert motor.shaft(200.0) == pytest.approx(1.0)
    motor.start(0.5, 200.0)
    assert motor.shaft(300.0) == pytest.approx(0.5 + math.radians(0.05))
    assert motor.counter(300.0) == pytest.approx(0.5)


def test_lost_steps_part_encoder_and_counter_until_homed():
    motor = a_motor(PERFECT)
    motor.start(1.0, 100.0)
    motor.slip()
    assert motor.counter(200.0) == pytest.approx(1.0)
    assert motor.encoder(200.0) == pytest.approx(1.0 - math.radians(0.5))
    motor.home(200.0)
    motor.start(1.0, 300.0)
    assert motor.encoder(400.0) == pytest.approx(1.0)


def test_a_perfect_lamp_is_steady_and_the_other_warms_up():
    steady, real = (Lamp(i, np.random.default_rng(2)) for i in (PERFECT, STANDARD))
    for lamp in (steady, real):
        assert lamp.power(5.0) == 0
        lamp.switch(LAMP, 10.0)
    assert steady.power(11.0) == steady.power(9e4) == steady.monitor(50.0) == 1
    assert real.power(10.0) - real.power(2000.0) == pytest.approx(0.08, abs=0.012)
    late = np.array([real.power(t) for t in range(3000, 20000, 50)])
    # The amplitudes of the drift sum to 0.6 %.
    assert 1e-3 < np.ptp(late) < 1.2e-2
    real.fail()
    assert real.power(3000.0) == 0


def a_sensor(*on: str) -> Sensor:
    section = layout.describe(256, 192, bits=12 if "quantisation" in on else 16, mosaic=False)[
        "sensor"
    ]
    return Sensor(section, Imperfections(frozenset(on)), np.random.default_rng(4))


def exposed(sensor: Sensor, level: float, exposure_s: float = 0.02, seed: int = 0, t: float = 25.0):
    light = np.full((*sensor.size, 3), level, np.float32)
    return sensor.exposed(
        light, exposure_s, iso=100, temperature_c=t, rng=np.random.default_rng(seed)
    ).astype(float)


def test_photon_transfer_gives_back_gain_and_read_noise():
    sensor = a_sensor("shot-noise", "read-noise", "quantisation")
    gain = FULL_E / 3895
    for level in (0.05, 0.2, 0.6):
        a, b = (exposed(sensor, level, seed=seed) for seed in (1, 2))
        variance, mean = (a - b).var() / 2, a.mean() - 200
        expected = mean / gain + (3 / gain) ** 2 + 1 / 12
        # A variance of 147 456 values is known to 0.37 %; four of them.
        assert variance == pytest.approx(expected, rel=0.015)
        assert mean == pytest.approx(level * 0.8 * FULL_E / gain, rel=2e-3)


def test_pixels_differ_by_one_percent_and_dark_current_doubles_every_seven_degrees():
    prnu = a_sensor("prnu")
    assert exposed(prnu, 0.5).std() / (exposed(prnu, 0.5).mean() - 3200) == pytest.approx(
        0.01, rel=0.02
    )
    dark = a_sensor("dark-current")
    cold, warm = (np.median(exposed(dark, 0.0, 8.0, t=t)) - 3200 for t in (25.0, 32.0))
    # 16 electrons are 104 counts of 16 bits; counts are whole.
    assert cold == pytest.approx(2 * 8 * 62335 / FULL_E, abs=1)
    assert warm == pytest.approx(2 * cold, abs=2)


def test_a_sensor_saturates_at_its_white_and_is_linear_below():
    sensor = a_sensor("quantisation")
    assert exposed(sensor, 9.0).max() == exposed(sensor, 9.0).min() == 4095
    dark, one, two = (exposed(sensor, level).mean() - 200 for level in (0.0, 0.2, 0.4))
    assert dark == 0
    assert two == pytest.approx(2 * one, abs=1)


def test_a_body_turns_about_the_line_of_its_axis():
    lines = {
        "a": (np.array([0.0, 0, 1]), np.array([1.0, 0, 0])),
        "b": (np.array([1.0, 0, 0]), np.zeros(3)),
    }
    chains = Chains(lines, {"body": ["a", "b"]})
    moved = chains.body("body", {"a": math.pi / 2, "b": math.pi / 2})
    # b takes (2, 1, 0) to (2, 0, 1); a, a quarter about (1, 0), takes that to (1, 1, 1).
    np.testing.assert_allclose(moved.of([2.0, 1.0, 0.0]), [1, 1, 1], atol=1e-12)
    np.testing.assert_allclose(moved.inverse().of(moved.of([3.0, 4, 5])), [3, 4, 5], atol=1e-12)


def placed(world: World, **degrees: float):
    names = ("turntable", "camera_arm", "light_turn", "light_arm")
    return world.truth.placed({name: math.radians(degrees.get(name, 0)) for name in names})


def test_a_perfect_rig_points_where_its_axes_say():
    world = World(Setup(None, imperfections=PERFECT))
    place = placed(world, turntable=30, camera_arm=40, light_turn=100, light_arm=20)
    view = place.camera / np.linalg.norm(place.camera)
    light = place.lamp / np.linalg.norm(place.lamp)
    np.testing.assert_allclose(view, spherical(40, -30), atol=1e-12)
    np.testing.assert_allclose(light, spherical(20, 70), atol=1e-12)
    # It looks at the origin.
    np.testing.assert_allclose(place.rotation[2], -view, atol=1e-12)


def spherical(theta: float, phi: float) -> np.ndarray:
    t, p = math.radians(theta), math.radians(phi)
    return np.array([math.sin(t) * math.cos(p), math.sin(t) * math.sin(p), math.cos(t)])


@pytest.mark.parametrize(
    "twin", [Twin(width=320, height=240), Twin(width=320, height=240, without=everything())]
)
def test_rays_of_pixels_meet_points_that_are_seen_there(twin):
    world = World(twin.setup())
    lens = world._scene.lens
    place = placed(world, camera_arm=35, turntable=20)
    ray = np.append(lens.rays[101, 333].astype(float), 1.0) @ place.rotation
    point = place.camera - place.camera[2] / ray[2] * ray
    # Sub-pixel 333 of two a pixel lies at column 166.25, 101 at row 50.25; rays are float32.
    np.testing.assert_allclose(lens.pixels(place, point), [166.25, 50.25], atol=2e-4)


@pytest.mark.slow
def test_opencv_finds_the_board_where_it_lies():
    twin = Twin("print", 960, 720, without=everything())
    world = World(twin.setup())
    place = placed(world, camera_arm=30, turntable=70, light_arm=20)
    image = (255 * np.clip(world._scene.image(place).mean(-1), 0, 1) ** 0.45).astype(np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, layout.DICTIONARY))
    board = cv2.aruco.CharucoBoard(layout.BOARD, layout.SQUARE_MM, layout.MARKER_MM, dictionary)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(image)
    assert len(ids) > 40
    entry = layout.target()["board"]
    at = np.asarray(board.getChessboardCorners())[np.ravel(ids)]
    points = np.array(entry["origin_mm"]) + at[:, :1] * entry["x"] + at[:, 1:2] * entry["y"]
    off = world._scene.lens.pixels(place, points) - np.reshape(corners, (-1, 2))
    # The detector is good to 0.03 px rms on sharp images; a few corners touch what covers the board.
    assert np.median(np.linalg.norm(off, axis=1)) < 0.06


@pytest.mark.slow
@pytest.mark.parametrize(
    ("view", "light", "least"),
    [((0, 0), (30, 60), 42), ((45, 120), (45, 20), 45), ((75, 40), (70, 90), 40)],
)
def test_a_perfect_frame_is_the_truth_under_the_same_lamp(view, light, least):
    """Sampled between pixels at the texels' true places: what is left is the pixels' own width."""
    twin = Twin("woven", 640, 480, without=everything())
    world = World(twin.setup())
    place = placed(
        world, camera_arm=view[0], turntable=view[1], light_arm=light[0], light_turn=light[1]
    )
    textures = NearTextures(twin.relief(), np.float32([place.lamp]), np.float32([place.camera]))
    truth = textures[0]
    h, w = truth.shape[:2]
    points = textures._points.astype(float)
    seen = world._scene.lens.pixels(place, points).astype(np.float32).reshape(h, w, 2)
    frame = cv2.remap(world._scene.image(place), seen[..., 0], seen[..., 1], cv2.INTER_LINEAR)
    irradiance = layout.LAMP_MM**2 / ((place.lamp - points) ** 2).sum(-1).reshape(h, w, 1)
    found = (frame / irradiance)[6:-6, 6:-6]
    truth = truth[6:-6, 6:-6]
    # 16 rays a texel leave 0.05 % of the mean.
    assert found.mean() == pytest.approx(truth.mean(), rel=1e-3)
    mse = np.mean((np.log1p(found) - np.log1p(truth)) ** 2)
    assert -10 * math.log10(mse) > least


def test_highlights_lie_where_a_sphere_mirrors_the_lamp():
    world = World(Twin("print", 640, 480, without=everything()).setup())
    place = placed(world, light_arm=25, light_turn=40)
    scene = world._scene
    spots = scene._spheres.highlights(scene.lens, place, 1.0, 0.0)
    for centre in world.truth.spheres:
        at = scene._spheres._mirror_point(centre, place)
        normal = (at - centre) / layout.SPHERE_MM
        to_lamp, to_camera = (v / np.linalg.norm(v) for v in (place.lamp - at, place.camera - at))
        np.testing.assert_allclose(
            normal, (to_lamp + to_camera) / np.linalg.norm(to_lamp + to_camera), atol=1e-9
        )
        col, row = np.rint(scene.lens.pixels(place, at)).astype(int)
        patch = spots[row - 4 : row + 5, col - 4 : col + 5]
        rows, cols = np.mgrid[row - 4 : row + 5, col - 4 : col + 5]
        middle = [(patch * g).sum() / patch.sum() for g in (cols, rows)]
        # Pixels of 1 sample a spot of 0.5: their centroid is off by exp(-2 (pi/2)^2) / pi = 2.3e-3.
        np.testing.assert_allclose(middle, scene.lens.pixels(place, at), atol=3e-3)


@pytest.mark.parametrize(("half", "middle"), [(18, (0, 0)), (5, layout.WHITE_AT)])
def test_spheres_shade_and_hide_neither_sample_nor_white_down_to_75_degrees(half, middle):
    spheres = World(Twin("print", 64, 48).setup())._scene._spheres
    side = np.linspace(-half, half, 25)
    x, y = np.meshgrid(side + middle[0], side + middle[1])
    points = np.stack([x, y, 0 * x], axis=-1).astype(np.float32)
    for azimuth in range(0, 360, 4):
        for distance in (layout.LAMP_MM, layout.CAMERA_MM):
            assert not spheres.shaded(points, distance * spherical(75, azimuth)).any()
    low = [spheres.shaded(points, layout.LAMP_MM * spherical(82, a)).any() for a in range(360)]
    assert any(low)


def test_what_is_drawn_repeats_by_its_seed_and_differs_by_another():
    def frame(seed: int) -> np.ndarray:
        world = World(Twin("print", 64, 48, seed=seed).setup())
        world.lamp.switch(LAMP, 0.0)
        return world.counts(0.01, 100.0, 10.0)

    np.testing.assert_array_equal(frame(1), frame(1))
    assert (frame(1) != frame(2)).any()


def test_each_imperfection_can_be_switched_off_alone_and_changes_something():
    def seen(without: tuple[str, ...], width: int) -> list:
        world = World(Twin("print", width, width * 3 // 4, seed=3, without=without).setup())
        world.lamp.switch(LAMP, 0.0)
        for motor in world.motors:
            motor.home(0.0)
        for motor in world.motors:
            motor.start(0.3, 60.0)
            motor.start(0.2, 120.0)
        lit = world.counts(0.01, 100.0, 180.0).tobytes()
        world.lamp.switch(NONE, 190.0)
        dark = world.counts(8.0, 100.0, 190.0).tobytes()
        world.lamp.switch(LAMP, 0.0)
        return [
            lit, dark, world.lamp.power(180.0),
            world.lamp.monitor(180.0), [motor.encoder(180.0) for motor in world.motors],
            world.truth.camera[1].tolist(), world.truth.lamp.tolist(),
            world.truth.spheres.tolist(), world.nominal["sensor"]["bits"],
            world._scene._lamp_mm,
        ]  # fmt: skip

    everything_on = {width: seen((), width) for width in (64, 320)}
    for name in IMPERFECTIONS:
        # Half a pixel of blur, of 640, takes a wider sensor to be seen at all.
        width = 320 if name == "defocus" else 64
        assert seen((name,), width) != everything_on[width], name
    with pytest.raises(ValueError, match="imperfection 'rust'; expected one of backlash"):
        Imperfections.without(["rust"])
    with pytest.raises(KeyError):
        assert "rust" in STANDARD


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"width": 31}, "width 31; expected an even"),
        ({"without": ("rust",)}, "imperfection 'rust'"),
    ],
)
def test_a_twin_that_cannot_be_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        Twin(**options)


def test_motions_compose():
    a = Motion(rotation([0, 0, 1], 0.3), np.array([1.0, 2, 3]))
    b = Motion(rotation([1, 0, 0], -0.7), np.array([0.0, 1, 0]))
    point = np.array([0.3, -0.2, 0.9])
    np.testing.assert_allclose(a.then(b).of(point), b.of(a.of(point)), atol=1e-14)
