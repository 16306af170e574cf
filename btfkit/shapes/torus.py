"""The torus in closed form: the one analytic shape that shadows itself from outside."""

from __future__ import annotations

from typing import ClassVar, final

import numpy as np

from btfkit.shapes.closed import Floats, Foot, Meeting, Shape, Surface, exact, met_once, nearest

# Halvings alone bring any bracket of length 2 below what counts as resolved in that many steps.
_STEPS, _RESOLVED = 48, 1e-14


@final
class Torus(Shape):
    """A ring that faces the viewer; 4 `repeat` tiles around it, upright at its top.

    Tiles keep their proportions on the central circle where 2 `repeat` `aspect` is a whole number;
    else the nearest whole number of tiles goes around the tube.

    Args:
        repeat: a quarter of the tiles around the ring. aspect: tile width / tile height.
        tube: radius of the tube; that of the ring's central circle is 1 - tube.
        tiles: (around the ring, around the tube) in place of `repeat` and `aspect`.
    """

    convex: ClassVar[bool] = False

    def __init__(
        self,
        *,
        repeat: int = 1,
        aspect: float = 1.0,
        tube: float = 1 / 3,
        tiles: tuple[int, int] | None = None,
    ) -> None:
        self.half_height = 1.04
        self._ring, self._tube = 1 - tube, tube
        across = max(round(4 * repeat * aspect * tube / self._ring), 1)
        self._around, self._across = tiles or (4 * repeat, across)
        self.tile = 2 * np.pi * self._ring / self._around

    def meet(self, origin: Floats, direction: Floats, beyond: Floats) -> Meeting:
        # From the point of the ray that is nearest to the centre, the quartic has no cubic term.
        middle = -np.einsum("ij,ij->i", origin, direction)
        at = origin + middle[:, None] * direction
        square = np.einsum("ij,ij->i", at, at)
        near = np.flatnonzero(square < 1)
        distance = np.full(len(origin), np.inf)
        if near.size:
            a, d, reach = at[near], direction[near], np.sqrt(1 - square[near])
            k = square[near] + self._ring**2 - self._tube**2
            p = 2 * k - 4 * self._ring**2 * (d[:, 0] ** 2 + d[:, 1] ** 2)
            q = -8 * self._ring**2 * (a[:, 0] * d[:, 0] + a[:, 1] * d[:, 1])
            c = k**2 - 4 * self._ring**2 * (a[:, 0] ** 2 + a[:, 1] ** 2)
            roots = _quartic(p, q, c, reach) + middle[near, None]
            distance[near] = nearest(roots, beyond[near])
        return met_once(distance)

    def surface(self, origin: Floats, direction: Floats, met: Meeting) -> Surface:
        point = origin + met.distance[:, None] * direction
        x, y, z = point.T
        from_axis = np.hypot(x, y)
        # Clockwise from the top, so that u runs right and v down there.
        ring = np.arctan2(x, y)
        tube = np.arctan2(z, from_axis - self._ring)
        away = point[:, :2] / np.maximum(from_axis, 1e-12)[:, None]
        flat = np.zeros(len(point))
        east = np.stack([away[:, 1], -away[:, 0], flat], axis=1)
        cos, sin = np.cos(tube), np.sin(tube)
        normal = np.stack([cos * away[:, 0], cos * away[:, 1], sin], axis=1)
        south = np.stack([-sin * away[:, 0], -sin * away[:, 1], cos], axis=1)
        u, v = ring / (2 * np.pi) * self._around, (tube / (2 * np.pi) - 0.25) * self._across
        du = east * (2 * np.pi * from_axis / self._around)[:, None]
        dv = south * (2 * np.pi * self._tube / self._across)
        bend = np.stack([cos / from_axis, flat, flat + 1 / self._tube], axis=1)
        return exact(point, normal, np.stack([u, v], axis=1) + 0.5, du, dv, bend)

    def foot(self, point: Floats, up: Floats) -> Foot:
        from_axis = np.hypot(point[:, 0], point[:, 1])
        depth = self._tube - np.hypot(from_axis - self._ring, point[:, 2])
        return Foot(self.surface(point, up, met_once(np.zeros(len(point)))).uv, depth)


def _quartic(p: Floats, q: Floats, c: Floats, reach: Floats) -> Floats:
    """(m, 4) roots of t⁴ + p t² + q t + c within ±reach; inf where there is none.

    Between its extremes, which a cubic gives in closed form, the quartic is monotone: each
    stretch holds one root at most. Newton's steps find it; one that leaves the bracket is replaced
    by halving, so that it is found however close the roots lie.
    """
    extremes = np.clip(_cubic(p / 2, q / 4), -reach[:, None], reach[:, None])
    bounds = np.concatenate([-reach[:, None], extremes, reach[:, None]], axis=1)

    signs = _value(bounds, p[:, None], q[:, None], c[:, None]) > 0
    row, stretch = np.nonzero(signs[:, 1:] != signs[:, :-1])
    low, high, rising = bounds[row, stretch], bounds[row, stretch + 1], signs[row, stretch + 1]
    p, q, c, t = p[row], q[row], c[row], (low + high) / 2
    for _ in range(_STEPS):
        value = _value(t, p, q, c)
        above = (value > 0) == rising
        low, high = np.where(above, low, t), np.where(above, t, high)
        slope = (4 * t * t + 2 * p) * t + q
        step = t - value / np.where(slope == 0, 1e-300, slope)
        following = np.where((step > low) & (step < high), step, (low + high) / 2)
        if np.abs(following - t).max(initial=0) < _RESOLVED:
            break
        t = following
    roots = np.full((len(signs), 4), np.inf)
    roots[row, stretch] = t
    return roots


def _value(t: Floats, p: Floats, q: Floats, c: Floats) -> Floats:
    return ((t * t + p) * t + q) * t + c


def _cubic(p: Floats, q: Floats) -> Floats:
    """(m, 3) real roots of t³ + p t + q in ascending order; a single one three times.

    Source: the trigonometric (Viète) and Cardano's form of the depressed cubic.
    """
    inner = (q / 2) ** 2 + (p / 3) ** 3
    root = np.sqrt(np.maximum(inner, 0))
    # The larger cube root first: the other follows from their product, without cancellation.
    first = np.cbrt(-np.where(q > 0, 1.0, -1.0) * (np.abs(q) / 2 + root))
    single = first - p / 3 / np.where(first == 0, 1.0, first)
    scale = 2 * np.sqrt(np.maximum(-p / 3, 0))
    cubed = np.where(scale == 0, 1.0, scale) ** 3
    angle = np.arccos(np.clip(-4 * q / cubed, -1, 1)) / 3
    three = scale[:, None] * np.cos(angle[:, None] - 2 * np.pi / 3 * np.arange(3))
    return np.sort(np.where((inner > 0)[:, None], single[:, None], three), axis=1)
