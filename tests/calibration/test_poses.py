"""Rigs without axes: poses and lights of single frames, as somebody else's program wrote them."""

import csv
import json

import numpy as np
import pytest
import sources
import turntables
from scipy.spatial.transform import Rotation

import btfkit
from btfkit import counts
from btfkit.calibration.board import Board
from btfkit.calibration.board_poses import Finder
from btfkit.calibration.camera_model import Camera
from btfkit.calibration.folders import calibrate_sequence
from btfkit.calibration.sensor_stage import fit_sensor
from btfkit.calibration.stages import calibrate
from btfkit.errors import CalibrationError
from btfkit.sequence import Frame, Sequence, save

POSE = [f"camera_{c}_mm" for c in "xyz"] + [f"camera_q{c}" for c in "wxyz"]
LIGHT = [f"light_{c}_mm" for c in "xyz"]
# The camera of the small run: looks at the origin from (0, -60, 100).
EYE = np.array([0.0, -60.0, 100.0])
LOOK = np.array([[1, 0, 0], [0, -0.857493, -0.514496], [0, 0.514496, -0.857493]])


def spun(angle, axis):
    return Rotation.from_rotvec(angle * np.asarray(axis, float)).as_matrix()


@pytest.fixture
def axes_run(tmp_path):
    return sources.SOURCES["sequence"](tmp_path)


def rewritten(run, change_document, columns):
    """The run without axes; `columns(number)` gives cells of a frame by column."""
    path = run / "sequence.json"
    document = json.loads(path.read_text())
    document["rig"].pop("axes")
    document["rig"].pop("carries")
    change_document(document)
    path.write_text(json.dumps(document))
    table = run / "sequence.csv"
    rows = list(csv.DictReader(table.read_text().splitlines()))
    kept = [{k: v for k, v in row.items() if not k.startswith("axis:")} for row in rows]
    full = [row | columns(k) for k, row in enumerate(kept)]
    with table.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(full[0]))
        writer.writeheader()
        writer.writerows(full)
    return run


