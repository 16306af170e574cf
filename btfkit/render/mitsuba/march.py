"""View rays through heights, on the plane and on curved surfaces, as `native.neural` has them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from btfkit.conventions import (
    CURVED_FINER,
    LOOKS,
    LOWEST_COSINE,
    MOST_BEND,
    SLACK,
    STEEPEST,
    displacement,
)
from btfkit.native.neural.bent import hole_range
from btfkit.program import Heights

Numbers = list[Any]
Lookup = Callable[[Any, Any, Any], Any]
# As in native.neural.bent.
_LEAST_SINE, _LEAST_BEND, _LEAST_DEPTH = 1e-6, 1e-9, 1e-6
# Above every height.
_FAR = 1e30


class Met(NamedTuple):
    """Where view rays end.

    Attributes:
        depth: tile widths. opacity: 0 where they pass. turn: radians, as `bent.Crossing` has it.
    """

    depth: Any
    opacity: Any
    turn: Any


def on_plane(
    found: Heights, surface: Lookup, uv: Numbers, view: Numbers, aspect: float, active: Any
) -> Any:
    """Ray depth; as `native.neural.plain.crossing`."""
    h, w = found.heights.shape
    top, bottom = float(found.heights.max()), float(found.heights.min())
    low, scale = dr.maximum(view[2], STEEPEST), float(found.scale)
    along = displacement(view[0] / low * scale, view[1] / low * scale, 1, aspect)

    def above(t: Any, looks: Any) -> Any:
        return t - surface(uv[0] + t * along[0], uv[1] + t * along[1], looks)

    texels = dr.maximum(dr.abs(along[0]) * w, dr.abs(along[1]) * h) * (top - bottom)
    count = dr.clip(dr.ceil(texels), 1, LOOKS)
    start = mi.Float(top) + 0 * uv[0]
    met = _march(
        lambda k: start + (bottom - top) * dr.minimum(k / count, 1), above, start, count,
        active=active, most=LOOKS,
    )[0]  # fmt: skip
    return met * dr.maximum(view[2], LOWEST_COSINE) / low * scale


def on_curved(
    found: Heights,
    surface: Lookup,
    holes: Lookup | None,
    uv: Numbers,
    view: Numbers,
    curvature: Any,
    aspect: float,
    active: Any,
) -> Met:
    """As `native.neural.bent.meet`; `holes` looks up the heights' opacity, where they have one."""
    h, w = found.heights.shape
    scale = float(found.scale)
    top = max(float(found.heights.max()), 0.0)
    bottom = min(float(found.heights.min()), 0.0)
    bend = dr.clip(
        curvature * scale,
        -MOST_BEND / max(top, _LEAST_DEPTH), MOST_BEND / max(-bottom, _LEAST_DEPTH),
    )  # fmt: skip
    bend = dr.select(dr.abs(bend) < _LEAST_BEND, 0, bend)
    z = view[2]
    flat = dr.maximum(dr.sqrt(view[0] * view[0] + view[1] * view[1]), _LEAST_SINE)
    reaches = z * z + bend * bottom * (2 + bend * bottom) >= 0
    cosine = dr.select(reaches, dr.maximum(z, STEEPEST), z)
    length = dr.sqrt(flat * flat + cosine * cosine)
    sine, cosine = flat / length, cosine / length
    start = _way_to(top, bend, sine, cosine)
    leaves = 2 * dr.asin(dr.minimum(cosine, 1)) / dr.select(reaches, 1, bend) - start
    stop = dr.select(reaches, _way_to(bottom, bend, sine, cosine), leaves)
    along = displacement(-view[0], -view[1], flat / scale, aspect)
    share = dr.maximum(z, LOWEST_COSINE) / flat

    # Where there are holes the ray may pass although it reaches the bottom.
    sure = reaches if holes is None else mi.Bool(False)

    def above(way: Any, looks: Any) -> Any:
        u, v = uv[0] + way * along[0], uv[1] + way * along[1]
        gap = _height_at(bend, sine, cosine, way) - surface(u, v, looks)
        if holes is None:
            return gap
        rise = hole_range(found)
        return dr.maximum(gap - SLACK * rise, (0.5 - holes(u, v, looks)) * rise)

    reach = stop - start
    texels = reach * dr.maximum(dr.abs(along[0]) * w, dr.abs(along[1]) * h)
    texels = texels * dr.select(sure, mi.Float(1), CURVED_FINER)
    count = dr.clip(dr.ceil(texels), 1, dr.select(sure, mi.Float(LOOKS), found.looks))
    way, under = _march(
        lambda k: start + reach * dr.minimum(k / count, 1), above, start, count,
        active=active, most=max(found.looks, LOOKS), again=~sure,
    )  # fmt: skip
    opaque = sure | (under <= 0)
    way = dr.select(opaque, way, stop)
    return Met(-way * share * scale, dr.select(opaque, mi.Float(1), 0), bend * way)


