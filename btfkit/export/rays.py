"""Where view rays end, as nodes of ONNX: through heights on the plane, and on curved surfaces."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from numpy.typing import NDArray

from btfkit.conventions import (
    CURVED_FINER,
    LOOKS,
    LOWEST_COSINE,
    MOST_BEND,
    SLACK,
    STEEPEST,
)
from btfkit.export.graph import Graph, Value
from btfkit.native.neural.bent import hole_range
from btfkit.program import Heights

# A texture (h, w, k) at places (b, 2).
Lookup = Callable[[NDArray[Any], Value], Value]
# Above every height.
_FAR = 1e30


class Met(NamedTuple):
    """Where rays end, (b, 1) each: as `native.neural.bent.Crossing` has it."""

    depth: Value
    opacity: Value
    turn: Value


def on_plane(
    graph: Graph, found: Heights, lookup: Lookup, uv: Value, view: Value, aspect: float
) -> Value:
    """Ray depth (b, 1); as `native.neural.plain.crossing`."""
    raised = view[2:3].at_least(STEEPEST)
    along = view[0:2] / raised * found.scale * graph.array([[1, -aspect]])
    top, bottom = float(found.heights.max()), float(found.heights.min())
    surface = found.heights[..., None]

    def above(t: Value) -> Value:
        return t - lookup(surface, uv + t * along)

    texels = _texels(graph, along, found) * (top - bottom)
    count = texels.of("Ceil").between(1.0, float(LOOKS))
    none = view[2:3] * 0.0
    met, _ = _march(none + top, none + (bottom - top), count, above, LOOKS)
    return met * (view[2:3].at_least(LOWEST_COSINE) / raised * found.scale)


def on_curved(
    graph: Graph,
    found: Heights,
    lookup: Lookup,
    uv: Value,
    view: Value,
    curvature: Value,
    aspect: float,
) -> Met:
    """As `native.neural.bent.meet`.

    Args:
        uv: (b, 2). view: (b, 3). curvature: (b, 1) 1/tile width.
    """
    top, bottom = max(float(found.heights.max()), 0.0), min(float(found.heights.min()), 0.0)
    scale, holes, surface = float(found.scale), found.opacity, found.heights[..., None]
    bend = (curvature * scale).between(-MOST_BEND / max(top, 1e-6), MOST_BEND / max(-bottom, 1e-6))
    bend = (bend.of("Abs") < 1e-9).where(0.0, bend)
    z = view[2:3]
    flat = (view[0:2] * view[0:2]).total().of("Sqrt").at_least(1e-6)
    lift = bend * bottom
    reaches = (z * z + lift * (lift + 2.0) < 0.0).of("Not")
    cosine = reaches.where(z.at_least(STEEPEST), z)
    length = (flat * flat + cosine * cosine).of("Sqrt")
    sine, cosine = flat / length, cosine / length
    start = _way_to(top, bend, sine, cosine)
    leaves = cosine.at_most(1.0).of("Asin") * 2.0 / reaches.where(1.0, bend) - start
    reach = reaches.where(_way_to(bottom, bend, sine, cosine), leaves) - start
    along = view[0:2] / flat * graph.array([[-scale, scale * aspect]])

    def above(way: Value) -> Value:
        at = uv + way * along
        gap = _height_at(bend, sine, cosine, way) - lookup(surface, at)
        if holes is None:
            return gap
        span = hole_range(found)
        solid = lookup(holes[..., None], at)
        return (gap - SLACK * span).at_least((solid * -1.0 + 0.5) * span)

    texels, most = reach * _texels(graph, along, found), max(found.looks, LOOKS)
    if holes is None:
        texels = reaches.where(texels, texels * CURVED_FINER)
        limit: Any = reaches.where(float(LOOKS), float(found.looks))
    else:
        texels, limit = texels * CURVED_FINER, float(found.looks)
    count = texels.of("Ceil").at_least(1.0).at_most(limit)
    again = reaches.of("Not") if holes is None else count > 0.0
    way, under = _march(start, reach, count, above, most, again=again)
    ended = (under > 0.0).of("Not")
    opaque = ended if holes is not None else reaches | ended
    way = opaque.where(way, start + reach)
    depth = way * (z.at_least(LOWEST_COSINE) / flat * -scale)
    return Met(depth, opaque.where(1.0, 0.0), bend * way)


def turned(graph: Graph, way: Value, view: Value, turn: Value) -> Value:
    """Directions (b, 3) in the frame where the turned ray is; as `bent.turned`."""
    flat = (view[0:2] * view[0:2]).total().of("Sqrt").at_least(1e-6)
    back = view[0:2] / flat * -1.0
    sine, cosine, up = turn.of("Sin"), turn.of("Cos"), way[2:3]
    along = (way[0:2] * back).total()
    shift = along * (cosine - 1.0) - up * sine
    return graph.joined([way[0:2] + shift * back, along * sine + up * cosine])


def _march(
    start: Value,
    reach: Value,
    count: Value,
    above: Callable[[Value], Value],
    most: int,
    *,
    again: Value | None = None,
) -> tuple[Value, Value]:
    """Where rays first are under what they are above at the start, and the gap at the last look.

    Args:
        again: rays that may pass, which then end after `count` looks: three more are taken around
            the one that is the least above the surface. None where all are stopped.
    """
    low = high = near = start
    least = start * 0.0 + _FAR
    gap = under = above(low)
    going: Value | None = None
    for k in range(1, most + 1):
        to = start + reach * ((start * 0.0 + float(k)) / count).at_most(1.0)
        found = above(to)
        if going is None:
            low, under = to, found
            going = found > 0.0
        else:
            high, gap = going.where(low, high), going.where(under, gap)
            low, under = going.where(to, low), going.where(found, under)
            going = going & (found > 0.0)
        if again is not None:
            going = going & (count > float(k))
            nearer = going & (found < least)
            near, least = nearer.where(to, near), nearer.where(found, least)
    if again is not None:
        passes = again & (under > 0.0) & (least < _FAR)
        half = reach / count * 0.5
        before, after = above(near - half), above(near + half)
        ahead = after < before
        side = near + ahead.where(half, half * -1.0) * 0.5
        beside = above(side)
        # The last counts: what is nearest to the viewer.
        for at, there, since, was in (
            (near + half, after, near, least),
            (side, beside, ahead.where(near, near - half), ahead.where(least, before)),
            (near - half, before, near - half * 2.0, least),
        ):
            hit = passes & (there > 0.0).of("Not")
            low, under = hit.where(at, low), hit.where(there, under)
            high, gap = hit.where(since, high), hit.where(was, gap)
    first = _met(high, low, gap, under)
    rest = above(first)
    short = rest > 0.0
    high, gap = short.where(first, high), short.where(rest, gap)
    end, last = short.where(low, first), short.where(under, rest)
    return _met(high, end, gap, last), under


def _met(high: Value, low: Value, gap: Value, under: Value) -> Value:
    return high + (low - high) * (gap / (gap - under).at_least(1e-12)).between(0.0, 1.0)


def _texels(graph: Graph, along: Value, found: Heights) -> Value:
    h, w = found.heights.shape
    return (along.of("Abs") * graph.array([[w, h]])).most()


def _height_at(bend: Value, sine: Value, cosine: Value, way: Value) -> Value:
    half = bend * way * 0.5
    s, c = half.of("Sin"), half.of("Cos")
    small = half.of("Abs") < 1e-4
    sinc = small.where(1.0, s / small.where(1.0, half))
    end = sine * (c * c - s * s) + cosine * s * c * 2.0
    return way * sinc * (sine * s - cosine * c) / end.at_least(1e-9)


def _way_to(height: float, bend: Value, sine: Value, cosine: Value) -> Value:
    lift = bend * height
    square = cosine * cosine + lift * (lift + 2.0)
    root = square.at_least(0.0).of("Sqrt")
    straight = (lift + 2.0) * sine * -height / ((lift + 1.0) * (cosine + root).at_least(1e-9))
    short = square < 0.0
    straight = short.where(cosine / short.where(bend, 1.0), straight)
    turn = (bend * straight).between(-1.0, 1.0)
    small = turn.of("Abs") < 1e-4
    return straight * small.where(1.0, turn.of("Asin") / small.where(1.0, turn))
