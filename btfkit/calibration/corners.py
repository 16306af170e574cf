"""Corners of a board fitted with its own picture, as the estimated camera would see it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize

from btfkit.calibration.board import Board
from btfkit.calibration.camera_model import Camera
from btfkit.calibration.kinematics import Rigid

Floats = NDArray[np.float64]
# Half width of the part of the pattern that a corner is fitted to, in squares and in pixels.
_REACH_SQUARES, _REACH_PX = 0.6, 11
_SUBPIXELS = 2
# Windows that the drawing leaves this much more of than of most show something else too.
_COVERED = 3.0
_SETTLED_PX = 1e-2
# Corners that are enough to tell how sharp the lens is.
_BLUR_CORNERS = 24


def refine(
    board: Board,
    image: Floats,
    numbers: NDArray[np.intp],
    camera: Camera,
    pose: Rigid,
    *,
    blur_px: float,
) -> tuple[Floats, Floats]:
    """Corners fitted with the board's own picture as the camera would see it.

    A homography knows neither the lens nor the markers beside a corner; the picture of the
    board in the estimated pose knows both, and is moved until it lies on the frame.

    Args:
        image: (h, w) linear values.
        numbers: (k,) corners to fit.
        camera, pose: estimates, board to camera; good to about a pixel.
        blur_px: standard deviation of the lens's blur.

    Returns:
        (k, 2) pixels, NaN where the frame does not show the corner or something else lies
        on it; and (k, 2) their standard deviations, of what the drawing leaves of the frame.
    """
    start = camera.project(pose(board.corners_mm[numbers]))
    window = _Window.around(image, start, _reach_px(board, camera, pose, numbers))
    shift = np.zeros_like(start)
    for _ in range(4):
        drawn = _drawn(board, window, shift, camera, pose, blur_px)
        step = window.fit(drawn)
        shift += step
        # What is left then is a tenth of it and less.
        if not np.nanmedian(np.abs(step)) > _SETTLED_PX:
            break
    left = window.misfit(drawn)
    with np.errstate(invalid="ignore"):
        seen = np.abs(shift).max(axis=1) < 2.5
        # What something else lies upon is fitted worse than most.
        seen &= left < _COVERED * np.median(left[seen])
    sd = window.deviation(drawn)
    worst = sd.max(axis=1)
    seen &= worst < _COVERED * np.median(worst[seen])
    shift[~seen] = np.nan
    return start + shift, sd


def blur_of(
    board: Board, image: Floats, numbers: NDArray[np.intp], camera: Camera, pose: Rigid
) -> float:
    """Standard deviation of the lens's blur, px, beside the pixel's own square.

    Args:
        image: (h, w) linear values of a sharp, well lit view.
        numbers: (k,) corners that it shows.
        camera, pose: board to camera; good to a pixel.
    """
    numbers = numbers[:: max(len(numbers) // _BLUR_CORNERS, 1)]
    corners = camera.project(pose(board.corners_mm[numbers]))
    window = _Window.around(image, corners, _reach_px(board, camera, pose, numbers))

    def misfit(blur_px: float) -> float:
        shift = window.fit(_drawn(board, window, np.zeros_like(corners), camera, pose, blur_px))
        shift = np.nan_to_num(shift)
        drawn = _drawn(board, window, shift, camera, pose, blur_px)
        return float(np.median(window.misfit(drawn)))

    best = optimize.minimize_scalar(misfit, bounds=(0.05, 3.0), options={"xatol": 0.01})
    return float(best.x)


def _reach_px(board: Board, camera: Camera, pose: Rigid, numbers: NDArray[np.intp]) -> int:
    """Half width of the windows: the pattern's share, not more than the frame needs."""
    corners = board.corners_mm[numbers]
    reach = _REACH_SQUARES * board.square_mm
    sides = [camera.project(pose(corners + reach * np.eye(3)[i])) for i in (0, 1)]
    far = max(np.nanmax(np.abs(s - camera.project(pose(corners))), initial=3.0) for s in sides)
    return int(min(np.ceil(far), _REACH_PX))


def _drawn(
    board: Board, window: _Window, shift: Floats, camera: Camera, pose: Rigid, blur_px: float
) -> Floats:
    """(k, n, n) the pattern that each window would show, moved by its shift (k, 2)."""
    pad = int(np.ceil(3 * blur_px)) + 1
    fine = (np.arange((window.size + 2 * pad) * _SUBPIXELS) + 0.5) / _SUBPIXELS - 0.5
    fine = fine - pad - window.size // 2
    # Over a window the way back to the board is a parabola to 1e-4 px: nine exact rays.
    nodes = np.array([fine[0], 0.0, fine[-1]])
    columns, rows = np.meshgrid(nodes, nodes)
    pixels = np.stack([columns, rows], -1) + (window.centre - shift)[:, None, None, :]
    rays = camera.rays(pixels)
    normal, origin = pose.rotation[:, 2], pose.translation
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = (normal @ origin) / (rays @ normal)
    on_board = ((rays * depth[..., None] - origin) @ pose.rotation)[..., :2]
    basis = _parabola(nodes, fine)
    place = np.einsum("ya,kabd,xb->kyxd", basis, np.nan_to_num(on_board), basis, optimize=True)
    # What a sample covers of the print: as far to the sides as its own square.
    steps = [np.diff(place, axis=axis).reshape(len(place), -1, 2) for axis in (1, 2)]
    sides = np.sqrt(sum((step**2).mean(axis=1) for step in steps))[:, None, None]
    sides = np.maximum(sides, 1e-9)
    drawn = board.whiteness(place[..., 0], place[..., 1], sides[..., 0], sides[..., 1])
    if blur_px > 0:
        drawn = ndimage.gaussian_filter(
            drawn, (0, blur_px * _SUBPIXELS, blur_px * _SUBPIXELS), mode="nearest"
        )
    k, side = len(drawn), window.size + 2 * pad
    return drawn.reshape(k, side, _SUBPIXELS, side, _SUBPIXELS).mean((2, 4))[
        :, pad - 1 : 1 - pad, pad - 1 : 1 - pad
    ]


