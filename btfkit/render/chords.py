"""Rays through a body whose curvature changes: what a march along one circle is told of them.

A material takes one curvature, and uv without stretch. The way of a ray through the body, from
where it enters to where it leaves, has a length in uv, a direction there and a greatest depth: the
circle that has all three is asked for instead of the one that fits the surface at the entry. The
frame turns along with the view, so that light keeps its angle to it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from btfkit.conventions import MOST_BEND
from btfkit.shapes.closed import NEAR, Floats, Meeting, Plane, Shape, Surface

# Views steeper than this reach the bottom soon, unless the circle of the entry takes them no deeper
# than so many thicknesses; to rays whose chords go deeper than so many the entry says more.
_STEEPEST, _SHALLOW, _DEEPEST = 0.7, 2.0, 1.5
# Tiles by which uv at the far end may differ from what the entry lets expect; beyond lies a seam.
_FARTHEST = 0.35
# Lengths in uv of their chords, tiles, at least: at a pole uv has no length, and curvature no end.
_SHORTEST = 0.22
# Half of the turn between the ends at most.
_MOST_TURN = 1.5


class Chord(NamedTuple):
    """What some of m rays are asked with.

    Attributes:
        rows: (k,) which they are.
        view: (k, 3) in the frame of the entry. curvature: (k,) 1/tile width.
    """

    rows: Floats
    view: Floats
    curvature: Floats


def chords(
    shape: Shape,
    surface: Surface,
    toward: Floats,
    view: Floats,
    step: Floats,
    curvature: Floats,
    *,
    aspect: float,
    thickness: float,
) -> Chord | None:
    """Chords of rays that graze a shape, where they are short enough to say something.

    Args:
        surface: m points where rays enter from outside.
        toward: (m, 3) unit vectors to the viewer, object frame.
        view: (m, 3) in the frame of the surface.
        step: (m, 2) in uv, tiles, of a unit of length along the ray at the entry.
        curvature: (m,) of the entry along the ray, 1/tile width.
        aspect: tile width / tile height. thickness: of the material, tile widths.
    """
    above = 1 - np.hypot(view[:, 0], view[:, 1])
    passing = (view[:, 2] < _STEEPEST) | (above < _SHALLOW * thickness * curvature)
    rows = np.flatnonzero(passing)
    if isinstance(shape, Plane) or not thickness or not rows.size:
        return None
    origin, direction = surface.point[rows], -toward[rows]
    met = shape.meet(origin, direction, np.full(len(rows), NEAR))
    hit = np.isfinite(met.distance)
    rows, origin, direction = rows[hit], origin[hit], direction[hit]
    met = Meeting(met.distance[hit], met.part[hit])
    if not rows.size:
        return None
    end = shape.surface(origin, direction, met)
    # From within, the far side is met from behind.
    out = np.einsum("ij,ij->i", end.flat, direction) > 0
    middle = origin + direction * (met.distance / 2)[:, None]
    up = surface.normal[rows] + end.normal
    length = np.linalg.norm(up, axis=1)
    up = up / np.maximum(length, 1e-9)[:, None]
    lifted = shape.meet(middle, up, np.zeros(len(rows)))
    depth = lifted.distance / shape.tile
    moved = end.uv - surface.uv[rows]
    # Along the arc with the chord's length and its middle's depth; a ray that is nearly straight
    # down crosses the body, and its way over the surface is far longer.
    arc = 2 * np.arctan(2 * lifted.distance / met.distance)
    stretched = met.distance * arc / np.sin(arc)
    flattened = np.maximum(np.hypot(view[rows, 0], view[rows, 1]), 1e-9)
    expected = step[rows] * (stretched / flattened)[:, None]
    # Whole tiles are the same place.
    moved = moved - np.round(moved - expected)
    far = np.abs(moved - expected).max(axis=1)
    flat = moved / [1, aspect]
    way = np.linalg.norm(flat, axis=1)
    turn = half_turn(depth / np.maximum(way, 1e-9))
    good = out & (length > 1e-3) & (depth < _DEEPEST * thickness) & (far < _FARTHEST)
    good &= (way > _SHORTEST * met.distance / shape.tile) & (2 * turn * thickness < MOST_BEND * way)
    rows, flat, way, turn = rows[good], flat[good], way[good], turn[good]
    side = np.cos(turn) / way
    seen = np.stack([-flat[:, 0] * side, flat[:, 1] * side, np.sin(turn)], axis=1)
    return Chord(rows, seen, 2 * turn / way)


def half_turn(ratio: Floats) -> Floats:
    """Half the angle (m,) of arcs, by their greatest depth under the chord over their length."""
    turn = 4 * ratio
    for _ in range(12):
        square = np.minimum(turn, _MOST_TURN) ** 2
        # (1 - cos t) / 2 t by its series.
        series = 1 - square / 12 * (1 - square / 30 * (1 - square / 56))
        turn = 4 * ratio / series
    return np.clip(turn, 1e-6, _MOST_TURN)
