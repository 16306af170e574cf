"""A camera from views of a board, each view with a pose of its own.

OpenCV's solver starts it; corners are then fitted again with the model, since OpenCV puts them
where a homography that knows no distortion expects them, and what does not fit is rejected.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit.calibration import corners
from btfkit.calibration.board import Board
from btfkit.calibration.camera_model import PARAMETERS, Camera
from btfkit.calibration.kinematics import Rigid
from btfkit.errors import CalibrationError

Floats = NDArray[np.float64]
# Residuals beyond this many robust standard deviations are no noise.
_REJECT = 5.0
# A robust spread below this is the arithmetic's, not the detector's, px.
_LEAST_PX = 0.01
_FEWEST_VIEWS = 3
# Of a view: OpenCV takes no pose from fewer corners, nor from any number of them in one row.
_FEWEST_CORNERS = 6
_ROUNDS = 2
_BLUR_VIEWS = 3
# Pixels that a cell of a marker needs to be read: on drawn boards of three dictionaries all markers
# are found from 4 on, from above from 3 on, and next to none below 2.5.
_CELL_PX = (3.0, 4.0)
# Views whose boards are more nearly parallel than this tell no focal length.
_LEAST_TILT_DEG = 5.0
# Relative standard deviation above which a focal length is not known.
_FOCAL_SD = 0.01


@final
@dataclass(frozen=True, eq=False)
class View:
    """The corners of a board in one frame.

    Attributes:
        numbers: (k,) corners of the board. pixels: (k, 2) where they are.
        pose: board to camera.
    """

    numbers: NDArray[np.intp]
    pixels: Floats
    pose: Rigid

    def keep(self, mask: NDArray[np.bool_]) -> View:
        return replace(self, numbers=self.numbers[mask], pixels=self.pixels[mask])


@final
@dataclass(frozen=True, eq=False)
class SingleCamera:
    """What views of a board tell of a camera.

    Attributes:
        camera: the estimate. sd: (9,) standard deviations of its parameters.
        views: one a frame, None where fewer than six corners are found that fit, or one row.
        residual_px: rms of what was kept. rejected: corners that did not fit.
        blur_px: standard deviation of the lens's blur that corners were fitted with.
    """

    camera: Camera
    sd: Floats
    views: tuple[View | None, ...]
    residual_px: float
    rejected: int
    blur_px: float


def calibrate_camera(
    images: Sequence[Floats],
    board: Board,
    *,
    blur_px: float | None = None,
    cell_px: Sequence[float] | None = None,
) -> SingleCamera:
    """A camera and the poses of a board in its frames.

    k3 is held at 0: a board rarely reaches where k2 and k3 differ.

    Args:
        images: (h, w) linear frames of one camera with the board in view.
        board: what is seen.
        blur_px: standard deviation of the lens's blur, beside the pixel's own square; None
            measures it on those views that look at the board most squarely.
        cell_px: of a marker, expected in each frame, for the message where none is found; None
            takes what a board that fills the frame would have.

    Raises:
        CalibrationError: fewer than three frames show six corners that fit, or their views are too
            alike.
    """

    def posed(views: Mapping[int, View]) -> dict[int, View]:
        """Those by frame that have a pose to tell, once they are enough."""
        told = {i: view for i, view in views.items() if _tells_pose(view, board)}
        if len(told) < _FEWEST_VIEWS:
            raise _unseen(images, board, len(told), cell_px)
        return told

    blank = Rigid.identity()
    views = posed({i: View(*board.detect(image), blank) for i, image in enumerate(images)})
    height, width = images[0].shape
    camera, views, sd = _solve(views, board, width, height)
    _refuse_parallel(list(views.values()))
    camera, views, sd, rejected = _settled(views, board, width, height, posed)
    if blur_px is None:
        squarest = sorted(views, key=lambda i: -abs(views[i].pose.rotation[2, 2]))[:_BLUR_VIEWS]
        blurs = [
            corners.blur_of(board, images[i], views[i].numbers, camera, views[i].pose)
            for i in squarest
        ]
        blur_px = float(np.median(blurs))
    every = np.arange(len(board.corners_mm))
    for turn in range(_ROUNDS):
        # All corners that frames may show, those that detection missed among them; then the good.
        views = {
            i: _refined(
                images[i], view, every if turn == 0 else view.numbers, board, camera, blur_px
            )
            for i, view in views.items()
        }
        camera, views, sd, rejected = _settled(views, board, width, height, posed)
    if max(sd[:2] / camera.parameters[:2]) > _FOCAL_SD:
        raise CalibrationError(
            f"the focal length comes as {camera.parameters[0]:.1f} ± {sd[0]:.1f} px: the views are "
            "too alike",
            remedy="add views tilted by 30 degrees and more, about two axes",
        )
    residual = np.concatenate([_residuals(camera, view, board) for view in views.values()])
    rms = float(np.sqrt((residual**2).sum(1).mean()))
    by_frame = tuple(views.get(i) for i in range(len(images)))
    return SingleCamera(camera, sd, by_frame, rms, rejected, blur_px)


def _tells_pose(view: View, board: Board) -> bool:
    """Whether a view has corners enough, and they do not lie in one row."""
    points = board.corners_mm[view.numbers]
    return len(points) >= _FEWEST_CORNERS and np.linalg.matrix_rank(points - points[0]) == 2


def _unseen(
    images: Sequence[Floats], board: Board, seen: int, cell_px: Sequence[float] | None
) -> CalibrationError:
    """Why the board is not found: markers of too few pixels, else the description or the light."""
    said = (
        f"the board is seen in {seen} of {len(images)} frames; at least {_FEWEST_VIEWS} are needed"
        f", {_FEWEST_CORNERS} corners in each that fit and are not in one row"
    )
    remedy = (
        "check target.board of sequence.json, the exposure of the target frames and how much of "
        "them the board fills"
    )
    if len(images):
        height, width = images[0].shape
        cell = board.most_cell_px(width, height)
        if cell_px is not None:
            cell = float(np.median([px for px in cell_px if np.isfinite(px)] or [np.inf]))
        if cell < _CELL_PX[0]:
            marker = cell * board.cells
            upright, tilted = _CELL_PX
            said += (
                f": in frames of {width} x {height} a marker of {board.marker_mm:g} mm is "
                f"{'at most ' if cell_px is None else ''}{marker:.1f} pixels wide, {cell:.1f} for "
                f"each of its {board.cells} cells; {upright:g} are needed from above, {tilted:g} "
                f"tilted ({tilted * board.cells:g} a marker)"
            )
            remedy = (
                "take a sensor of more pixels, a nearer camera, or a board of fewer and larger "
                "markers"
            )
    return CalibrationError(said, remedy=remedy)


def _refined(
    image: Floats,
    view: View,
    numbers: NDArray[np.intp],
    board: Board,
    camera: Camera,
    blur_px: float,
) -> View:
    """The view with corners fitted to the frame, those of `numbers` that it shows."""
    pixels, _ = corners.refine(board, image, numbers, camera, view.pose, blur_px=blur_px)
    good = np.isfinite(pixels).all(axis=1)
    if good.sum() < _FEWEST_CORNERS:
        return view
    return View(numbers[good], pixels[good], view.pose)


def _settled(
    views: dict[int, View],
    board: Board,
    width: int,
    height: int,
    posed: Callable[[Mapping[int, View]], dict[int, View]],
) -> tuple[Camera, dict[int, View], Floats, int]:
    """Solve, reject what is far off, solve again, until nothing is.

    Views that this leaves too little of go as a whole: `posed` says which stay.
    """
    before = sum(len(view.numbers) for view in views.values())
    while True:
        camera, views, sd = _solve(views, board, width, height)
        residuals = [np.abs(_residuals(camera, view, board)).max(axis=1) for view in views.values()]
        # Corners that the camera would have behind it fit nowhere.
        every = np.concatenate(residuals)
        typical = float(np.median(every[np.isfinite(every)])) if np.isfinite(every).any() else 0.0
        spread = max(1.4826 * typical, _LEAST_PX)
        keep = [r < _REJECT * spread for r in residuals]
        if all(k.all() for k in keep):
            break
        kept = zip(views.items(), keep, strict=True)
        views = posed({i: view.keep(k) for (i, view), k in kept})
    return camera, views, sd, before - sum(len(view.numbers) for view in views.values())


def _solve(
    views: dict[int, View], board: Board, width: int, height: int
) -> tuple[Camera, dict[int, View], Floats]:
    import cv2

    objects = [board.corners_mm[view.numbers].astype(np.float32) for view in views.values()]
    pixels = [view.pixels.astype(np.float32) for view in views.values()]
    try:
        _, matrix, numbers, turns, shifts, deviations, _, _ = cv2.calibrateCameraExtended(
            objects, pixels, (width, height), None, None, flags=cv2.CALIB_FIX_K3
        )
    except cv2.error as error:
        fewest = min(len(view.numbers) for view in views.values())
        raise CalibrationError(
            f"OpenCV finds no camera for {len(views)} views of the board, of {fewest} corners and "
            f"more: {' '.join(error.err.split())}",
            remedy="add views tilted by 30 degrees and more, about two axes",
        ) from error
    values = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *numbers.reshape(-1)[:5]]
    camera = Camera(width, height, np.array(values))
    poses = [
        Rigid.from_vectors(turn.reshape(3), shift.reshape(3))
        for turn, shift in zip(turns, shifts, strict=True)
    ]
    solved = zip(views.items(), poses, strict=True)
    views = {i: replace(view, pose=pose) for (i, view), pose in solved}
    return camera, views, np.asarray(deviations, float).reshape(-1)[: len(PARAMETERS)]


def _residuals(camera: Camera, view: View, board: Board) -> Floats:
    return camera.project(view.pose(board.corners_mm[view.numbers])) - view.pixels


def _refuse_parallel(views: list[View]) -> None:
    normals = np.stack([view.pose.rotation[:, 2] for view in views])
    cosines = np.clip(normals @ normals.T, -1, 1)
    widest = float(np.degrees(np.arccos(cosines.min())))
    if widest < _LEAST_TILT_DEG:
        raise CalibrationError(
            f"the board stands within {widest:.1f} degrees of parallel in all {len(views)} views; "
            "focal length and distance cannot be told apart",
            remedy="add views tilted by 30 degrees and more, or give the camera in sequence.json",
        )