def _parabola(nodes: Floats, at: Floats) -> Floats:
    """(m, 3) weights of values at three nodes in the parabola through them, at places (m,)."""
    a, b, c = nodes
    return np.stack(
        [
            (at - b) * (at - c) / ((a - b) * (a - c)),
            (at - a) * (at - c) / ((b - a) * (b - c)),
            (at - a) * (at - b) / ((c - a) * (c - b)),
        ],
        -1,
    )


@final
@dataclass(frozen=True, eq=False)
class _Window:
    """Square parts of a frame about whole pixels.

    Attributes:
        values: (k, n, n), NaN outside the frame.
        centre: (k, 2) middle pixel. size: n, odd.
    """

    values: Floats
    centre: Floats
    size: int

    @staticmethod
    def around(image: Floats, pixels: Floats, reach: int) -> _Window:
        height, width = image.shape
        lost = np.isnan(pixels.sum(axis=1))
        centre = np.rint(np.where(lost[:, None], -1e6, pixels))
        offset = np.arange(-reach, reach + 1)
        rows = centre[:, 1, None, None].astype(int) + offset[:, None]
        columns = centre[:, 0, None, None].astype(int) + offset
        inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        values = image[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]
        return _Window(np.where(inside, values, np.nan), centre, 2 * reach + 1)

    def fit(self, drawn: Floats) -> Floats:
        """(k, 2) further shift that brings the drawn windows (k, n + 2, n + 2) onto the frame's.

        The frame is black level + light * drawn + slope; solved with the slopes of the drawing.
        """
        normal, right, _ = self._equations(drawn)
        shift = np.full((len(drawn), 2), np.nan)
        seen = np.isfinite(self.values).reshape(len(drawn), -1).mean(1) > 0.7
        for k in np.flatnonzero(seen):
            solved, _, rank, _ = np.linalg.lstsq(normal[k], right[k], rcond=1e-12)
            if rank == 6 and abs(solved[1]) > 0:
                shift[k] = -solved[4:] / solved[1]
        return np.clip(shift, -1, 1)

    def deviation(self, drawn: Floats) -> Floats:
        """(k, 2) standard deviations of `fit`'s shifts; infinite where nothing is told."""
        normal, right, square = self._equations(drawn)
        count = np.isfinite(self.values).reshape(len(drawn), -1).sum(1)
        out = np.full((len(drawn), 2), np.inf)
        for k in range(len(drawn)):
            solved, _, rank, _ = np.linalg.lstsq(normal[k], right[k], rcond=1e-12)
            if rank == 6 and count[k] > 6:
                noise = max(square[k] - right[k] @ solved, 0.0) / (count[k] - 6)
                spread = np.linalg.inv(normal[k])[[4, 5], [4, 5]]
                out[k] = np.sqrt(noise * spread) / max(abs(solved[1]), 1e-300)
        return out

    def misfit(self, drawn: Floats) -> Floats:
        """(k,) share of the windows' squares that the drawings leave."""
        normal, right, square = self._equations(drawn)
        left = np.empty(len(drawn))
        for k in range(len(drawn)):
            solved = np.linalg.lstsq(normal[k, :4, :4], right[k, :4], rcond=1e-12)[0]
            left[k] = (square[k] - right[k, :4] @ solved) / max(square[k], 1e-300)
        return left

    def _equations(self, drawn: Floats) -> tuple[Floats, Floats, Floats]:
        """Normal equations (k, 6, 6), right sides (k, 6) and squares (k,) of the windows."""
        inner = drawn[:, 1:-1, 1:-1]
        across = (drawn[:, 1:-1, 2:] - drawn[:, 1:-1, :-2]) / 2
        down = (drawn[:, 2:, 1:-1] - drawn[:, :-2, 1:-1]) / 2
        offset = np.arange(self.size) - self.size // 2
        columns, rows = (np.broadcast_to(a, inner.shape) for a in (offset, offset[:, None]))
        basis = np.stack([np.ones_like(inner), inner, columns, rows, across, down], -1)
        weight = np.isfinite(self.values).astype(float)
        basis = (basis * weight[..., None]).reshape(len(drawn), -1, 6)
        target = np.nan_to_num(self.values).reshape(len(drawn), -1)
        return (
            basis.transpose(0, 2, 1) @ basis,
            (basis.transpose(0, 2, 1) @ target[..., None])[..., 0],
            (target**2).sum(1),
        )
