"""A rig as sequence.json states it: what its builder believes, and calibration begins with."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit.calibration.board import Board
from btfkit.calibration.camera_model import Camera
from btfkit.calibration.geometry import Geometry
from btfkit.calibration.kinematics import Axis, Kinematics, Rigid, check_rotation
from btfkit.errors import CalibrationError
from btfkit.sequence import Sequence

Floats = NDArray[np.float64]
# The rig's own lamp, as the sequence has one.
LAMP = "lamp"
_DOCUMENT = "sequence.json"


def nominal(sequence: Sequence) -> Geometry:
    """The geometry that sequence.json states.

    Raises:
        CalibrationError: it lacks what a geometry needs, or garbles it.
    """
    rig = sequence.rig
    try:
        axes = [
            Axis(str(a["name"]), str(a.get("kind", "rotary")), _vector(a["direction"]),
                 _vector(a.get("point_mm", (0, 0, 0))))
            for a in rig["axes"]
        ]  # fmt: skip
        carries = {
            body: tuple(rig["carries"].get(body, ())) for body in ("sample", "camera", "light")
        }
        lamp = rig.get("light", {})
        seen_by, pose = _camera(rig["camera"], sequence.frame_size)
        lights = {LAMP: _vector(lamp["position_mm"])} if "position_mm" in lamp else {}
        spheres = sequence.target.get("spheres", [])
        centres = np.array([_vector(s["centre_mm"]) for s in spheres]).reshape(-1, 3)
        radii = np.array([float(s["radius_mm"]) for s in spheres])
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise CalibrationError(
            f"rig of {_DOCUMENT} does not tell axes, camera and light ({error!r})",
            remedy="add axes, carries, camera (position_mm, rotation, focal_px, centre_px), light",
        ) from error
    return Geometry(
        seen_by, pose, Kinematics(tuple(axes), carries), board_pose(sequence), centres, radii,
        lights,
    )  # fmt: skip


def stated_camera(sequence: Sequence) -> tuple[Camera, Rigid]:
    """The camera and its pose (lab to camera) as rig.camera of sequence.json has them.

    Raises:
        CalibrationError: it does not say them.
    """
    try:
        return _camera(sequence.rig["camera"], sequence.frame_size)
    except (KeyError, TypeError, ValueError) as error:
        raise CalibrationError(
            f"rig.camera of {_DOCUMENT} does not tell the camera ({error!r})",
            remedy="add position_mm, rotation, focal_px, centre_px",
        ) from error


def board_pose(sequence: Sequence) -> Rigid:
    """Board to sample, from origin_mm (first outer corner) and drawn axes x and y (down)."""
    if "board" not in sequence.target:
        return Rigid.identity()
    board = sequence.target["board"]
    size = Board.from_json(board)
    try:
        across = _vector(board.get("x", (1, 0, 0)))
        down = _vector(board.get("y", (0, -1, 0)))
        width, height = (n * size.square_mm for n in size.squares)
        rotation = np.stack([across, -down, np.cross(across, -down)], axis=1)
        corner = board.get("origin_mm")
        middle = (
            np.zeros(3)
            if corner is None
            else _vector(corner) + across * width / 2 + down * height / 2
        )
    except (TypeError, ValueError) as error:
        raise CalibrationError(f"target.board of {_DOCUMENT} has no pose ({error})") from error
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
        raise CalibrationError(
            f"target.board of {_DOCUMENT}: x {across.tolist()} and y {down.tolist()} are not "
            "perpendicular unit vectors"
        )
    return Rigid(rotation, middle)


def _camera(entry: Mapping[str, Any], size: tuple[int, int]) -> tuple[Camera, Rigid]:
    turn, eye = np.array(entry["rotation"], float), _vector(entry["position_mm"])
    focal, centre = (np.array(entry[key], float) for key in ("focal_px", "centre_px"))
    lens = np.concatenate([focal, centre, np.zeros(5)])
    if turn.shape != (3, 3) or lens.shape != (9,):
        raise ValueError(f"camera of shapes {turn.shape} and {focal.shape}")
    check_rotation(turn)
    camera = Camera(size[1], size[0], lens)
    return camera, Rigid(turn, -turn @ eye)


def _vector(values: Any) -> Floats:
    vector = np.array(values, float)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"{values!r} is no vector of three numbers")
    return vector
