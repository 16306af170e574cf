"""Heights from outlines: rays that are known to pass, or to be stopped, bound them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from btfkit.native.neural import bent
from btfkit.native.neural.layout import Array
from btfkit.native.neural.lookup import bilinear
from btfkit.program import Heights

# Places a ray is looked at for where it comes closest; the share of a gap that a step closes.
_LOOKS, _SHARE = 24, 0.2


def moved(
    found: Heights,
    uv: Array,
    view: Array,
    curvature: Array,
    passes: NDArray[np.bool_],
    *,
    aspect: float,
    wrap: bool,
) -> Array:
    """What is added to heights (h, w), units, so that rays do what they are known to do.

    A ray that should be stopped and is not lifts the heights where it comes closest; one that
    should pass and does not lowers them where it lies deepest. Each gap is closed as far as the
    four texels around allow with the least change (Kaczmarz), by a share; texels that several
    rays move take the mean.

    Args:
        uv: (b, 2). view: (b, 3). curvature: (b,) 1/tile width. passes: (b,) what is known.
    """
    rays = bent.rays_of(found, view, curvature, aspect)
    open_ = np.flatnonzero(~rays.reaches)
    rays = bent.Rays(*(part[open_] for part in rays))
    uv, passes = uv[open_], passes[open_]
    closest, place = np.full(len(open_), np.inf, found.heights.dtype), uv.copy()
    for k in range(1, _LOOKS):
        way = rays.start + (rays.stop - rays.start) * np.float32(k / _LOOKS)
        at = uv + way[:, None] * rays.along
        under = bilinear(found.heights[..., None], at, wrap=wrap)[:, 0]
        gap = bent.height_at(rays, way) - under
        nearer = gap < closest
        closest, place = np.where(nearer, gap, closest), np.where(nearer[:, None], at, place)
    wrong = np.flatnonzero(passes == (closest <= 0))
    return _spread(found.heights.shape, place[wrong], closest[wrong], wrap=wrap)


def _spread(size: tuple[int, int], uv: Array, gap: Array, *, wrap: bool) -> Array:
    h, w = size
    at = (uv - np.floor(uv) if wrap else uv) * [w, h] - 0.5
    low = np.floor(at).astype(np.int64)
    fx, fy = (at - low).T
    total, count = np.zeros(size), np.zeros(size)
    shares = [(0, 0, (1 - fx) * (1 - fy)), (0, 1, fx * (1 - fy)), (1, 0, (1 - fx) * fy)]
    shares.append((1, 1, fx * fy))
    square = sum(share**2 for _, _, share in shares)
    for down, right, share in shares:
        row, col = low[:, 1] + down, low[:, 0] + right
        row, col = (row % h, col % w) if wrap else (row.clip(0, h - 1), col.clip(0, w - 1))
        np.add.at(total, (row, col), share * (share * gap / square))
        np.add.at(count, (row, col), share)
    return (_SHARE * total / np.maximum(count, 1e-6)).astype(np.float32)
