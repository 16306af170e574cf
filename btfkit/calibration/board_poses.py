"""Where a camera without axes stood: from the table's line, the board in view, or as stated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from btfkit.calibration import corners
from btfkit.calibration.board import Board
from btfkit.calibration.camera_model import Camera
from btfkit.calibration.geometry_stage import grey
from btfkit.calibration.intrinsics import SingleCamera, calibrate_camera
from btfkit.calibration.kinematics import Rigid
from btfkit.calibration.nominal import board_pose, stated_camera
from btfkit.calibration.radiometry import Radiometry
from btfkit.errors import CalibrationError
from btfkit.sequence import TABLE, Frame, Sequence

Floats = NDArray[np.float64]
POSED = ("sample", "white", "colour")
CAMERA_COLUMNS = tuple(f"camera_{c}_mm" for c in "xyz") + tuple(f"camera_q{c}" for c in "wxyz")
# Frames that are looked at for one view, and views that tell a lens enough.
_FRAMES_A_VIEW, _LENS_VIEWS = 3, 16
_FEWEST_CORNERS = 6
# Corners of frames of one view differ by their noise; a camera that was moved shows more.
_STILL_PX = 0.5


@final
@dataclass(frozen=True, eq=False)
class Finder:
    """What finds the pose of a view."""

    sequence: Sequence
    radiometry: Radiometry
    board: Board | None
    camera: Camera
    blur_px: float
    rejected: int
    held: list[str]

    @staticmethod
    def of(sequence: Sequence, radiometry: Radiometry) -> Finder:
        board = None
        if "board" in sequence.target:
            board = Board.from_json(sequence.target["board"])
        single = None if board is None else _lens(sequence, radiometry, board)
        if single is not None:
            held = [] if sequence.of_kind("target") else ["target frames: the sample's own serve"]
            return Finder(
                sequence, radiometry, board, single.camera, single.blur_px, single.rejected, held
            )
        camera, _ = stated_camera(sequence)
        held = ["camera.fx", "camera.fy", "camera.cx", "camera.cy", "distortion", "blur"]
        return Finder(sequence, radiometry, board, camera, 0.0, 0, held)

    def pose(self, groups: list[tuple[int, ...]]) -> tuple[Rigid, str, float | None]:
        """Sample to camera in the frames of one view, what told it, and its residual in px."""
        first = self.sequence.frames[groups[0][0]]
        if has(first, CAMERA_COLUMNS):
            return _stated_pose(first), "table", None
        if self.board is not None:
            seen = [
                found
                for group in groups[:_FRAMES_A_VIEW]
                if (found := self._corners(group, self.board)) is not None
            ]
            if seen:
                pose, residual = self._fitted(self.board, seen, first)
                return pose @ board_pose(self.sequence).inverse(), "board", residual
        if "camera" in self.sequence.rig:
            return stated_camera(self.sequence)[1], "rig.camera", None
        raise CalibrationError(
            f"{first.file} shows fewer than {_FEWEST_CORNERS} corners of the board, and nothing "
            "else tells its pose",
            remedy=f"leave it out of {TABLE}, or give {CAMERA_COLUMNS[0]} … {CAMERA_COLUMNS[-1]}",
        )

    def _corners(
        self, group: tuple[int, ...], board: Board
    ) -> tuple[Floats, NDArray[np.intp], Floats] | None:
        there = tuple(
            i for i in group if (self.sequence.path / self.sequence.frames[i].file).is_file()
        )
        if not there:
            return None
        picture, _ = grey(self.radiometry, self.sequence, there)
        numbers, pixels = board.detect(picture)
        return (picture, numbers, pixels) if len(numbers) >= _FEWEST_CORNERS else None

    def _fitted(
        self, board: Board, seen: list[tuple[Floats, NDArray[np.intp], Floats]], first: Frame
    ) -> tuple[Rigid, float]:
        """Board to camera from all frames of a view, and the residual of its corners."""
        numbers = np.concatenate([n for _, n, _ in seen])
        pose = _solved(
            self.camera, board.corners_mm[numbers], np.concatenate([p for *_, p in seen])
        )
        places: dict[int, list[Floats]] = {}
        for picture, own, _ in seen:
            pixels, _ = corners.refine(board, picture, own, self.camera, pose, blur_px=self.blur_px)
            for number, pixel in zip(own.tolist(), pixels, strict=True):
                if np.isfinite(pixel).all():
                    places.setdefault(number, []).append(pixel)
        moved = max(
            (float(np.ptp(np.array(at), axis=0).max()) for at in places.values()), default=0
        )
        if moved > _STILL_PX:
            raise CalibrationError(
                f"{first.file} and others of its view show the board up to {moved:.1f} px apart",
                remedy="frames of one view_x, view_y, view_z must be from one place: clear those "
                f"columns of {TABLE} where the camera moved",
            )
        if len(places) < _FEWEST_CORNERS:
            raise CalibrationError(
                f"{first.file}: {len(places)} corners of the board can be told to better than a "
                f"pixel; at least {_FEWEST_CORNERS} are needed",
                remedy="show more of the board, sharper",
            )
        points = board.corners_mm[list(places)]
        pixels = np.array([np.mean(at, axis=0) for at in places.values()])
        return _kept(self.camera, points, pixels)


def views_of(sequence: Sequence) -> dict[Any, list[tuple[int, ...]]]:
    """Groups of frames by what the table says of their view; each by itself where it says none."""
    views: dict[Any, list[tuple[int, ...]]] = {}
    for number, group in sequence.groups(*POSED).items():
        frame = sequence.frames[group[0]]
        stated = tuple(frame.extra.get(c, "") for c in CAMERA_COLUMNS)
        key = stated if any(stated) else frame.view or number
        views.setdefault(key, []).append(group)
    return views


def has(frame: Frame, columns: tuple[str, ...]) -> bool:
    """Whether a frame's line fills all of some columns."""
    return all(frame.extra.get(column) for column in columns)


