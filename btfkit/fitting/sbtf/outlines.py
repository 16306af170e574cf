"""Heights from outlines: rays that are known to pass, or to be stopped, bound them.

A ray that passes says that nothing stands above any place of its way: all such rays together
carve the heights from above, exactly and at once. One that is stopped says that something does,
somewhere.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from btfkit.conventions import MOST_BEND, displacement
from btfkit.native.neural import bent
from btfkit.native.neural.layout import Array
from btfkit.native.neural.lookup import bilinear
from btfkit.program import Heights
from btfkit.queries import QuerySet

# Places a ray is looked at for where it comes closest, or for what it carves; the share of a gap
# that a step closes while colours move heights too, and where nothing else does.
_LOOKS, _CARVED, _SHARE, _LARGE_SHARE = 24, 32, 0.2, 0.5
# Opacity below which no part of a footprint was stopped, so that a bound is one.
_NOTHING = 0.01
# Sweeps over rays that may pass, and rays of each a texel.
_SWEEPS, _SWEPT, _MOST_SWEPT = 20, 5, 1 << 17
# Share of the depth by which heights sink before the first sweep; before later ones ever less. What
# no ray that was stopped holds up would stay as high as rays that passed let it.
_SINKING = 0.012


def carved(
    queries: QuerySet,
    size: tuple[int, int],
    *,
    scale: float,
    aspect: float,
    wrap: bool,
    opacity: Array | None = None,
    seed: int = 0,
) -> Array | None:
    """Heights (h, w), units, that outlines alone tell: carved, then swept.

    None where no ray is known to pass a convex surface.

    Args:
        queries: valid rows with opacity. size: (h, w). scale: tile widths a unit.
        opacity: (h, w) of the material, where it has holes: rays that cross one say nothing.
        seed: of the rays that are swept over.
    """
    assert queries.opacity is not None
    if queries.curvature is None:
        return None
    convex = np.flatnonzero((queries.curvature > 0) & (queries.view[:, 2] > 0))
    if opacity is not None:
        convex = convex[_clear(queries, convex, opacity, scale, aspect, wrap)]
    passing = convex[queries.opacity[convex] < _NOTHING]
    if not len(passing):
        return None
    # The deepest place of a ray, were nothing in its way: a relief that it passes reaches so far,
    # but not to the axis of the sharpest surface that it lay under.
    bend = queries.curvature * np.float32(scale)
    lowest = (1 - np.hypot(*queries.view.T[:2])) / np.where(bend > 0, bend, 1)
    bottom = -min(float(lowest[passing].max()), MOST_BEND / float(bend.max()))
    heights = _ceiling(queries, passing[lowest[passing] <= -bottom], size, scale, aspect, wrap)
    heights = np.clip(heights, bottom, 0)
    band = convex[lowest[convex] <= -bottom]
    rng, count = np.random.default_rng(seed), min(_SWEPT * heights.size, _MOST_SWEPT, len(band))
    # Of a sheet with holes rays say nothing where it is open, and nothing would hold it up.
    sinking = _SINKING * bottom if opacity is None else 0.0
    for k in range(_SWEEPS):
        heights = heights + np.float32(sinking * (1 - k / _SWEEPS))
        rows = rng.choice(band, count, replace=False)
        heights = heights + moved(
            Heights(heights, scale, curved=True), queries.uv[rows], queries.view[rows],
            queries.curvature[rows], queries.opacity[rows] < 0.5, aspect=aspect, wrap=wrap,
            share=_LARGE_SHARE,
        )  # fmt: skip
        heights = np.clip(heights, bottom, 0).astype(np.float32)
    return heights


def _chords(
    queries: QuerySet, rows: NDArray[np.intp], scale: float, aspect: float
) -> tuple[bent.Rays, Array]:
    """Rays of queries on convex surfaces as they go where nothing stops them, and their uv (b, 2).

    Lengths are units of the heights.
    """
    assert queries.curvature is not None
    (x, y, z), bend = queries.view[rows].T, queries.curvature[rows] * np.float32(scale)
    flat = np.maximum(np.hypot(x, y), 1e-6)
    along = np.stack(displacement(-x, -y, flat / scale, aspect), axis=1)
    none, stop = np.zeros_like(z), 2 * np.arctan2(z, flat) / bend
    return bent.Rays(bend, flat, z, along, none, none, stop, none > 0), queries.uv[rows]


def _ceiling(
    queries: QuerySet, rows: NDArray[np.intp], size: tuple[int, int], scale: float, aspect: float,
    wrap: bool,
) -> Array:  # fmt: skip
    """The heights (h, w) under which rays that passed went; where none went, those around."""
    h, w = size
    rays, uv = _chords(queries, rows, scale, aspect)
    found = np.full(h * w, np.inf, np.float32)
    for k in range(1, _CARVED):
        way = rays.start + (rays.stop - rays.start) * np.float32(k / _CARVED)
        # The nearest texel takes the bound: half a texel off in a place that slopes, which sweeps
        # put right, and every ray then bounds some texel.
        at = _texel(uv + way[:, None] * rays.along, size, wrap=wrap)
        np.minimum.at(found, at, bent.height_at(rays, way).astype(np.float32))
    known = np.isfinite(found)
    if not known.all():
        found = _filled(found.reshape(size), known.reshape(size), wrap=wrap).ravel()
    return found.reshape(size)


def _filled(values: Array, known: NDArray[np.bool_], *, wrap: bool) -> Array:
    """Values (h, w), with the mean of those around where they are unknown."""
    mode, found, sure = "wrap" if wrap else "nearest", values, known
    sigma = 1.0
    while not sure.all():
        sums, weight = (
            gaussian_filter(part.astype(float), sigma, mode=mode)
            for part in (np.where(known, values, 0), known)
        )
        reached = ~sure & (weight > 1e-6)
        found = np.where(reached, sums / np.maximum(weight, 1e-9), found)
        sure, sigma = sure | reached, 2 * sigma
    return found.astype(np.float32)


def _clear(
    queries: QuerySet, rows: NDArray[np.intp], opacity: Array, scale: float, aspect: float,
    wrap: bool,
) -> NDArray[np.bool_]:  # fmt: skip
    """(b,) whether the ways of rays cross no hole."""
    rays, uv = _chords(queries, rows, scale, aspect)
    solid, clear = opacity.ravel() >= 0.5, np.ones(len(rows), bool)
    for k in range(_CARVED + 1):
        way = rays.start + (rays.stop - rays.start) * np.float32(k / _CARVED)
        clear &= solid[_texel(uv + way[:, None] * rays.along, opacity.shape, wrap=wrap)]
    return clear


def _texel(uv: Array, size: tuple[int, ...], *, wrap: bool) -> NDArray[np.intp]:
    """(b,) flat index of the texel at uv (b, 2)."""
    h, w = size
    col, row = np.floor(uv * [w, h]).astype(np.intp).T
    return (row % h) * w + col % w if wrap else row.clip(0, h - 1) * w + col.clip(0, w - 1)


def moved(
    found: Heights,
    uv: Array,
    view: Array,
    curvature: Array,
    passes: NDArray[np.bool_],
    *,
    aspect: float,
    wrap: bool,
    share: float = _SHARE,
) -> Array:
    """What is added to heights (h, w), units, so that rays do what they are known to do.

    A ray that should be stopped and is not lifts the heights where it comes closest; one that
    should pass and does not lowers them where it lies deepest. Each gap is closed as far as the
    four texels around allow with the least change (Kaczmarz), by a share; texels that several
    rays move take the mean.

    Args:
        uv: (b, 2). view: (b, 3). curvature: (b,) 1/tile width. passes: (b,) what is known.
        share: of each gap that is closed.
    """
    open_ = np.flatnonzero(~bent.rays_of(found, view, curvature, aspect).reaches)
    rays = bent.rays_of(found, view[open_], curvature[open_], aspect)
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
    spread = _spread(found.heights.shape, place[wrong], closest[wrong], wrap=wrap)
    return np.asarray(share * spread, np.float32)


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
    return np.asarray(total / np.maximum(count, 1e-6), np.float32)
