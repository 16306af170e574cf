"""View rays through heights on a curved surface: the twin of bent.hpp.

The surface is a cylinder of curvature k along the projected ray, the ray straight. It enters the
surface at angle t from the normal; s is its way over the surface behind the entry, z its height
over the surface. The triangle of axis, entry and a point of the ray has (1 + k z) sin(t + k s) =
sin t, which is

    z sin(t + k s) = -s sinc(k s / 2) cos(t + k s / 2),  sinc x = sin(x) / x

without cancellation for either sign of k, and for k = 0 the plane's z = -s cot t. All lengths are
in units of the heights.

Where the surface is no cylinder, four numbers say how a ray through it drifts off that circle.
With x the share of its way from where it enters to where it would leave, 0 to 1,

    to the side, tile widths:  x (1 - x) (side0 + side1 x)
    height:                    z (1 + (x - 1/2) (skew0 + skew1 x))

to the right of the way where the tile is seen with u to the right and v down: turned from u to v.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from btfkit.conventions import (
    CURVATURE_UNIT,
    CURVED_FINER,
    FLATTEST,
    LEAST_RANGE,
    LOOKS,
    LOWEST_COSINE,
    MOST_BEND,
    SLACK,
    STEEPEST,
    displacement,
)
from btfkit.native.neural.lookup import bilinear
from btfkit.program import Heights

Array = NDArray[Any]
# Sines of view rays begin here: straight down, the way over the surface would be 0 throughout.
_LEAST_SINE = 1e-6
# Bends below this are 0, those of a plane.
_LEAST_BEND = 1e-9
# Depths and heights, units, that a bend is never compared with less than.
_LEAST_DEPTH = 1e-6
# Half of the turn on the way through, radians, at least: at a view along the surface it is 0.
_LEAST_HALF = 1e-6


class Drift(NamedTuple):
    """How b rays drift off their circles, as the head of this file has it.

    Attributes:
        numbers: (b, 4) side0, side1, skew0, skew1; 0 where the surface is not convex.
        across: (b, 2) in uv for a tile width to the side.
        part: (b,) share of the way to where the ray would leave, for a unit of way.
    """

    numbers: Array
    across: Array
    part: Array


class Rays(NamedTuple):
    """b view rays at a curved surface.

    Attributes:
        bend: (b,) curvature times a unit of heights.
        sine, cosine: (b,) of the angle at the entry; of rays that reach the bottom the cosine is
            STEEPEST or more.
        along: (b, 2) in uv for a unit of way over the surface.
        share: (b,) ray depth of a unit of way, as `plain.step` counts it.
        start, stop: (b,) way where the march begins and ends.
        reaches: (b,) whether the ray reaches the bottom: it cannot pass.
        drift: of the rays; None where none drifts.
    """

    bend: Array
    sine: Array
    cosine: Array
    along: Array
    share: Array
    start: Array
    stop: Array
    reaches: Array
    drift: Drift | None = None


class Crossing(NamedTuple):
    """Where b rays first meet the heights.

    Attributes:
        depth: (b,) ray depth, tile widths, as `plain.depths`.
        opacity: (b,) 1 where they do, 0 where they pass; there the depth is that of the end.
        way: (b,) over the surface, units of heights.
        turn: (b,) angle at the axis between the entry and there, radians.
        aside: (b, 2) in uv, beside the way that the depth tells; None where nothing drifts.
    """

    depth: Array
    opacity: Array
    way: Array
    turn: Array
    aside: Array | None


def meet(
    found: Heights,
    uv: Array,
    view: Array,
    curvature: Array,
    *,
    aspect: float,
    wrap: bool,
    drift: Array | None = None,
) -> Crossing:
    """Where view rays first meet heights on a curved surface.

    A ray that reaches the bottom is looked at a texel apart, or at LOOKS places where it is longer;
    one that may leave again, or meet a hole, CURVED_FINER times as often, or at `found.looks`
    places. Where it passes all of them, three more look around the one that it passes closest by:
    half a step to both sides, and a quarter to the closer one. Between two of them the surface is
    taken as straight, twice.

    Args:
        found: the heights. uv: (b, 2). view: (b, 3). curvature: (b,) 1/tile width.
        drift: (b, 4) off the circle, None for none.
    """
    heights = found.heights
    h, w = heights.shape
    rays = rays_of(found, view, curvature, aspect, drift)
    # Where there are holes the ray may pass although it reaches the bottom.
    sure = rays.reaches & (found.opacity is None)

    def above(way: Array) -> Array:
        place = uv + way[:, None] * rays.along
        if rays.drift is not None:
            place = place + aside(rays.drift, way)
        return gap_over(found, place, height_at(rays, way), wrap=wrap)

    def met(high: Array, low: Array, gap: Array, under: Array) -> Array:
        return high + (low - high) * np.clip(gap / np.maximum(gap - under, 1e-12), 0, 1)

    length = rays.stop - rays.start
    texels = length * np.max(np.abs(rays.along) * [w, h], axis=1)
    texels = texels * np.where(sure, 1, CURVED_FINER)
    count = np.clip(np.ceil(texels), 1, np.where(sure, LOOKS, found.looks)).astype(length.dtype)
    low = high = rays.start
    under = gap = above(low)
    going = np.ones(len(uv), bool)
    near, least = rays.start, np.full(len(uv), np.inf, length.dtype)
    for k in range(1, max(found.looks, LOOKS) + 1):
        high, gap = np.where(going, low, high), np.where(going, under, gap)
        to = rays.start + length * np.minimum(k / count, 1).astype(length.dtype)
        rest = above(to)
        low, under = np.where(going, to, low), np.where(going, rest, under)
        going &= (rest > 0) & (k < count)
        nearer = going & (rest < least)
        near, least = np.where(nearer, to, near), np.where(nearer, rest, least)
    passes = ~sure & (under > 0) & np.isfinite(least)
    half = length / count / 2
    before, after = above(near - half), above(near + half)
    side = np.where(after < before, half, -half) / 2
    beside = above(near + side)
    for found_at, gap_at, from_, gap_from in (
        # The last counts: what is nearest to the viewer.
        (near + half, after, near, least),
        (
            near + side, beside, np.where(side > 0, near, near - half),
            np.where(side > 0, least, before),
        ),
        (near - half, before, near - 2 * half, least),
    ):  # fmt: skip
        hit = passes & (gap_at <= 0)
        low, under = np.where(hit, found_at, low), np.where(hit, gap_at, under)
        high, gap = np.where(hit, from_, high), np.where(hit, gap_from, gap)
    opaque = sure | (under <= 0)
    first = met(high, low, gap, under)
    rest = above(first)
    short = rest > 0
    high, gap = np.where(short, first, high), np.where(short, rest, gap)
    low, under = np.where(short, low, first), np.where(short, under, rest)
    way = met(high, low, gap, under)
    way = np.where(opaque, way, rays.stop)
    depth = -way * rays.share * np.asarray(found.scale, way.dtype)
    off = None if rays.drift is None else aside(rays.drift, way)
    return Crossing(depth, opaque.astype(way.dtype), way, rays.bend * way, off)


def gap_over(found: Heights, uv: Array, height: Array, *, wrap: bool) -> Array:
    """How far (b,) heights at uv (b, 2) lie above what there is; in holes there is nothing."""
    gap = height - bilinear(found.heights[..., None], uv, wrap=wrap)[:, 0]
    if found.opacity is None:
        return gap
    rise = gap.dtype.type(hole_range(found))
    hole = gap.dtype.type(0.5) - bilinear(found.opacity[..., None], uv, wrap=wrap)[:, 0]
    return np.maximum(gap - gap.dtype.type(SLACK) * rise, hole * rise)


def hole_range(found: Heights) -> float:
    """Between the surface, or what stands above it, and the underside, units; never 0."""
    reach = max(float(found.heights.max()), 0.0) - min(float(found.heights.min()), 0.0)
    return max(reach, LEAST_RANGE)


def sharpest(found: Heights) -> tuple[float, float]:
    """Curvatures (concave, convex), 1/tile width, beyond which heights would reach the axis."""
    top = max(float(found.heights.max()), 0.0) * found.scale
    bottom = min(float(found.heights.min()), 0.0) * found.scale
    return -MOST_BEND / top if top else -np.inf, MOST_BEND / -bottom if bottom else np.inf


def rays_of(
    found: Heights, view: Array, curvature: Array, aspect: float, drift: Array | None = None
) -> Rays:
    """The rays of some views (b, 3) under curvatures (b,), 1/tile width, and drifts (b, 4)."""
    top, bottom = max(float(found.heights.max()), 0.0), min(float(found.heights.min()), 0.0)
    bend = limited(curvature * found.scale, top, bottom).astype(view.dtype)
    z, square = view[:, 2], view[:, 0] ** 2 + view[:, 1] ** 2
    flat = np.maximum(np.sqrt(square), _LEAST_SINE)
    reaches = z**2 + bend * bottom * (2 + bend * bottom) >= 0
    cosine = np.where(reaches, np.maximum(z, STEEPEST), z)
    length = np.hypot(flat, cosine)
    sine, cosine = flat / length, cosine / length
    start = _way_to(top, bend, sine, cosine)
    half = np.arcsin(np.minimum(cosine, 1))
    leaves = 2 * half / np.where(reaches, 1, bend) - start
    stop = np.where(reaches, _way_to(bottom, bend, sine, cosine), leaves)
    moves = displacement(-view[:, 0], -view[:, 1], flat / found.scale, aspect)
    share = np.maximum(z, LOWEST_COSINE) / flat
    rays = Rays(bend, sine, cosine, np.stack(moves, axis=1), share, start, stop, reaches)
    if drift is None:
        return rays
    numbers = np.where(bend[:, None] > 0, drift, 0).astype(view.dtype)
    across = np.stack(displacement(-view[:, 1], view[:, 0], flat, aspect), axis=1)
    return rays._replace(drift=Drift(numbers, across, bend / (2 * np.maximum(half, _LEAST_HALF))))


def limited(bend: Array, top: float, bottom: float) -> Array:
    """Curvature, per unit of heights, at which no height reaches the axis: MOST_BEND at most."""
    least = -MOST_BEND / max(top, _LEAST_DEPTH)
    most = MOST_BEND / max(-bottom, _LEAST_DEPTH)
    return np.where(np.abs(bend) < _LEAST_BEND, 0, np.clip(bend, least, most))


def height_at(rays: Rays, way: Array) -> Array:
    """Height (b,) of rays where their way over the surface is `way` (b,)."""
    half = rays.bend * way / 2
    sine, cosine = np.sin(half), np.cos(half)
    sinc = np.where(np.abs(half) < 1e-4, 1, sine / np.where(np.abs(half) < 1e-4, 1, half))
    middle = rays.cosine * cosine - rays.sine * sine
    end = rays.sine * (cosine**2 - sine**2) + rays.cosine * 2 * sine * cosine
    height = -way * sinc * middle / np.maximum(end, 1e-9)
    if rays.drift is None:
        return height
    x, skew = way * rays.drift.part, rays.drift.numbers[:, 2:]
    return np.asarray(height * (1 + (x - 0.5) * (skew[:, 0] + skew[:, 1] * x)))


def aside(drift: Drift, way: Array) -> Array:
    """How far (b, 2), uv, rays are beside the straight way there."""
    x, side = way * drift.part, drift.numbers
    return (x * (1 - x) * (side[:, 0] + side[:, 1] * x))[:, None] * drift.across


def falling(rays: Rays, way: Array) -> Array:
    """How fast (b,) rays fall towards the surface there: -dz/ds."""
    angle = np.arctan2(rays.sine, rays.cosine) + rays.bend * way
    height = height_at(rays, way)
    return (1 + rays.bend * height) * np.cos(angle) / np.maximum(np.sin(angle), 1e-9)


def clearance(rays: Rays, way: Array, climb: Array) -> Array:
    """How fast (b,) rays and heights approach; where they graze, no slower than FLATTEST allows.

    A height moves the crossing by -1 / clearance of way.

    Args:
        climb: (b,) slope of the heights along the way.
    """
    fall = falling(rays, way)
    return np.maximum(fall + climb, FLATTEST * np.maximum(fall, STEEPEST))


def turned(direction: Array, view: Array, turn: Array) -> Array:
    """Directions (b, 3) at the entry of views (b, 3), in the frame where the turned ray is."""
    back = -view[:, :2] / np.maximum(np.hypot(view[:, 0], view[:, 1]), _LEAST_SINE)[:, None]
    sine, cosine = np.sin(turn), np.cos(turn)
    along, up = (direction[:, :2] * back).sum(axis=1), direction[:, 2]
    shift = along * (cosine - 1) - up * sine
    flat = direction[:, :2] + shift[:, None] * back
    return np.column_stack([flat, along * sine + up * cosine]).astype(direction.dtype)


def softened(curvature: Array) -> Array:
    """A curvature (b,), 1/tile width, as layers take it: -1 to 1."""
    return curvature / (CURVATURE_UNIT + np.abs(curvature))


def _way_to(height: float, bend: Array, sine: Array, cosine: Array) -> Array:
    """Way (b,) to a height; where a ray does not reach it, to where it is nearest."""
    lift = bend * height
    square = cosine**2 + lift * (2 + lift)
    root = np.sqrt(np.maximum(square, 0))
    straight = -height * (2 + lift) * sine / ((1 + lift) * np.maximum(cosine + root, 1e-9))
    # The sine of the angle from the entry to where the ray is nearest is the cosine at the entry.
    straight = np.where(square < 0, cosine / np.where(square < 0, bend, 1), straight)
    turn = np.clip(bend * straight, -1, 1)
    small = np.abs(turn) < 1e-4
    return straight * np.where(small, 1, np.arcsin(turn) / np.where(small, 1, turn))
