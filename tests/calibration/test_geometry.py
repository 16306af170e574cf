"""Cameras, boards and turntables: estimated from frames of a small simulation with its own code."""

import numpy as np
import pytest
import torch
import turntables
from kornia.geometry.calibration import distort_points
from kornia.geometry.conversions import axis_angle_to_rotation_matrix

from btfkit.calibration import bundle_parameters, corners
from btfkit.calibration.board import Board
from btfkit.calibration.bundle import Sighting, SphereSighting, adjust
from btfkit.calibration.bundle_problem import Problem
from btfkit.calibration.camera_model import Camera
from btfkit.calibration.geometry import Geometry
from btfkit.calibration.geometry_stage import LAMP, find_highlights, warn_of_unseen
from btfkit.calibration.intrinsics import calibrate_camera
from btfkit.calibration.kinematics import Axis, Kinematics, Rigid
from btfkit.calibration.mirrors import highlight
from btfkit.errors import CalibrationError
from btfkit.sequence import Frame

CAMERA = Camera(turntables.WIDTH, turntables.HEIGHT, turntables.TRUTH)
BOARD = Board(turntables.SQUARES, turntables.SQUARE, turntables.MARKER)
GUESS = np.array([1450.0, 1450, 499.5, 374.5, 0, 0, 0, 0, 0])


def rigid(matrix):
    return Rigid(matrix[:3, :3], matrix[:3, 3])


def nominal(rig, camera=None, spheres=True):
    """The rig as drawn: what a calibration starts from."""
    axes = tuple(Axis(name, "rotary", *line) for name, line in rig.nominal.items())
    kinematics = Kinematics(axes, {"sample": ("tilt", "turn"), "light": ("arm",)})
    near = {"lamp": turntables.LIGHT + [20.0, -10, 15]}
    some = turntables.SPHERES + [0.5, -0.7, 0.4] if spheres else np.zeros((0, 3))
    return Geometry(
        camera or Camera(turntables.WIDTH, turntables.HEIGHT, GUESS), rigid(rig.nominal_camera), kinematics,
        Rigid.identity(), some, np.full(len(some), turntables.RADIUS), near if spheres else {},
    )  # fmt: skip


def readings(k, count=16, widest=72.0):
    """Readings of view k of `count`: tilts evenly to the widest, turns by the golden angle."""
    arm = (-0.5, 0.0, 0.5, 0.9)[k % 4]
    return {
        "tilt": np.radians(widest * k / (count - 1)),
        "turn": np.radians(137.5 * k + 20),
        "arm": arm,
    }


def sightings(rig, views, noise, rng):
    points = turntables.corners()
    out = []
    for k, at in enumerate(views):
        pixels = turntables.project(
            turntables.apply(rig.sample_to_camera(at["tilt"], at["turn"]), points)
        )
        out.append(
            Sighting(f"view {k}", at, points, pixels + noise * rng.standard_normal(pixels.shape))
        )
    return out


def sphere_sightings(rig, views, rng, *, spheres=turntables.SPHERES, noise=(0.1, 0.05)):
    """Outlines and highlights with the noise of an ellipse fit and of a centroid, px."""
    out = []
    for k, at in enumerate(views):
        to_camera = rig.sample_to_camera(at["tilt"], at["turn"])
        light = turntables.apply(
            rig.camera,
            turntables.apply(turntables.turn(*rig.true["arm"], at["arm"]), turntables.LIGHT),
        )
        for s, centre in enumerate(turntables.apply(to_camera, spheres)):
            outline = turntables.sphere_outline(centre, turntables.RADIUS, 24) + noise[
                0
            ] * rng.standard_normal((24, 2))
            spot = turntables.sphere_highlight(centre, turntables.RADIUS, light) + noise[
                1
            ] * rng.standard_normal(2)
            out.append(SphereSighting(f"view {k}", at, s, outline, {"lamp": spot}))
    return out


