"""The holder of the twin: a plate with board, patches and white reference, drawn once."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any, final

import cv2
import numpy as np
from numpy.typing import NDArray

from btfkit.devices.poses import Floats
from btfkit.devices.twin import layout
from btfkit.devices.twin.geometry import Truth

Image = NDArray[np.float32]
# Reflectance of ink, paper, mount and of what lies beyond the plate.
_INK, _PAPER, _MOUNT, _CLOTH = 0.04, 0.85, 0.06, 0.015


@final
class Plate:
    """Reflectance of the plate in its own plane, each texel the mean over its area.

    Args:
        target: section of the description. truth: how far things are displaced.
        texels_per_mm: of the drawing.

    Attributes:
        drawing: (H, W, 4) linear sRGB, and how much of a texel is white reference.
        size_mm: (width, height) of what is drawn.
    """

    def __init__(self, target: Mapping[str, Any], truth: Truth, texels_per_mm: float) -> None:
        across, down = layout.BOARD
        margin = 4 * layout.SQUARE_MM
        self.size_mm = (
            across * layout.SQUARE_MM + margin, down * layout.SQUARE_MM + margin
        )  # fmt: skip
        self._scale = texels_per_mm
        grey = _board_drawing(self.size_mm, texels_per_mm)
        self.drawing: Image = np.zeros((*grey.shape, 4), np.float32)
        self.drawing[..., :3] = grey[..., None]
        half = layout.MOUNT_MM / 2
        self._fill((-half, half), (-half, half), (_MOUNT,) * 3)
        for patch, shift in zip(target["patches"], truth.displaced, strict=False):
            self._patch(patch, shift)
        self._patch(target["white"], truth.displaced[-1], white=1.0)

    def texels(self, points: Image) -> Image:
        """(..., 2) columns and rows of the drawing for x and y in mm."""
        h, w = self.drawing.shape[:2]
        scale = np.array([self._scale, -self._scale], np.float32)
        return points * scale + np.array([w / 2 - 0.5, h / 2 - 0.5], np.float32)

    def at(self, points: Image) -> Image:
        """(h, w, 4) of the drawing at (h, w, 2) x and y in mm, between texels bilinear."""
        where = self.texels(points)
        return np.asarray(
            cv2.remap(
                self.drawing, where[..., 0], where[..., 1], cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REPLICATE,
            )
        )  # fmt: skip

    def _patch(self, entry: Mapping[str, Any], shift: Floats, *, white: float = 0.0) -> None:
        (x, y), (w, h) = np.asarray(entry["centre_mm"][:2]) + shift, entry["size_mm"]
        self._fill((x - w / 2, x + w / 2), (y - h / 2, y + h / 2), entry["reflectance"], white)

    def _fill(
        self,
        x: tuple[float, float],
        y: tuple[float, float],
        reflectance: Sequence[float],
        white: float = 0.0,
    ) -> None:
        _fill(self.drawing, self._scale, x, y, (*reflectance, white))


@functools.lru_cache(maxsize=2)
def _board_drawing(size_mm: tuple[float, float], scale: float) -> Image:
    """(H, W) of cloth and board: thousands of modules, the same for every twin."""
    w, h = (round(side * scale) for side in size_mm)
    drawing = np.full((h, w, 1), _CLOTH, np.float32)
    across, down = layout.BOARD
    left, top = -across * layout.SQUARE_MM / 2, down * layout.SQUARE_MM / 2
    _fill(drawing, scale, (left, -left), (-top, top), (_PAPER,))
    # Summed, not painted one over the other: texels on a border that two squares of ink share
    # would keep some paper, and borders would move towards the square that was painted last.
    inked = np.zeros((h, w), np.float32)
    for x, y, side in inked_squares():
        cols, over = _covered(w, (left + x) * scale + w / 2, (left + x + side) * scale + w / 2)
        rows, under = _covered(h, h / 2 - (top - y) * scale, h / 2 - (top - y - side) * scale)
        inked[rows, cols] += under[:, None] * over
    return np.asarray(drawing[..., 0] + inked * np.float32(_INK - _PAPER))


def _fill(
    drawing: Image,
    scale: float,
    x: tuple[float, float],
    y: tuple[float, float],
    value: Sequence[float],
) -> None:
    """Paint a rectangle; texels on its border get their share."""
    h, w = drawing.shape[:2]
    cols, across = _covered(w, x[0] * scale + w / 2, x[1] * scale + w / 2)
    rows, down = _covered(h, h / 2 - y[1] * scale, h / 2 - y[0] * scale)
    share = (down[:, None] * across)[..., None]
    part = drawing[rows, cols]
    part += share * (np.asarray(value, np.float32) - part)


def inked_squares() -> list[tuple[float, float, float]]:
    """Black squares of the board, then black modules of its markers: left, top, side (mm, y down).

    As OpenCV's CharucoBoard of the same numbers has them.
    """
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, layout.DICTIONARY))
    board = cv2.aruco.CharucoBoard(layout.BOARD, layout.SQUARE_MM, layout.MARKER_MM, dictionary)
    across, down = layout.BOARD
    modules = dictionary.markerSize + 2
    marked = {}
    for number, corners in zip(
        np.asarray(board.getIds()).ravel(), board.getObjPoints(), strict=True
    ):
        left, top = (float(c) for c in np.asarray(corners)[0, :2])
        marked[int(left / layout.SQUARE_MM), int(top / layout.SQUARE_MM)] = (number, left, top)
    found = [
        (i * layout.SQUARE_MM, j * layout.SQUARE_MM, layout.SQUARE_MM)
        for j in range(down) for i in range(across) if (i, j) not in marked
    ]  # fmt: skip
    side = layout.MARKER_MM / modules
    for number, left, top in marked.values():
        bits = dictionary.generateImageMarker(int(number), modules, borderBits=1)
        black = np.argwhere(np.asarray(bits) == 0)
        found += [(left + col * side, top + row * side, side) for row, col in black.tolist()]
    return found


def _covered(count: int, low: float, high: float) -> tuple[slice, Image]:
    """Texels that an interval touches, and the share of each that it covers."""
    first, last = max(int(np.floor(low)), 0), min(int(np.ceil(high)), count)
    edges = np.arange(first, last)
    share = np.minimum(edges + 1, high) - np.maximum(edges, low)
    return slice(first, last), np.asarray(np.clip(share, 0, 1), np.float32)
