"""Sampling lobes of a whole tile, coarser and coarser."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import Wrap
from btfkit.materials.lobes.density import Lobe

Array = NDArray[np.float32]
# Columns of a table.
COLUMNS = ("slope_x", "slope_y", "alpha", "share", "grazing")
# Sharper than this, a sample that just misses has a density near 0.
LEAST_ALPHA = 0.03
# The cosine lobe keeps a tenth of the samples: no answer is ever without density.
MOST_SHARE = 0.9


@final
@dataclass(frozen=True, eq=False)
class LobeTable:
    """Lobes of a tile by cell.

    Attributes:
        levels: (h, w, 5) of each level, finest first; what `COLUMNS` name, v down the rows.
        grid: (h, w) of the data's grid, in which footprints count.
        wrap: whether the tile repeats.

    Raises:
        ValueError: other shapes, or numbers that no lobe has.
    """

    levels: tuple[Array, ...]
    grid: tuple[int, int]
    wrap: Wrap

    def __post_init__(self) -> None:
        for level in self.levels:
            if level.ndim != 3 or level.shape[2] != len(COLUMNS):
                raise ValueError(f"lobes have shape {level.shape}; expected (h, w, {len(COLUMNS)})")
            low, high = level.min(axis=(0, 1)), level.max(axis=(0, 1))
            if not (np.isfinite(level).all() and low[2] > 0 and low[3:].min() >= 0):
                raise ValueError("lobes hold numbers that no lobe has")
            if high[3:].max() > 0.95:
                raise ValueError(f"a lobe takes {high[3:].max():g} of the samples; at most 0.95")

    @staticmethod
    def of(finest: Array, *, grid: tuple[int, int], wrap: Wrap) -> LobeTable:
        """The table whose finest level (h, w, 5) is given."""
        levels = [np.ascontiguousarray(finest, np.float32)]
        while max(levels[-1].shape[:2]) > 1:
            levels.append(_coarser(levels[-1]))
        return LobeTable(tuple(levels), grid, wrap)

    def level(self, footprint: NDArray[Any]) -> NDArray[np.intp]:
        """(b,) the level whose cells are as wide as footprints (b,), texels of the grid."""
        cells = self.levels[0].shape[:2]
        finest = max(g / c for g, c in zip(self.grid, cells, strict=True))
        wide = np.log2(np.clip(2 * footprint / finest, 1, 1e30))
        return np.minimum(np.rint(wide), len(self.levels) - 1).astype(np.intp)

    def at(self, place: NDArray[Any], footprint: NDArray[Any]) -> Lobe:
        """The lobes of places (b, 2), in tiles, under footprints (b,): those of their cells."""
        found = np.empty((len(place), len(COLUMNS)))
        level = self.level(np.broadcast_to(footprint, len(place)))
        for k in np.unique(level):
            rows = np.flatnonzero(level == k)
            row, col = cell_of(place[rows], self.levels[k].shape[:2], self.wrap)
            found[rows] = self.levels[k][row, col]
        return Lobe(found[:, :2], *found.T[2:])


def cell_of(
    place: NDArray[Any], size: tuple[int, ...], wrap: Wrap
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Row and column (b,) of the cells in which places (b, 2) lie."""
    inside = place - np.floor(place) if wrap == "wrap" else np.clip(place, 0, 1)
    col, row = (
        np.minimum((inside[:, k] * n).astype(np.intp), n - 1)
        for k, n in ((0, size[1]), (1, size[0]))
    )
    return row, col


def _coarser(level: Array) -> Array:
    """Half the cells each way: slopes that differ become roughness, as variances add up.

    Source: Olano and Baker, "LEAN Mapping", 2010; the variance of slopes along each axis of a
    lobe is alpha^2 / 2.
    """
    square = np.square(level[..., 2]) + np.square(level[..., :2]).sum(axis=2)
    packed = np.concatenate([level, square[..., None]], axis=2)
    counts = np.ones(level.shape[:2])
    for axis in (0, 1):
        n = packed.shape[axis]
        starts = np.arange(max(n // 2, 1)) * n // max(n // 2, 1)
        packed = np.add.reduceat(packed, starts, axis=axis)
        counts = np.add.reduceat(counts, starts, axis=axis)
    packed = packed / counts[..., None]
    rough = packed[..., 5] - np.square(packed[..., :2]).sum(axis=2)
    packed[..., 2] = np.sqrt(np.clip(rough, LEAST_ALPHA**2, 1))
    return np.ascontiguousarray(packed[..., :5], np.float32)