def angle_deg(a, b):
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def test_the_camera_agrees_with_the_plain_simulation_and_comes_back_from_its_pixels():
    rng = np.random.default_rng(1)
    points = np.stack([*rng.uniform(-60, 60, (2, 200)), rng.uniform(200, 300, 200)], -1)
    pixels = CAMERA.project(points)
    # float64 throughout: pixels of 1e3 keep 1e-12 of themselves
    np.testing.assert_allclose(pixels, turntables.project(points), atol=1e-9)
    np.testing.assert_allclose(CAMERA.rays(pixels), points / points[:, 2:], atol=1e-12)


def test_points_behind_the_camera_and_beyond_the_fold_of_the_distortion_have_no_pixel():
    barrel = Camera(100, 100, np.array([100.0, 100, 50, 50, -0.4, 0, 0, 0, 0]))
    # 1 + 3 k1 r^2 = 0 at r = 0.913
    seen = barrel.project([[0.9, 0, 1.0], [0.92, 0, 1.0], [0, 0, -1.0]])
    assert np.isfinite(seen[0]).all()
    assert np.isnan(seen[1:]).all()
    assert np.isnan(barrel.rays([[300.0, 50.0]])).any()


def test_projection_and_its_derivatives_are_those_of_kornia():
    rng = np.random.default_rng(2)
    points = np.stack([*rng.uniform(-60, 60, (2, 20)), rng.uniform(200, 300, 20)], -1)

    def projected(points, parameters):
        fx, fy, cx, cy = parameters[:4]
        matrix = torch.zeros(3, 3, dtype=torch.float64)
        matrix = matrix + torch.diag(torch.stack([fx, fy, torch.ones_like(fx)]))
        matrix = matrix + torch.stack([cx, cy, 0 * cx])[:, None] * torch.tensor([0.0, 0, 1])
        plane = points[:, :2] / points[:, 2:] * parameters[:2] + parameters[2:4]
        return distort_points(plane[None], matrix[None], parameters[None, 4:])[0]

    given = torch.tensor(points), torch.tensor(turntables.TRUTH)
    pixels, by_point, by_parameter = CAMERA.project_with_derivatives(points)
    expected = projected(*given)
    jacobians = torch.autograd.functional.jacobian(projected, given)
    np.testing.assert_allclose(pixels, expected, rtol=1e-11)
    at = np.arange(20)
    np.testing.assert_allclose(by_point, jacobians[0].numpy()[at, :, at], rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(by_parameter, jacobians[1].numpy(), rtol=1e-8, atol=1e-9)


@pytest.mark.slow
def test_derivatives_of_a_tilting_turning_sample_and_the_optimum_are_those_of_automatic_differentiation(
    monkeypatch,
):
    # Corners alone, without what the drawing of the rig says: that is not in the torch twin.
    monkeypatch.setattr(bundle_parameters, "_DRAWN", {"turn": 1e9, "mm": 1e9, "light": 1e9})
    rng = np.random.default_rng(3)
    rig = turntables.Turntable(rng)
    views = [readings(k, 6) for k in range(6)]
    seen = sightings(rig, views, 0.02, rng)
    start = nominal(rig, spheres=False)
    found = adjust(start, seen)
    # The same rig in torch: everything that `found` left free, straight from Rodrigues' formula.
    pixels = torch.tensor(np.stack([s.pixels for s in seen]))
    points = torch.tensor(turntables.corners())
    angles = torch.tensor([[v["tilt"], v["turn"]] for v in views])

    def residuals(lens, pose, lines):
        at = points.expand(6, -1, -1)
        for axis in (1, 0):
            direction = lines[axis, :3] / lines[axis, :3].norm()
            matrix = axis_angle_to_rotation_matrix(direction * angles[:, axis : axis + 1])
            at = (at - lines[axis, 3:]) @ matrix.transpose(1, 2) + lines[axis, 3:]
        at = at @ axis_angle_to_rotation_matrix(pose[None, :3])[0].T + pose[3:]
        x, y = at[..., 0] / at[..., 2], at[..., 1] / at[..., 2]
        r2 = x * x + y * y
        k1, k2, p1, p2, k3 = lens[4:]
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return (torch.stack([lens[0] * u + lens[2], lens[1] * v + lens[3]], -1) - pixels).reshape(
            -1
        )

    from scipy.spatial.transform import Rotation

    best = found.geometry
    turn = Rotation.from_matrix(best.camera_pose.rotation).as_rotvec()
    given = (
        torch.tensor(best.camera.parameters),
        torch.tensor(np.concatenate([turn, best.camera_pose.translation])),
        torch.tensor(
            np.stack([np.concatenate([a.direction, a.point_mm]) for a in best.kinematics.axes[:2]])
        ),
    )
    residual = residuals(*given).numpy()
    jacobians = torch.autograd.functional.jacobian(residuals, given)
    problem = Problem(best, seen, (), slip_sd={})
    ours, slopes = problem.evaluate(np.zeros(problem.parameters.size))
    corners = len(residual)
    scale = problem.sd_px("corner")
    np.testing.assert_allclose(ours[:corners] * scale, residual, atol=1e-9)
    slopes = slopes.toarray()[:corners] * scale[:, None]
    # 1e-8 of pixels a unit: both are float64
    np.testing.assert_allclose(slopes[:, :9], jacobians[0].numpy(), rtol=1e-8, atol=1e-7)
    np.testing.assert_allclose(slopes[:, 12:15], jacobians[1].numpy()[:, 3:], rtol=1e-8, atol=1e-7)
    # At the optimum no free parameter of the other formulation has a slope left either, beside
    # what one standard deviation of it would cost.
    for index, held in (
        (0, [i for i, n in enumerate(problem.parameters.names[:9]) if n in found.held]),
        (2, []),
    ):
        jacobian = jacobians[index].numpy().reshape(len(residual), -1)
        slope = jacobian.T @ residual
        size = np.linalg.norm(jacobian, axis=0) * np.linalg.norm(residual)
        slope[held] = 0
        assert (np.abs(slope) < 1e-5 * size).all()


@pytest.mark.parametrize("slip_sd", [{}, {"tilt": 1e-3, "turn": 2e-3}])
@pytest.mark.slow
def test_derivatives_of_every_parameter_of_a_rig_with_spheres_are_differences_of_its_residuals(
    slip_sd,
):
    rng = np.random.default_rng(4)
    rig = turntables.Turntable(rng)
    views = [readings(k, 4) for k in range(4)]
    problem = Problem(
        nominal(rig),
        sightings(rig, views, 0, rng),
        sphere_sightings(rig, views, rng),
        slip_sd=slip_sd,
    )
    x = 0.3 * rng.standard_normal(problem.parameters.size) * problem.parameters.scale
    _, slopes = problem.evaluate(x)
    slopes = slopes.toarray() * problem.parameters.scale
    for k in range(problem.parameters.size):
        step = np.zeros(problem.parameters.size)
        step[k] = 1e-5 * problem.parameters.scale[k]
        difference = (problem.evaluate(x + step)[0] - problem.evaluate(x - step)[0]) / 2e-5
        # central differences of residuals of up to 1e5: rounding 1e-11 / 1e-5, and cubic terms
        np.testing.assert_allclose(
            slopes[:, k], difference, rtol=1e-5, atol=2e-3, err_msg=problem.parameters.names[k]
        )


def test_a_mirror_sphere_shows_a_light_where_the_way_over_it_is_shortest():
    rng = np.random.default_rng(5)
    for _ in range(5):
        centre = np.array([*rng.uniform(-50, 50, 2), 250.0])
        light = np.array([*rng.uniform(-200, 200, 2), -100.0])
        point = highlight(centre[None], light[None], np.array([5.0]))[0]
        # Nelder-Mead leaves 1e-6 px
        np.testing.assert_allclose(
            CAMERA.project(point), turntables.sphere_highlight(centre, 5.0, light), atol=1e-4
        )


def test_the_pattern_of_a_board_is_the_one_that_opencv_prints():
    picture = turntables.board_picture()
    rows, columns = np.mgrid[: picture.shape[0], : picture.shape[1]] + 0.5
    scale = 40 / turntables.SQUARE
    width, height = (n * turntables.SQUARE for n in turntables.SQUARES)
    assert (BOARD.pattern(columns / scale - width / 2, height / 2 - rows / scale) == picture).all()
    np.testing.assert_allclose(BOARD.corners_mm, turntables.corners(), atol=1e-9)


@pytest.fixture(scope="module")
def measured():
    """Sixteen rendered views to 72 degrees, and what a calibration makes of them."""
    rng = np.random.default_rng(6)
    rig = turntables.Turntable(rng)
    views = [readings(k) for k in range(16)]
    images = [
        turntables.board_frame(rig.sample_to_camera(v["tilt"], v["turn"]), rng) for v in views
    ]
    single = calibrate_camera(images, BOARD)
    seen = [
        Sighting(f"view {k}", views[k], BOARD.corners_mm[view.numbers], view.pixels)
        for k, view in enumerate(single.views)
        if view is not None
    ]
    found = adjust(nominal(rig, single.camera), seen, sphere_sightings(rig, views, rng))
    return rig, single, found


@pytest.mark.slow
def test_a_rig_is_calibrated_from_sixteen_rendered_views_to_72_degrees(measured):
    rig, single, found = measured
    # The pinhole alone, before the axes: OpenCV by itself leaves 0.2 px and 0.13 %.
    assert single.residual_px < 0.03
    focal = found.geometry.camera.parameters[0] / turntables.TRUTH[0]
    assert abs(focal - 1) < 1e-4
    points = turntables.corners()
    for tilt, angle in zip(
        np.radians([0, 20, 40, 55, 65, 72]), np.radians([33, 111, 200, 290, 350, 77]), strict=True
    ):
        at = {"tilt": tilt, "turn": angle, "arm": 0.3}
        to_camera = rig.sample_to_camera(tilt, angle)
        true = turntables.project(turntables.apply(to_camera, points))
        off = found.geometry.camera.project(found.geometry.sample_to_camera(at)(points)) - true
        assert np.sqrt((off**2).sum(1).mean()) <= 0.03, (
            f"held out view at {np.degrees(tilt):.0f} deg"
        )
        view = found.geometry.view_position(at)
        assert angle_deg(view, rig.view_direction(tilt, angle)) < 0.02
        light = found.geometry.light_position("lamp", at)
        assert angle_deg(light, rig.light_direction(turntables.LIGHT, tilt, angle, 0.3)) < 0.05
    assert not {
        name for name in found.held if name.startswith(("axis.tilt", "axis.turn", "camera.f"))
    }


@pytest.mark.slow
def test_corners_fitted_with_the_boards_picture_are_good_to_a_hundredth_of_a_pixel_at_any_tilt(
    measured,
):
    rig, single, _ = measured
    for k, view in enumerate(single.views):
        at = readings(k)
        true = turntables.project(
            turntables.apply(rig.sample_to_camera(at["tilt"], at["turn"]), turntables.corners())
        )
        off = view.pixels - true[view.numbers]
        # noise 0.004 of a contrast of 0.75; the simulation's nine samples a pixel leave the rest
        assert np.sqrt((off**2).sum(1).mean()) < 0.03
        assert np.abs(off.mean(0)).max() < 0.01


def test_gauge_freedom_is_named_and_held_and_the_rest_is_found():
    rng = np.random.default_rng(7)
    rig = turntables.Turntable(rng)
    views = [readings(k) for k in range(16)]
    found = adjust(nominal(rig, spheres=False), sightings(rig, views, 0.01, rng))
    assert [n for n in found.held if n.startswith("board_to_sample")] == [
        f"board_to_sample.{kind}.{k}" for kind in ("turn", "shift") for k in "xyz"
    ]
    # No light is seen: nothing tells where the arm turns.
    assert sum(n.startswith("axis.arm") for n in found.held) == 4
    assert not any(n.startswith(("axis.tilt", "axis.turn", "camera_pose")) for n in found.held)
    np.testing.assert_array_equal(found.geometry.board.rotation, np.eye(3))
    assert 1 < found.condition < 1e7
    error = found.geometry.camera.parameters[0] - turntables.TRUTH[0]
    assert abs(error) < 4 * found.sd("camera.fx")


def test_points_of_the_sample_itself_tell_where_the_board_sits():
    rng = np.random.default_rng(8)
    rig = turntables.Turntable(rng)
    views = [readings(k) for k in range(16)]
    marks = np.array([[-30.0, -20, 0], [30, -20, 0], [30, 20, 0], [-30, 20, 0], [0, 0, 1.5]])
    off = turntables.turn([0, 0, 1], np.zeros(3), 0.01)
    off[:3, 3] = 0.4, -0.3, 0.2
    seen = []
    for k, at in enumerate(views):
        to_camera = rig.sample_to_camera(at["tilt"], at["turn"])
        on_board = turntables.project(turntables.apply(to_camera @ off, turntables.corners()))
        seen.append(
            Sighting(
                f"view {k}",
                at,
                turntables.corners(),
                on_board + 0.01 * rng.standard_normal(on_board.shape),
            )
        )
        on_sample = turntables.project(turntables.apply(to_camera, marks))
        seen.append(
            Sighting(
                f"view {k}", at, marks, on_sample + 0.02 * rng.standard_normal((5, 2)), on="sample"
            )
        )
    found = adjust(nominal(rig, spheres=False), seen)
    assert not any(name.startswith("board") for name in found.held)
    board = found.geometry.board
    # sixteen views of five marks at 0.02 px and 5.8 px a mm
    np.testing.assert_allclose(board.translation, off[:3, 3], atol=0.01)
    np.testing.assert_allclose(board.rotation, off[:3, :3], atol=3e-4)


def test_nearly_parallel_views_hold_what_they_cannot_tell_and_name_it():
    rng = np.random.default_rng(9)
    rig = turntables.Turntable(rng)
    views = [readings(k, widest=0.2) for k in range(16)]
    found = adjust(nominal(rig, spheres=False), sightings(rig, views, 0.02, rng))
    assert any(name in found.held for name in ("camera.fx", "camera.fy", "camera_pose.shift.z"))
    assert np.isfinite(found.covariance).all()
    assert found.rms["corner"] < 0.05


def test_pixels_of_a_markers_cell_are_those_of_the_frame():
    # 10 mm squares, 7 mm markers of 7 cells, at 500 px / 200 mm: 2.5 px a cell.
    camera = Camera(400, 300, np.array([500.0, 500, 200, 150, 0, 0, 0, 0, 0]))
    ahead = Rigid(np.diag([1.0, -1, -1]), np.array([0, 0, 200.0]))
    assert BOARD.cell_px(camera.project(ahead(BOARD.corners_mm))) == pytest.approx(2.5)
    tilted = ahead @ Rigid.from_vectors([np.radians(60), 0, 0], [0, 0, 0])
    assert BOARD.cell_px(camera.project(tilted(BOARD.corners_mm))) == pytest.approx(1.25, rel=0.05)
    behind = Rigid(np.eye(3), np.array([0, 0, -200.0]))
    assert np.isnan(BOARD.cell_px(camera.project(behind(BOARD.corners_mm))))


@pytest.mark.slow
@pytest.mark.parametrize("spread_deg", [0.0, 0.3])
def test_nearly_coplanar_views_tell_their_plane_and_say_how_little_they_tell_across_it(spread_deg):
    rng = np.random.default_rng(14)
    rig = turntables.Turntable(rng)
    turns = np.radians(20 + spread_deg * np.sin(3 * np.arange(16)))
    views = [{**readings(k), "turn": turn} for k, turn in enumerate(turns)]
    found = adjust(nominal(rig, spheres=False), sightings(rig, views, 0.02, rng))
    assert np.isfinite(found.covariance).all()
    assert 1 < found.condition < 1e7
    assert found.rms["corner"] < 0.04
    within, across = (
        angle_deg(found.geometry.view_position(at), rig.view_direction(at["tilt"], at["turn"]))
        for at in ({**readings(11), "turn": np.radians(turn)} for turn in (20, 110))
    )
    assert within < 0.002
    if spread_deg == 0:
        # An axis that never moved stays as it was drawn: 0.01 rad off.
        assert sum(name.startswith("axis.turn") for name in found.held) == 4
        assert across < 3
    else:
        # 16 readings of 0.2 degrees rms tell its direction to a tenth of a degree, and it is said.
        sd = np.hypot(*(found.sd(f"axis.turn.direction.{k}") for k in (0, 1)))
        assert 0.05 < np.degrees(sd) < 0.5
        # Through the tilt the axis's error counts twice at most, for a turn of 90 degrees.
        assert across < 2 * 3 * np.degrees(sd)


def test_parallel_views_of_a_free_camera_are_refused(monkeypatch):
    rng = np.random.default_rng(10)
    rig = turntables.Turntable(rng)
    poses = [rig.sample_to_camera(np.radians(k), np.radians(40 * k)) for k in range(3)]
    pixels = iter(
        [turntables.project(turntables.apply(pose, turntables.corners())) for pose in poses]
    )
    monkeypatch.setattr(Board, "detect", lambda self, image: (np.arange(48), next(pixels)))
    blank = [np.zeros((turntables.HEIGHT, turntables.WIDTH))] * 3
    with pytest.raises(
        CalibrationError, match=r"within .* degrees of parallel in all 3 views.*tilted"
    ):
        calibrate_camera(blank, BOARD)


def test_frames_without_a_board_are_refused_with_their_number():
    blank = [np.full((80, 100), 0.5)] * 4
    with pytest.raises(CalibrationError, match=r"seen in 0 of 4 frames; at least 3 are needed"):
        calibrate_camera(blank, BOARD)
    with pytest.raises(
        CalibrationError,
        match=r"100 x 80 a marker of 7 mm is at most 7\.8 pixels wide, 1\.1 for each of its 7 cells; "
        r"3 are needed from above, 4 tilted.*sensor of more pixels",
    ):
        calibrate_camera(blank, BOARD)
    # What the rig says of its camera tells more; enough pixels are no cause.
    with pytest.raises(CalibrationError, match=r"is 17\.5 pixels wide, 2\.5 for"):
        calibrate_camera(blank, BOARD, cell_px=[2.5, 2.4, np.nan, 2.6])
    for enough in ([5.0] * 4, [np.nan] * 4):
        with pytest.raises(CalibrationError, match=r"in one row; check target\.board"):
            calibrate_camera(blank, BOARD, cell_px=enough)
    rig = turntables.Turntable(np.random.default_rng(0))
    two = sightings(rig, [readings(0), readings(5)], 0, np.random.default_rng(0))
    with pytest.raises(CalibrationError, match="2 frames show known points"):
        adjust(nominal(rig), two)


def test_views_of_too_few_corners_are_left_out_and_too_few_views_refused(monkeypatch):
    rng = np.random.default_rng(12)
    rig = turntables.Turntable(rng)
    ahead = (readings(k) for k in range(9))
    pixels = [
        turntables.project(turntables.apply(rig.sample_to_camera(at["tilt"], at["turn"]), turntables.corners()))
        for at in ahead
    ]  # fmt: skip
    row, some, off = np.arange(7), np.arange(12), pixels[2].copy()
    # Five corners stay where they are: what does not fit must not be what a pose is told by.
    off[5:12] += rng.uniform(20, 60, (7, 2))
    few = [(row, pixels[0][row]), (some[:5], pixels[1][:5]), (some, off[some])]
    every = [(np.arange(48), seen) for seen in pixels[3:]]

    def found(detected):
        views = iter(detected)
        monkeypatch.setattr(Board, "detect", lambda self, image: next(views))
        # Blank frames: nothing is fitted again.
        lost = np.full((48, 2), np.nan)
        monkeypatch.setattr(corners, "refine", lambda *args, **options: (lost, lost))
        blank = [np.zeros((turntables.HEIGHT, turntables.WIDTH))] * len(detected)
        return calibrate_camera(blank, BOARD, blur_px=0.5, cell_px=[5.0] * len(detected))

    single = found([*few, *every])
    assert [view is None for view in single.views] == [True] * 3 + [False] * 6
    # Corners stay as they were projected, exact to float32.
    assert single.residual_px < 1e-3
    with pytest.raises(
        CalibrationError,
        match=r"seen in 2 of 5 frames; at least 3 are needed, 6 corners in each that fit .* row; check",
    ):
        found([*few, *every[:2]])


def test_target_frames_that_tell_nothing_are_named():
    frames = [Frame(f"{k}.png", "target") for k in range(3)]
    seen = [Sighting(f"{k}.png", {}, np.zeros((6, 3)), np.zeros((6, 2))) for k in range(3)]
    warn_of_unseen(frames, seen)
    with pytest.warns(
        UserWarning, match=r"2 of 3 target frames show fewer than 6 .* first '0\.png'"
    ):
        warn_of_unseen(frames, seen[1:2])


def test_what_opencv_refuses_is_told_in_one_line(monkeypatch):
    import cv2

    rig = turntables.Turntable(np.random.default_rng(12))
    seen = turntables.project(
        turntables.apply(rig.sample_to_camera(0.5, 0.3), turntables.corners())
    )

    def refuse(*args, **options):
        error = cv2.error("all of it")
        error.err = "too few points where\n    'count' is 5\nmust be\n    '6'"
        raise error

    monkeypatch.setattr(cv2, "calibrateCameraExtended", refuse)
    monkeypatch.setattr(Board, "detect", lambda self, image: (np.arange(48), seen))
    with pytest.raises(
        CalibrationError,
        match=r"3 views of the board, of 48 corners and more: .*'count' is 5 must be '6'",
    ):
        calibrate_camera([np.zeros((turntables.HEIGHT, turntables.WIDTH))] * 3, BOARD)


@pytest.mark.slow
def test_collinear_spheres_still_tell_the_light_where_it_is_off_their_line():
    rng = np.random.default_rng(11)
    rig = turntables.Turntable(rng)
    views = [readings(k) for k in range(16)]
    line = np.array([[-50.0, 40, 5], [0, 40, 5], [50, 40, 5]])
    start = nominal(rig)
    start = Geometry(
        start.camera,
        start.camera_pose,
        start.kinematics,
        start.board,
        line + 0.3,
        np.full(3, turntables.RADIUS),
        start.lights_mm,
    )
    found = adjust(
        start, sightings(rig, views, 0.01, rng), sphere_sightings(rig, views, rng, spheres=line)
    )
    at = readings(9)
    light = found.geometry.light_position("lamp", at)
    true = rig.light_direction(turntables.LIGHT, at["tilt"], at["turn"], at["arm"])
    assert angle_deg(light, true) < 0.1
    assert np.isfinite(found.condition)


@pytest.mark.slow
def test_a_light_seen_in_one_sphere_of_one_view_keeps_what_it_does_not_tell():
    rng = np.random.default_rng(12)
    rig = turntables.Turntable(rng)
    views = [readings(k) for k in range(16)]
    one = [s for s in sphere_sightings(rig, views[:1], rng) if s.sphere == 0]
    found = adjust(nominal(rig), sightings(rig, views, 0.01, rng), one)
    # A highlight is two numbers: of the light's three at least one stays, and it is named.
    assert any(name.startswith("light.lamp") for name in found.held)
    assert sum(name.startswith("axis.arm") for name in found.held) == 4
    assert {f"sphere.{s}.{k}" for s in (1, 2, 3) for k in "xyz"} <= set(found.held)


def test_outliers_are_rejected_and_counted():
    rng = np.random.default_rng(13)
    rig = turntables.Turntable(rng)
    seen = sightings(rig, [readings(k) for k in range(16)], 0.01, rng)
    for k in range(0, 16, 3):
        seen[k].pixels[5 * (k % 3) + 7] += [1.5, -0.8]
    found = adjust(nominal(rig, spheres=False), seen)
    assert 12 <= found.rejected <= 20
    assert abs(found.geometry.camera.parameters[0] / turntables.TRUTH[0] - 1) < 1e-4


def test_a_frame_whose_readings_contradict_its_image_is_named():
    rng = np.random.default_rng(14)
    rig = turntables.Turntable(rng)
    seen = sightings(rig, [readings(k) for k in range(16)], 0.01, rng)
    wrong = dict(seen[6].readings)
    wrong["turn"] += 0.1
    seen[6] = Sighting("frames/000041.png", wrong, seen[6].points_mm, seen[6].pixels)
    with pytest.raises(
        CalibrationError, match=r"000041.*px from where the image shows it.*leave it out"
    ):
        adjust(nominal(rig, spheres=False), seen)


@pytest.mark.slow
def test_small_slips_of_the_axes_are_found_where_they_are_allowed():
    rng = np.random.default_rng(15)
    rig = turntables.Turntable(rng)
    views = [readings(k) for k in range(16)]
    seen = sightings(rig, views, 0.01, rng)
    slip = 3e-4 * rng.standard_normal((16, 2))
    moved = [
        Sighting(
            s.name,
            s.readings | {"tilt": s.readings["tilt"] - a, "turn": s.readings["turn"] - b},
            s.points_mm,
            s.pixels,
        )
        for s, (a, b) in zip(seen, slip, strict=True)
    ]
    found = adjust(
        nominal(rig, spheres=False), moved, slip_sd={"tilt": 5e-4, "turn": 5e-4, "arm": 5e-4}
    )
    # A mean slip of an axis cannot be told from where it reads zero.
    left = found.slips[:, :2] - slip
    # A third of what they were: the board's 0.01 px are 4e-5 of its half width.
    assert np.std(left, axis=0).max() < 1e-4
    assert found.rms["corner"] < 0.03


def test_a_missing_reading_is_named():
    rig = turntables.Turntable(np.random.default_rng(0))
    seen = sightings(rig, [readings(k) for k in range(4)], 0, np.random.default_rng(0))
    seen[2].readings.pop("turn")
    with pytest.raises(CalibrationError, match=r"axis 'turn' has reading None.*axis:turn"):
        adjust(nominal(rig), seen)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Axis("a", "screw", np.eye(3)[0], np.zeros(3)), "'rotary' or 'linear'"),
        (lambda: Axis("a", "rotary", np.zeros(3), np.zeros(3)), "not all zero"),
        (lambda: Kinematics((), {"sample": ("tilt",)}), "carry the sample and are not in"),
        (lambda: Kinematics((), {"lens": ()}), "bodies are sample, camera, light"),
        (lambda: Board((2, 7), 10, 7), "at least 3 x 3"),
        (lambda: Board.from_json({"type": "dots"}), "boards are 'charuco'"),
        (lambda: Board.from_json({"squares": [9, 7], "square_mm": 4}), "marker_mm"),
        (lambda: Board((9, 7), 10, 7, "DICT_9").corners_mm, "no dictionary 'DICT_9'"),
        (lambda: nominal(turntables.Turntable(np.random.default_rng(0))).light_position("sun", {}), "no light 'sun'"),
    ],
)  # fmt: skip
def test_what_no_rig_has_is_refused_by_name(make, message):
    with pytest.raises(CalibrationError, match=message):
        make()