def posed(number):
    """What the axes of the small run make of camera and lamp, by hand."""
    turn = spun(0.4 * (number // 2), [0, 0, 1])
    lamp = spun(0.1 + 0.2 * (number % 2), [0, 1, 0]) @ [0, 0, 200]
    x, y, z, w = Rotation.from_matrix(LOOK @ turn.T).as_quat()
    return dict(zip(POSE, [*turn @ EYE, w, x, y, z], strict=True)), lamp


def test_poses_in_the_table_give_the_textures_that_axes_give(axes_run, tmp_path):
    by_axes = btfkit.open(axes_run, texel_mm=0.5)
    expected = [by_axes.texture(k) for k in range(4)]

    def columns(number):
        pose, lamp = posed(number)
        return pose | dict(zip(LIGHT, lamp, strict=True))

    run = rewritten(axes_run, lambda d: d["rig"].pop("light"), columns)
    btf = btfkit.open(run, texel_mm=0.5)
    for k in range(4):
        # the same geometry from quaternions of sixteen digits and a matrix of six
        np.testing.assert_allclose(btf.texture(k), expected[k], rtol=1e-4)
    np.testing.assert_allclose(btf.view_position, by_axes.view_position, atol=1e-4)
    np.testing.assert_allclose(btf.light_position, by_axes.light_position, atol=1e-4)
    assert "geometry" not in btf.provenance["assumed"]
    found, _ = calibrate(Sequence.open(run))
    assert found.section("geometry").data["poses_from"] == {"table": 2}
    _, ran = calibrate(Sequence.open(run), found)
    assert ran == []
    told = calibrate_sequence(run, None, force=False, progress=lambda done, total: None)
    page = told["report"].read_text()
    assert "Poses of single frames, there being no axes, from" in page
    assert "table of 2 views" in page


def test_a_camera_that_stands_still_needs_directions_of_light_alone(axes_run):
    by_axes = btfkit.open(axes_run, texel_mm=0.5)

    def columns(number):
        lamp = posed(number)[1]
        return dict(zip(("light_x", "light_y", "light_z"), lamp, strict=True))

    run = rewritten(axes_run, lambda d: d["rig"].pop("light"), columns)
    btf = btfkit.open(run, texel_mm=0.5)
    # float32; the poses are the same to rounding
    np.testing.assert_allclose(btf.texture(1), by_axes.texture(1), rtol=1e-5)
    np.testing.assert_allclose(btf.light, by_axes.light, atol=1e-6)
    # Of a light whose distance nobody said there is no position.
    assert btf.light_position is None
    assert len(btf.blurs.maps) == 1


@pytest.mark.parametrize(
    ("change", "cells", "message"),
    [
        (lambda d: d["rig"].pop("light"), lambda k: {},
         r"no rig.axes, and 4 sample frames have no light_x, light_y, light_z \(first: frames/000.png\)"),
        (lambda d: d["rig"].pop("camera"), lambda k: {},
         r"neither rig.axes nor rig.camera nor target.board, and 4 sample frames have no camera_x_mm … camera_qz"),
        (lambda d: None, lambda k: posed(k)[0] | {"camera_qw": "3"}, r"000.png: camera_qw … camera_qz have length 3"),
        (lambda d: None, lambda k: posed(k)[0] | {"camera_x_mm": "left"}, r"000.png: camera_x_mm … camera_qz are left, .*expected numbers"),
        (lambda d: None, lambda k: posed(k)[0] | {"view_x": 0, "view_y": 0.3, "view_z": 1},
         r"00\d.png shows the sample from 4\d.\d degrees beside the view_x, view_y, view_z of its line"),
        (lambda d: d["rig"]["camera"].pop("rotation"), lambda k: {}, r"rig.camera of sequence.json does not tell the camera"),
    ],
)  # fmt: skip
def test_what_tells_no_pose_is_named(axes_run, change, cells, message):
    run = rewritten(axes_run, change, cells)
    with pytest.raises(CalibrationError, match=message):
        btfkit.open(run)


@pytest.fixture(scope="module")
def boards(tmp_path_factory):
    """Four views of a board, and two with two lights each in which it lies about the sample."""
    rng = np.random.default_rng(12)
    run = tmp_path_factory.mktemp("boards")
    (run / "frames").mkdir()
    tilts = [(0.0, 0.2), (0.5, 1.0), (0.6, 3.0), (0.7, 5.0)]
    frames, true = [], {}
    for k, (tilt, about) in enumerate([*tilts, (0.1, 2.0), (0.8, 0.7)]):
        matrix = turntables.look_down(260.0) @ turntables.turn([0, 1, 0], np.zeros(3), tilt)
        matrix = matrix @ turntables.turn([0, 0, 1], np.zeros(3), about)
        image = 200 + 3000 * turntables.board_frame(matrix, rng, fine=2)
        kind = "target" if k < len(tilts) else "sample"
        eye = -matrix[:3, :3].T @ matrix[:3, 3]
        for light in [(0.3, 0.1, 0.9), (-0.4, 0.2, 0.8)][: 2 if kind == "sample" else 1]:
            name = f"frames/{len(frames):03}.png"
            (run / name).write_bytes(counts.encode_png(np.rint(image).astype(np.uint16)))
            # The table has views to a degree or so.
            view = tuple(eye / np.linalg.norm(eye) + [0.01, 0.01, 0])
            frames.append(
                Frame(name, kind, light=light, view=view, exposure_s=0.01, group=len(frames))
            )
            true[name] = eye
    columns, rows = turntables.SQUARES
    document = {
        "sensor": {"width": turntables.WIDTH, "height": turntables.HEIGHT, "bits": 12, "black": 200,
                   "white": 4095, "gain_e_per_dn": 2.0, "read_noise_e": 3.0},
        "rig": {"light": {"distance_mm": 500}},
        "target": {
            "sample": {"size_mm": [20, 20]},
            "board": {"type": "charuco", "squares": [columns, rows], "square_mm": turntables.SQUARE,
                      "marker_mm": turntables.MARKER, "dictionary": "DICT_5X5_100"},
        },
    }  # fmt: skip
    save(run, frames, document)
    return run, true


@pytest.mark.slow
def test_a_board_in_view_tells_the_pose_of_every_frame(boards):
    run, true = boards
    found, _ = calibrate(Sequence.open(run))
    found.save(run / "calibration.json")
    btf = btfkit.open(run)
    assert btf.provenance["calibration"]["ran"] == []
    assert btf.shape[0] == 4
    expected = [eye for name, eye in true.items() if name >= "frames/004"]
    # From above, 80 mm of board at 260 mm tell a tilt by perspective alone: corners to 0.01 px
    # leave 0.01 degrees.
    apart = np.linalg.norm(np.cross(btf.view_position, expected), axis=1)
    angle = apart / np.linalg.norm(expected, axis=1) / np.linalg.norm(btf.view_position, axis=1)
    assert np.degrees(angle).max() < 0.02
    np.testing.assert_allclose(np.linalg.norm(btf.view_position, axis=1), 260, rtol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(btf.light_position, axis=1), 500, rtol=1e-6)
    data = found.section("geometry").data
    assert data["poses_from"] == {"board": 2}
    assert data["residuals_px"]["corner"] < 0.03
    # What the table said of the views, and how far off that was.
    assert 0.4 < data["off_table_deg"]["worst"] < 1.2


@pytest.mark.slow
def test_frames_of_one_view_in_which_the_board_moved_are_named(boards):
    sequence = Sequence.open(boards[0])
    radiometry, _ = fit_sensor(sequence)
    camera = Camera(turntables.WIDTH, turntables.HEIGHT, turntables.TRUTH)
    board = Board.from_json(sequence.target["board"])
    finder = Finder(sequence, radiometry, board, camera, 0.6, 0, [])
    # Two frames of the first pose of the sample, then one of the second.
    _, way, residual = finder.pose([(4,), (5,)])
    assert way == "board"
    assert residual < 0.03
    with pytest.raises(
        CalibrationError, match=r"004.png and others of its view show the board up to"
    ):
        finder.pose([(4,), (6,)])