def turned(way: Numbers, view: Numbers, turn: Any) -> Numbers:
    """A direction at the entry, in the frame where the turned ray is; as `bent.turned`."""
    length = dr.maximum(dr.sqrt(view[0] * view[0] + view[1] * view[1]), _LEAST_SINE)
    back = [-view[0] / length, -view[1] / length]
    sine, cosine = dr.sin(turn), dr.cos(turn)
    along, up = way[0] * back[0] + way[1] * back[1], way[2]
    shift = along * (cosine - 1) - up * sine
    return [way[0] + shift * back[0], way[1] + shift * back[1], along * sine + up * cosine]


def _march(
    place: Callable[[Any], Any],
    above: Callable[[Any, Any], Any],
    start: Any,
    count: Any,
    *,
    active: Any,
    most: int,
    again: Any = None,
) -> tuple[Any, Any]:
    """Where a ray first is under the surface, and how high it is at the last look.

    Args:
        again: rays that may pass, which then end after `count` looks: three more are taken around
            the one that is the least above the surface. None where all are stopped.
    """
    limit = mi.Float(most) if again is None else count

    def look(
        k: Any, low: Any, high: Any, under: Any, gap: Any, near: Any, least: Any, going: Any
    ) -> Any:
        to = place(k)
        rest = above(to, going)
        going = (rest > 0) & (k < limit)
        nearer = going & (rest < least)
        near, least = dr.select(nearer, to, near), dr.select(nearer, rest, least)
        return k + 1, to, low, rest, under, near, least, going

    gap = above(start, active)
    _, low, high, under, gap, near, least, _ = dr.while_loop(
        (mi.Float(1), start, start, gap, gap, start, mi.Float(_FAR), mi.Bool(active)),
        lambda *state: state[-1], look, max_iterations=most, mode="symbolic",
    )  # fmt: skip
    if again is not None:
        passes = active & again & (under > 0) & (least < _FAR)
        half = (place(mi.Float(1)) - start) / 2
        before, after = above(near - half, passes), above(near + half, passes)
        ahead = after < before
        side = near + dr.select(ahead, half, -half) / 2
        beside = above(side, passes)
        # The last counts: what is nearest to the viewer.
        for at, found, since, was in (
            (near + half, after, near, least),
            (side, beside, dr.select(ahead, near, near - half), dr.select(ahead, least, before)),
            (near - half, before, near - 2 * half, least),
        ):
            hit = passes & (found <= 0)
            low, under = dr.select(hit, at, low), dr.select(hit, found, under)
            high, gap = dr.select(hit, since, high), dr.select(hit, was, gap)
    first = _met(high, low, gap, under)
    rest = above(first, active)
    short = rest > 0
    high, gap = dr.select(short, first, high), dr.select(short, rest, gap)
    end, below = dr.select(short, low, first), dr.select(short, under, rest)
    return _met(high, end, gap, below), under


def _met(high: Any, low: Any, gap: Any, under: Any) -> Any:
    return high + (low - high) * dr.clip(gap / dr.maximum(gap - under, 1e-12), 0, 1)


def _height_at(bend: Any, sine: Any, cosine: Any, way: Any) -> Any:
    half = bend * way / 2
    s, c = dr.sin(half), dr.cos(half)
    small = dr.abs(half) < 1e-4
    sinc = dr.select(small, 1, s / dr.select(small, 1, half))
    middle = cosine * c - sine * s
    end = sine * (c * c - s * s) + cosine * 2 * s * c
    return -way * sinc * middle / dr.maximum(end, 1e-9)


def _way_to(height: float, bend: Any, sine: Any, cosine: Any) -> Any:
    lift = bend * height
    square = cosine * cosine + lift * (2 + lift)
    root = dr.sqrt(dr.maximum(square, 0))
    straight = -height * (2 + lift) * sine / ((1 + lift) * dr.maximum(cosine + root, 1e-9))
    straight = dr.select(square < 0, cosine / dr.select(square < 0, bend, 1), straight)
    turn = dr.clip(bend * straight, -1, 1)
    small = dr.abs(turn) < 1e-4
    return straight * dr.select(small, 1, dr.asin(turn) / dr.select(small, 1, turn))