def numbers_of(frame: Frame, columns: tuple[str, ...]) -> Floats:
    """(len(columns),) what a frame's line has in some columns.

    Raises:
        CalibrationError: it is no number.
    """
    try:
        values = np.array([float(frame.extra[column]) for column in columns])
    except ValueError:
        values = np.array([np.nan])
    if not np.isfinite(values).all():
        told = ", ".join(frame.extra[column] for column in columns)
        raise CalibrationError(
            f"{frame.file}: {columns[0]} … {columns[-1]} are {told}; expected numbers"
        )
    return values


def _lens(sequence: Sequence, radiometry: Radiometry, board: Board) -> SingleCamera | None:
    """The camera by its target frames and, where they are few, by the sample's own views too.

    None where neither tells it and rig.camera has to do.
    """
    groups = list(sequence.groups("target").values())
    views = [view[0] for view in views_of(sequence).values()]
    more = max(_LENS_VIEWS - len(groups), 0)
    if more:
        groups += views[:: -(-len(views) // more)]
    try:
        return calibrate_camera([grey(radiometry, sequence, g)[0] for g in groups], board)
    except CalibrationError:
        if "camera" in sequence.rig:
            return None
        raise


def _stated_pose(frame: Frame) -> Rigid:
    """From the centre of projection and the turn of the camera that the table has."""
    values = numbers_of(frame, CAMERA_COLUMNS)
    eye, (w, x, y, z) = values[:3], values[3:]
    if abs(np.linalg.norm(values[3:]) - 1) > 1e-2:
        raise CalibrationError(
            f"{frame.file}: camera_qw … camera_qz have length {np.linalg.norm(values[3:]):.3g}; "
            "expected a unit quaternion from the sample's frame to the camera's",
        )
    turn = Rotation.from_quat([x, y, z, w]).as_matrix()
    return Rigid(turn, -turn @ eye)


def _solved(camera: Camera, points: Floats, pixels: Floats) -> Rigid:
    """The pose of flat points that pixels show: the better of the two that a plane has."""
    import cv2

    _, turn, shift = cv2.solvePnP(
        points, pixels, camera.matrix, camera.parameters[4:], flags=cv2.SOLVEPNP_IPPE
    )
    turn, shift = cv2.solvePnPRefineLM(
        points, pixels, camera.matrix, camera.parameters[4:], turn, shift
    )
    return Rigid.from_vectors(np.asarray(turn).reshape(3), np.asarray(shift).reshape(3))


def _kept(camera: Camera, points: Floats, pixels: Floats) -> tuple[Rigid, float]:
    """The pose by what fits it, and its residual, px rms."""
    keep = np.ones(len(points), bool)
    while True:
        pose = _solved(camera, points[keep], pixels[keep])
        miss = np.linalg.norm(camera.project(pose(points)) - pixels, axis=1)
        good = miss < 5 * max(float(np.median(miss[keep])), 0.02)
        if good.sum() < _FEWEST_CORNERS or (good == keep).all() or not (keep & ~good).any():
            return pose, float(np.sqrt(np.mean(miss[keep] ** 2)))
        keep &= good
