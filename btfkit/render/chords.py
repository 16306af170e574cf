"""Rays through a body whose curvature changes: what a march along one circle is told of them.

A material takes one curvature, and uv without stretch. The way of a ray through the body, from
where it enters to where it leaves, has a length in uv, a direction there and a depth in its middle:
the circle that has all three is asked for instead of the one that fits the surface at the entry.
How far the way is beside that circle, and how much deeper or less deep, at three places of it is
told with it. The frame turns along with the view, so that light keeps its angle to it.
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
# Shares of the way, by the circle between both ends, where it is looked at; between them, in what
# uv says, at least so much.
_PLACES, _APART = np.array([0.25, 0.5, 0.75]), 0.08
# A way is nowhere less deep than this share of its circle, nor deeper than by its inverse.
_SHALLOWEST = 0.2


class Chord(NamedTuple):
    """What some of m rays are asked with.

    Attributes:
        rows: (k,) which they are.
        view: (k, 3) in the frame of the entry. curvature: (k,) 1/tile width.
        drift: (k, 4) off that circle, as `Material.evaluate` takes it; 0 where places of the way
            say nothing of it, as at seams of uv.
    """

    rows: Floats
    view: Floats
    curvature: Floats
    drift: Floats


class Way(NamedTuple):
    """Three places of m ways in uv.

    Attributes:
        share: (3, m) of the way from end to end. side: (3, m) tile widths beside the straight one,
            from u to v. depth: (3, m) tile widths under the surface.
    """

    share: Floats
    side: Floats
    depth: Floats


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
    normals = surface.normal[rows], end.normal
    length = np.linalg.norm(normals[0] + normals[1], axis=1)
    at = _places(np.einsum("ij,ij->i", *normals))
    point = origin + (at * met.distance)[..., None] * direction
    up = (1 - at)[..., None] * normals[0] + at[..., None] * normals[1]
    up /= np.maximum(np.linalg.norm(up, axis=2, keepdims=True), 1e-9)
    foot = shape.foot(point.reshape(-1, 3), up.reshape(-1, 3))
    below = foot.depth.reshape(3, -1)
    moved = end.uv - surface.uv[rows]
    # Along the arc with the chord's length and its middle's depth; a ray that is nearly straight
    # down crosses the body, and its way over the surface is far longer.
    arc = 2 * np.arctan(2 * below[1] / met.distance)
    stretched = met.distance * arc / np.sin(arc)
    flattened = np.maximum(np.hypot(view[rows, 0], view[rows, 1]), 1e-9)
    expected = step[rows] * (stretched / flattened)[:, None]
    # Whole tiles are the same place.
    moved = moved - np.round(moved - expected)
    far = np.abs(moved - expected).max(axis=1)
    flat = moved / [1, aspect]
    length_uv = np.linalg.norm(flat, axis=1)
    passed = foot.uv.reshape(3, -1, 2) - surface.uv[rows]
    passed -= np.round(passed - _PLACES[:, None, None] * moved)
    along = flat / np.maximum(length_uv, 1e-9)[:, None]
    way = _way(passed / [1, aspect], along, length_uv, below / shape.tile)
    depth, drift = _drift(way, length_uv)
    turn = half_turn(depth / np.maximum(length_uv, 1e-9))
    good = out & (length > 1e-3) & (depth < _DEEPEST * thickness) & (far < _FARTHEST)
    good &= length_uv > _SHORTEST * met.distance / shape.tile
    good &= 2 * turn * thickness < MOST_BEND * length_uv
    rows, along, turn, length_uv = rows[good], along[good], turn[good], length_uv[good]
    side = np.cos(turn)
    seen = np.stack([-along[:, 0] * side, along[:, 1] * side, np.sin(turn)], axis=1)
    return Chord(rows, seen, 2 * turn / length_uv, drift[good])


def half_turn(ratio: Floats) -> Floats:
    """Half the angle (m,) of arcs, by their greatest depth under the chord over their length."""
    turn = 4 * ratio
    for _ in range(12):
        square = np.minimum(turn, _MOST_TURN) ** 2
        # (1 - cos t) / 2 t by its series.
        series = 1 - square / 12 * (1 - square / 30 * (1 - square / 56))
        turn = 4 * ratio / series
    return np.clip(turn, 1e-6, _MOST_TURN)


def _places(cosine: Floats) -> Floats:
    """Shares (3, m) of chords by the cosine between the normals of their ends."""
    half = np.clip(np.arccos(np.clip(cosine, -1, 1)) / 2, 1e-3, _MOST_TURN)
    return np.asarray((1 + np.tan((2 * _PLACES[:, None] - 1) * half) / np.tan(half)) / 2)


def _way(flat: Floats, along: Floats, length: Floats, depth: Floats) -> Way:
    """Places (3, m, 2) in uv, tile widths, seen along the straight way to the end."""
    share = (flat * along).sum(axis=2) / np.maximum(length, 1e-9)
    side = along[:, 0] * flat[..., 1] - along[:, 1] * flat[..., 0]
    return Way(share, side, depth)


def _drift(way: Way, length: Floats) -> tuple[Floats, Floats]:
    """Depth (m,) in the middle of ways of a length (m,), and how they drift (m, 4) off its circle.

    Where places are out of order, or of no depth, nothing drifts.
    """
    apart = np.diff(way.share, axis=0, prepend=0, append=1).min(axis=0)
    good = (apart > _APART) & (way.depth > 0).all(axis=0) & np.isfinite(way.depth).all(axis=0)
    good &= (np.abs(way.side) < _FARTHEST).all(axis=0)
    x = np.where(good, way.share, _PLACES[:, None])
    deep = np.where(good, way.depth, 1.0)
    room = x * (1 - x)
    # Twice: the depth in the middle is that of its circle, by which the others are judged.
    middle = _in_the_middle(x, deep / room) / 4
    for _ in range(2):
        turn = half_turn(middle / np.maximum(length, 1e-9))
        ratio = deep / _circle(x, turn, length)
        middle = middle * _in_the_middle(x, ratio)
    turn = half_turn(middle / np.maximum(length, 1e-9))
    ratio = deep[[0, 2]] / _circle(x[[0, 2]], turn, length)
    slope = (ratio - 1) / (x[[0, 2]] - 0.5)
    skew1 = (slope[1] - slope[0]) / (x[2] - x[0])
    skew0 = slope[0] - skew1 * x[0]
    # The line through side / room that is best by least squares.
    beside = np.where(good, way.side, 0) / room
    mean, off = beside.mean(axis=0), x - x.mean(axis=0)
    side1 = (off * (beside - mean)).sum(axis=0) / np.square(off).sum(axis=0)
    side0 = mean - side1 * x.mean(axis=0)
    ends = np.stack([1 - skew0 / 2, 1 + (skew0 + skew1) / 2])
    good &= (ends > _SHALLOWEST).all(axis=0) & (ends < 1 / _SHALLOWEST).all(axis=0)
    drift = np.stack([side0, side1, skew0, skew1], axis=1)
    return np.where(good, middle, way.depth[1]), np.where(good[:, None], drift, 0)


def _circle(share: Floats, turn: Floats, length: Floats) -> Floats:
    """Depth of arcs of a half turn (m,) and a length (m,) at shares (..., m) of them."""
    depth = (1 - np.cos(turn) / np.cos((2 * share - 1) * turn)) * length / (2 * turn)
    return np.asarray(np.maximum(depth, 1e-12))


def _in_the_middle(x: Floats, value: Floats) -> Floats:
    """What the parabola through three values (3, m) at x (3, m) has at 1/2."""
    total = np.zeros(x.shape[1])
    for k in range(3):
        a, b = x[k - 2], x[k - 1]
        total += value[k] * (0.5 - a) * (0.5 - b) / ((x[k] - a) * (x[k] - b))
    return total
