"""Measured directions as a triangulation of the hemisphere.

Directions are triangulated in parabolic coordinates (x, y) / (1 + z), where the hemisphere is the
unit disc; a ring just outside it, each of whose points stands for the nearest measured direction,
makes every query of the hemisphere fall into a triangle.
"""

from __future__ import annotations

from typing import NamedTuple, final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import Delaunay

from btfkit import directions
from btfkit.directions import Floats

Index = NDArray[np.intp]
# The ring touches the disc at 1: this much further out rounding cannot leave it.
_RING_RADIUS = 1.02


def parabolic(direction: ArrayLike) -> Floats:
    """(..., 2) parabolic coordinates of (..., 3) unit vectors; the hemisphere is the unit disc."""
    d = np.asarray(direction, float)
    return d[..., :2] / (1 + d[..., 2:])


class Tables(NamedTuple):
    """A triangulation as arrays, for evaluators elsewhere.

    Attributes:
        rows: (t, 3) rows of the table of directions at each triangle's corners.
        frame: (t, 2, 2), origin: (t, 2): barycentric coordinates of the first two corners are
            frame x (p - origin), p parabolic.
        cells, half: p in -half..half falls into one of cells x cells squares, x first.
        reaching: (cells^2, k) the triangles that reach into each.
    """

    rows: Index
    frame: Floats
    origin: Floats
    cells: int
    half: float
    reaching: Index


@final
class DirectionMesh:
    """A Delaunay triangulation of directions of the upper hemisphere.

    Args:
        table: (m, 3) distinct unit vectors, z at least 0.
    """

    def __init__(self, table: NDArray[np.floating]) -> None:
        d = np.asarray(table, float)
        lowest = int(np.sum(d[:, 2] <= d[:, 2].min() + 1e-3))
        count = max(10, lowest)
        azimuth = 2 * np.pi * np.arange(count) / count
        horizon = directions.from_angles(np.full(count, np.pi / 2), azimuth)
        radius = _RING_RADIUS / np.cos(np.pi / count)
        self.stands_for = np.concatenate([np.arange(len(d)), np.argmax(horizon @ d.T, axis=1)])
        self.points = np.concatenate([parabolic(d), radius * horizon[:, :2]])
        self._half = float(np.abs(self.points).max()) * (1 + 1e-9)
        self._triangulate()

    def _triangulate(self) -> None:
        triangles = Delaunay(self.points).simplices
        a, b, c = (self.points[triangles[:, k]] for k in range(3))
        edge, other = a - c, b - c
        area = edge[:, 0] * other[:, 1] - edge[:, 1] * other[:, 0]
        # Slivers between points on one line have no inverse, and no inside.
        whole = np.abs(area) > 1e-14
        edge, other, area = edge[whole], other[whole], area[whole]
        self._triangles, self._origin = triangles[whole], c[whole]
        rows = np.stack([other[:, 1], -other[:, 0], -edge[:, 1], edge[:, 0]], axis=1)
        self._frame = (rows / area[:, None]).reshape(-1, 2, 2)
        self._cells = int(np.clip(2 * np.sqrt(len(self._triangles)), 4, 64))
        corners = self.points[self._triangles]
        low, high = (self._cell(bound) for bound in (corners.min(axis=1), corners.max(axis=1)))
        cell = np.arange(self._cells)
        within = [
            (low[:, k, None] <= cell) & (cell <= high[:, k, None]) for k in range(2)
        ]  # each (triangles, cells)
        reached = (within[0][:, :, None] & within[1][:, None]).reshape(len(corners), -1)
        home, triangle = np.nonzero(reached.T)
        count = reached.sum(axis=0)
        slot = np.arange(len(home)) - np.repeat(np.cumsum(count) - count, count)
        # The triangles that reach into each cell of a grid over the disc; the first one pads.
        self._reaching = np.zeros((self._cells**2, count.max()), np.intp)
        self._reaching[home, slot] = triangle

    def _cell(self, point: Floats) -> Index:
        cell = (point / self._half + 1) * (self._cells / 2)
        return np.clip(cell.astype(np.intp), 0, self._cells - 1)

    def tables(self) -> Tables:
        """The triangulation as arrays."""
        rows = self.stands_for[self._triangles]
        return Tables(rows, self._frame, self._origin, self._cells, self._half, self._reaching)

    def weights(self, direction: NDArray[np.floating]) -> tuple[Index, Floats]:
        """Three rows of the table and their weights, not negative and of sum 1.

        Args:
            direction: (b, 3) unit vectors, z at least 0.

        Returns:
            (b, 3) rows of the table, (b, 3) weights.
        """
        p = parabolic(direction)
        cell = self._cell(p)
        home = cell[:, 0] * self._cells + cell[:, 1]
        best = np.full(len(p), -np.inf)
        chosen = np.zeros(len(p), np.intp)
        for candidates in self._reaching.T:
            triangle = candidates[home]
            inside = self._barycentric(triangle, p).min(axis=1)
            better = inside > best
            best[better], chosen[better] = inside[better], triangle[better]
        weight = self._barycentric(chosen, p)
        # A query on a measured direction is that direction, not its neighbours by rounding.
        weight[weight < 1e-6] = 0
        weight /= weight.sum(axis=1, keepdims=True)
        return self.stands_for[self._triangles[chosen]], weight

    def _barycentric(self, triangle: Index, p: Floats) -> Floats:
        """(b, 3) weights of the corners of a triangle each, negative where p is outside."""
        frame, step = self._frame[triangle], p - self._origin[triangle]
        first = frame[:, 0, 0] * step[:, 0] + frame[:, 0, 1] * step[:, 1]
        second = frame[:, 1, 0] * step[:, 0] + frame[:, 1, 1] * step[:, 1]
        return np.stack([first, second, 1 - first - second], axis=1)
