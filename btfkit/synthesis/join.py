"""The ends of a sample joined: which texel of the tile comes from where."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from btfkit.synthesis.indexmap import IndexMap
from btfkit.synthesis.period import Side
from btfkit.synthesis.seam import closed_cut, open_cut
from btfkit.synthesis.summary import Summary

Index = NDArray[np.intp]
Grid = tuple[Index, Index]
# A sample may lie askew by this slope, if its ends agree so much better then.
_LEAN, _GAIN = 1 / 16, 0.1


def joined(summary: Summary, rows: Side, cols: Side) -> IndexMap:
    """The tile whose ends are joined by cuts of least error.

    First the columns are joined over all rows of the window. What that gives has no side any
    more, so the cut that joins its rows runs around it and closes, whatever it crosses.
    """
    height = rows.tile + rows.overlap
    row, col = np.indices((height, cols.tile))
    ring = row + rows.start, col + cols.start
    if cols.overlap:
        ring = _ring(summary, ring, cols, closes=not rows.overlap)
    if rows.overlap:
        ring = _closed(summary, ring, rows)
    return IndexMap(*ring, (rows.size, cols.size))


def _ring(summary: Summary, window: Grid, cols: Side, *, closes: bool) -> Grid:
    """A window whose right end continues in its left.

    Args:
        window: (h, q) rows and columns of the sample. cols: what is beyond them.
        closes: whether its rows meet already: then the cut must meet itself too.
    """
    row, col = window
    band = row[:, : cols.overlap], col[:, : cols.overlap]
    parts = summary.mismatch(band, (band[0], band[1] + cols.tile))
    cut = (closed_cut if closes else open_cut)(*(part.T for part in parts))
    return row, col + cols.tile * (np.arange(cols.tile) < cut[:, None])


def _closed(summary: Summary, ring: Grid, rows: Side) -> Grid:
    """The tile (p, q) of a ring (p + o, q) whose lower end continues in its upper."""
    row, col = ring
    p, q = rows.tile, col.shape[1]
    near = row[: rows.overlap], col[: rows.overlap]
    far = row[p : p + rows.overlap], col[p : p + rows.overlap]
    lean = _lean(summary, near, far, p)
    cut = closed_cut(*summary.mismatch(near, (far[0], np.roll(far[1], -lean, axis=1))))
    x, y = np.indices((p, q))
    beyond = x < cut
    # Straightened row by row: going down one tile leads back to the same column.
    turned = (y + np.rint(lean * x / p).astype(np.intp)) % q
    x, y = x + p * beyond, (y + lean * beyond) % q
    x, y = (np.take_along_axis(part, turned, axis=1) for part in (x, y))
    return row[x, y], col[x, y]


def _lean(summary: Summary, near: Grid, far: Grid, tile: int) -> int:
    """Columns by which the far end continues the near one better than straight; 0 for none.

    A sample that lies a little askew agrees with itself a tile down and a few columns aside.
    """
    a, b = (np.nan_to_num(summary.flat[:, at[0], at[1]]) for at in (near, far))
    spectra = np.fft.rfft(a, axis=2).conj() * np.fft.rfft(b, axis=2)
    scale = np.sqrt(np.square(a, dtype=float).sum() * np.square(b, dtype=float).sum())
    agreement = np.fft.irfft(spectra.sum(axis=(0, 1)), a.shape[2]) / max(scale, 1e-30)
    most = round(min(a.shape[2], tile) * _LEAN)
    leans = np.arange(-most, most + 1)
    best = int(leans[np.argmax(agreement[leans])])
    return best if agreement[best] > agreement[0] + _GAIN else 0
