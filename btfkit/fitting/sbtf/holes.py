"""Holes of a material that is seen through: where they are, and how thick it is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from btfkit import metrics
from btfkit.conventions import displacement
from btfkit.native.neural import bent
from btfkit.native.neural.layout import Array
from btfkit.native.neural.lookup import bilinear
from btfkit.program import Heights
from btfkit.queries import QuerySet

# Views from which the place that is looked at is all but the place that is asked for; rows that
# thicknesses are told apart by, those of views below; how many are tried, and the largest, units.
_STEEP, _FLAT, _ROWS = 0.9, 0.8, 8192
_TRIED, _THICKEST = 12, 4.0
# Share of rays over the plane that pass where a material is seen through.
_FEW = 1e-3
# The largest thickness that is tried where no height is known, tiles, and texels a side where
# queries do not say them.
_THICKEST_TILES, _GRID = 0.3, 64


def seen_through(queries: QuerySet) -> bool:
    """Whether rays pass where no curvature lets them."""
    if queries.opacity is None:
        return False
    flat = queries.opacity if queries.curvature is None else queries.opacity[queries.curvature == 0]
    return bool(len(flat)) and float((flat < 0.5).mean()) > _FEW


def opacity_of(queries: QuerySet, size: tuple[int, int], *, wrap: bool) -> Array:
    """(h, w) share of upright rays that each texel stops.

    Texels that no such ray reaches take what lies around them.

    Args:
        queries: valid rows, with opacity.
    """
    assert queries.opacity is not None
    rows = np.flatnonzero(queries.view[:, 2] > _STEEP)
    if not len(rows):
        rows = np.argsort(-queries.view[:, 2])[: max(len(queries) // 10, 1)]
    h, w = size
    place = queries.uv[rows] - np.floor(queries.uv[rows]) if wrap else queries.uv[rows].clip(0, 1)
    col, row = (np.floor(place * [w, h]).astype(int) % [w, h]).T
    stopped, count = np.zeros(size), np.zeros(size)
    np.add.at(stopped, (row, col), queries.opacity[rows])
    np.add.at(count, (row, col), 1)
    mode = "wrap" if wrap else "nearest"
    around = [gaussian_filter(part, 1.0, mode=mode) for part in (stopped, count)]
    likely = around[0] / np.maximum(around[1], 1e-9)
    return ((stopped + likely) / (count + 1)).astype(np.float32)


def with_holes(surface: Array, opacity: Array, thickness: float) -> Array:
    """Heights (h, w) whose holes reach the underside, and no others do."""
    return np.where(opacity < 0.5, -thickness, np.maximum(surface, -thickness)).astype(np.float32)


def thickness_of(
    surface: Array, opacity: Array, queries: QuerySet, *, scale: float, aspect: float, wrap: bool
) -> float:
    """The thickness, units of the heights, under which most rays do what they are known to do.

    Args:
        surface: (h, w) heights; those in holes do not count. opacity: (h, w).
        queries: valid rows, with opacity. scale: tile widths a unit.
    """
    assert queries.opacity is not None
    solid = surface[opacity >= 0.5]
    depth = max(-float(np.percentile(solid, 1)) if solid.size else 0.0, 1e-3)
    rows = np.flatnonzero(queries.view[:, 2] < _FLAT)
    rows = np.random.default_rng(5).permutation(rows)[:_ROWS]
    bend = np.zeros(len(rows), np.float32)
    if queries.curvature is not None:
        bend = queries.curvature[rows]
    truth = queries.opacity[rows].astype(np.float32)
    best, found = -1.0, depth
    for thickness in np.geomspace(depth, max(_THICKEST, 2 * depth), _TRIED):
        heights = Heights(with_holes(surface, opacity, thickness), scale, True, opacity)
        met = bent.meet(heights, queries.uv[rows], queries.view[rows], bend,
                        aspect=aspect, wrap=wrap)  # fmt: skip
        agree = metrics.iou(met.opacity, truth) + metrics.iou(1 - met.opacity, 1 - truth)
        if agree > best:
            best, found = agree, float(thickness)
    return found


def solid_at(opacity: Array, uv: Array, *, wrap: bool) -> NDArray[np.bool_]:
    """(b,) whether there is no hole at uv (b, 2)."""
    return np.asarray(bilinear(opacity[..., None], uv, wrap=wrap)[:, 0] >= 0.5)


def passed_under(queries: QuerySet) -> float:
    """Share of rays over the plane that pass and leave where an upright ray is stopped.

    What a height field has there reaches down to its underside, so that none does; what crosses
    over something else lets them pass. Of all thicknesses the one with the fewest.

    Args:
        queries: valid rows, with opacity and size.
    """
    assert queries.opacity is not None
    size = queries.size or (_GRID, _GRID)
    rows = np.ones(len(queries), bool) if queries.curvature is None else queries.curvature == 0
    plane = queries.subset(rows)
    assert plane.opacity is not None
    passing = np.flatnonzero((plane.opacity < 0.1) & (plane.view[:, 2] < _FLAT))[:_ROWS]
    if not len(passing) or not (plane.view[:, 2] > _STEEP).any():
        return 0.0
    solid = opacity_of(plane, size, wrap=True) > 0.9
    x, y, z = plane.view[passing].T
    way = np.stack(displacement(-x, -y, z, size[1] / size[0]), axis=1)
    shares = []
    for thickness in np.geomspace(0.5 / size[1], _THICKEST_TILES, 2 * _TRIED):
        end = plane.uv[passing] + thickness * way
        col, row = (np.floor((end - np.floor(end)) * size[::-1]).astype(int) % size[::-1]).T
        shares.append(float(solid[row, col].mean()))
    return min(shares)
