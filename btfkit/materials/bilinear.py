"""Lookups between texel centres, wrapped where the material tiles and clamped where not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import Wrap

Array = NDArray[np.float32]
Index = NDArray[np.intp]


def corners(
    uv: NDArray[np.floating], size: tuple[int, int], wrap: Wrap
) -> tuple[Index, Index, Array]:
    """The four texels around places on a grid, and their bilinear weights.

    Args:
        uv: (b, 2) within 0..1, texel centres at ((col + 1/2) / w, (row + 1/2) / h).
        size: (h, w) of the grid.
        wrap: what lies beyond its border.

    Returns:
        rows, cols (b, 4) and weights (b, 4) of sum 1; a corner of weight 0 is valid, too.
    """
    (left, right, across), (top, bottom, down) = (
        _beside(uv[:, axis], count, wrap) for axis, count in ((0, size[1]), (1, size[0]))
    )
    rows = np.stack([top, top, bottom, bottom], axis=1)
    cols = np.stack([left, right, left, right], axis=1)
    weight = np.stack(
        [(1 - down) * (1 - across), (1 - down) * across, down * (1 - across), down * across],
        axis=1,
    )
    return rows, cols, weight.astype(np.float32)


def lookup(texture: NDArray[np.floating], uv: NDArray[np.floating], wrap: Wrap) -> Array:
    """(b, d) values of a texture (h, w, d) at places (b, 2), bilinear."""
    h, w, d = texture.shape
    rows, cols, weight = corners(uv, (h, w), wrap)
    flat = texture.reshape(h * w, d)
    out = np.zeros((len(uv), d), np.float32)
    for corner in range(4):
        out += weight[:, corner, None] * flat[rows[:, corner] * w + cols[:, corner]]
    return out


def _beside(
    position: NDArray[np.floating], count: int, wrap: Wrap
) -> tuple[Index, Index, NDArray[np.float64]]:
    """The texels on both sides of a position on one axis, and the share of the second."""
    at = position.astype(np.float64) * count - 0.5
    # uv in float32 misses a centre by 6e-8 of the tile: that is still the centre.
    nearest = np.rint(at)
    at = np.where(np.abs(at - nearest) < 2.5e-7 * count, nearest, at)
    first = np.floor(at)
    share = at - first
    low = first.astype(np.intp)
    if wrap == "wrap":
        return low % count, (low + 1) % count, share
    return np.clip(low, 0, count - 1), np.clip(low + 1, 0, count - 1), share