def test_a_geometry_comes_back_from_its_json():
    rig = turntables.Turntable(np.random.default_rng(0))
    geometry = nominal(rig)
    back = Geometry.from_json(geometry.to_json())
    at = readings(5)
    np.testing.assert_array_equal(back.view_position(at), geometry.view_position(at))
    np.testing.assert_array_equal(
        back.light_position("lamp", at), geometry.light_position("lamp", at)
    )


def test_a_saturated_highlight_is_found_beside_a_dead_pixel():
    camera = Camera(160, 160, np.array([1500.0, 1500, 80, 80, 0, 0, 0, 0, 0]))
    geometry = Geometry(
        camera, Rigid(np.diag([1.0, -1, -1]), np.array([0.0, 0, 300])), Kinematics((), {}),
        spheres_mm=np.array([[0.0, 0, -2]]), radii_mm=np.array([8.0]),
        lights_mm={LAMP: np.array([250.0, 100, 600])},
    )  # fmt: skip
    pose = geometry.sample_to_camera({})
    spot = highlight(pose(geometry.spheres_mm), pose(geometry.lights_mm[LAMP])[None],
                     geometry.radii_mm)  # fmt: skip
    true = camera.project(spot)[0]
    rows, columns = np.mgrid[:160, :160]
    square = (columns - true[0]) ** 2 + (rows - true[1]) ** 2
    picture = 1 + 1e3 * np.exp(-0.5 * square / 1.2**2)
    saturated = picture > 700
    picture[saturated] = np.nan
    dead = tuple(np.rint(true[::-1]).astype(int) - [9, 6])
    picture[dead] = np.nan
    (found,) = find_highlights(picture, saturated, geometry, Frame("a.png", "sphere", {}))
    # A spot with its top cut off stays about its middle.
    np.testing.assert_allclose(found.highlights[LAMP], true, atol=0.05)
