"""Textures as buffers of Dr.Jit, four numbers to a fetch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import drjit as dr
import mitsuba as mi
import numpy as np

Numbers = list[Any]
# Numbers that one fetch brings.
_GROUP = 4


def kept(values: Any) -> Any:
    """Numbers as a buffer of Dr.Jit's own.

    Memory of numpy's mostly does not start where 16 numbers may be read at once, and Dr.Jit then
    fetches the four of a texel one by one.
    """
    found = mi.Float(np.ascontiguousarray(values, np.float32).reshape(-1)) + dr.opaque(mi.Float, 0)
    dr.eval(found)
    return found


@final
class Pyramid:
    """Levels of a texture in one buffer, bilinear between texel centres and between levels.

    Args:
        levels: (h, w, k) of each level, finest first. wrap: whether they tile.

    Attributes:
        texels: the buffer: levels one after the other, rows, columns, k padded to fours.
    """

    def __init__(self, levels: Sequence[Any], wrap: bool) -> None:
        self._wrap, self._count, self._channels = wrap, len(levels), levels[0].shape[-1]
        self._groups = -(-self._channels // _GROUP)
        sizes = np.array([level.shape[:2] for level in levels], np.uint32)
        starts = np.cumsum([0, *(int(h) * int(w) for h, w in sizes)])[:-1].astype(np.uint32)
        spare = self._groups * _GROUP - self._channels
        flat = [np.pad(np.asarray(x, np.float32), ((0, 0), (0, 0), (0, spare))) for x in levels]
        self.texels = kept(np.concatenate([level.reshape(-1) for level in flat]))
        self._one = (int(sizes[0, 1]), int(sizes[0, 0]), 0)
        self._tables = [mi.UInt32(part.copy()) for part in (sizes[:, 1], sizes[:, 0], starts)]

    def __call__(self, u: Any, v: Any, level: Any, active: Any) -> Numbers:
        """Every channel. Of level 0 and finer one level is read."""
        if self._count == 1:
            return self._level(u, v, self._one, active)
        at = dr.clip(level, 0, self._count - 1)
        finer = mi.UInt32(at)
        found = self._level(u, v, self._shape(finer, active), active)
        share = at - mi.Float(finer)
        between = active & (share > 0)
        coarse = self._shape(dr.minimum(finer + 1, self._count - 1), between)
        coarser = self._level(u, v, coarse, between)
        return [a + share * (b - a) for a, b in zip(found, coarser, strict=True)]

    def _shape(self, s: Any, active: Any) -> tuple[Any, Any, Any]:
        w, h, start = (dr.gather(mi.UInt32, table, s, active) for table in self._tables)
        return w, h, start

    def _level(self, u: Any, v: Any, shape: tuple[Any, Any, Any], active: Any) -> Numbers:
        w, h, start = shape
        (x0, x1, fx), (y0, y1, fy) = (beside(*axis, wrap=self._wrap) for axis in ((u, w), (v, h)))
        rows = [(start + y * w, share) for y, share in ((y0, 1 - fy), (y1, fy))]
        taps = [((row + x) * self._groups, share * part)
                for row, share in rows for x, part in ((x0, 1 - fx), (x1, fx))]  # fmt: skip
        found: Numbers = []
        for g in range(self._groups):
            four = sum(
                share * dr.gather(mi.Vector4f, self.texels, at + g, active) for at, share in taps
            )
            found += [four[k] for k in range(_GROUP)]
        return found[: self._channels]


@final
class Surface:
    """Heights of one tile: a fetch brings the four corners of a cell.

    Args:
        heights: (h, w). wrap: whether they tile.
    """

    def __init__(self, heights: Any, wrap: bool) -> None:
        h, w = heights.shape
        self._wrap, self._size = wrap, (w, h)
        # The cell at column x, row y lies between texels x - 1, x and y - 1, y.
        p = np.pad(np.asarray(heights, np.float32), 1, mode="wrap" if wrap else "edge")
        corners = np.stack([p[:-1, :-1], p[:-1, 1:], p[1:, :-1], p[1:, 1:]], axis=-1)
        self._corners = kept(corners)

    def __call__(self, u: Any, v: Any, active: Any) -> Any:
        """The height there."""
        w, h = self._size
        cells, shares = [], []
        for place, size in ((u, w), (v, h)):
            inside = place - dr.floor(place) if self._wrap else dr.clip(place, 0, 1)
            at = inside * float(size) - 0.5
            low = dr.floor(at)
            shares.append(at - low)
            cells.append(mi.UInt32(mi.Int32(dr.minimum(low, size - 1)) + 1))
        a, b, c, d = dr.gather(mi.Vector4f, self._corners, cells[1] * (w + 1) + cells[0], active)
        fx, fy = shares
        top, bottom = a + fx * (b - a), c + fx * (d - c)
        return top + fy * (bottom - top)


def beside(place: Any, size: Any, *, wrap: bool) -> tuple[Any, Any, Any]:
    """The two texels beside a place in 0..1 of `size` texels, and how far it is from the first."""
    inside = place - dr.floor(place) if wrap else dr.clip(place, 0, 1)
    at = inside * mi.Float(size) - 0.5
    low = dr.floor(at)
    share = at - low
    first, last = mi.Int32(low), mi.Int32(size) - 1
    second = first + 1
    if wrap:
        first = dr.select(first < 0, first + mi.Int32(size), first)
        first = dr.minimum(first, last)
        second = dr.select(second > last, 0, second)
        return mi.UInt32(first), mi.UInt32(second), share
    return mi.UInt32(dr.maximum(first, 0)), mi.UInt32(dr.minimum(second, last)), share
