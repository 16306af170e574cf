"""A tree of boxes over triangles, built and walked level by level in whole arrays.

The plain twin of `embree.Embree`.
"""

from __future__ import annotations

from typing import NamedTuple, final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]
Ints = NDArray[np.intp]
_LEAF = 4
# Barycentric slack, so that no ray slips between two triangles that share an edge.
_SLACK = 1e-10
# Pairs of ray and box held at once; components of directions below this are this.
_MOST_PAIRS, _TINY = 1 << 20, 1e-300


@final
class Bvh:
    """A complete binary tree: each level halves its triangles at the median of the longest side.

    Every number of boxes and triangles is an array of its own, as all rays need it at once.

    Args:
        corner: (f, 3, 3) triangles that have an area.
    """

    def __init__(self, corner: Floats) -> None:
        leaves = 1 << max(int(np.ceil(np.log2(len(corner) / _LEAF))), 0)
        # Filled up by repeating triangles, so that every level is one array.
        order = np.arange(leaves * _LEAF) * len(corner) // (leaves * _LEAF)
        centre = corner.mean(axis=1)
        for level in range(leaves.bit_length() - 1):
            boxes = centre[order].reshape(1 << level, -1, 3)
            axis = np.ptp(boxes, axis=1).argmax(axis=1)
            along = np.take_along_axis(boxes, axis[:, None, None], axis=2)[..., 0]
            inside = np.argsort(along, axis=1, kind="stable")
            order = np.take_along_axis(order.reshape(1 << level, -1), inside, axis=1).ravel()
        self._order = order.reshape(leaves, _LEAF)
        self._planes = _planes(corner)
        at = corner[self._order].reshape(leaves, -1, 3)
        # Flat boxes get a thickness: a ray within one would meet it in no more than a rounding.
        bounds = np.concatenate([at.min(axis=1).T - _SLACK, at.max(axis=1).T + _SLACK])
        self._levels = [bounds]
        while bounds.shape[1] > 1:
            pairs = bounds.reshape(6, -1, 2)
            bounds = np.concatenate([pairs[:3].min(axis=2), pairs[3:].max(axis=2)])
            self._levels.insert(0, bounds)

    def meet(self, origin: Floats, direction: Floats, beyond: Floats) -> tuple[Floats, Ints]:
        """Distance (m,) of the first triangle beyond, inf for none, and which it is (m,)."""
        # A direction within a plane of walls crosses them very far away, not never: 0 x inf is NaN.
        safe = np.where(np.abs(direction) < _TINY, _TINY, direction)
        rays = _Rays(
            np.ascontiguousarray(origin.T),
            np.ascontiguousarray(direction.T),
            np.ascontiguousarray(1 / safe.T),
            beyond,
            np.full(len(origin), np.inf),
            np.zeros(len(origin), np.intp),
        )
        everyone = np.arange(len(origin))
        work = [(0, everyone, np.zeros(len(everyone), np.intp))]
        while work:
            level, ray, box = work.pop()
            if len(ray) > _MOST_PAIRS:
                half = len(ray) // 2
                work += [(level, ray[half:], box[half:]), (level, ray[:half], box[:half])]
                continue
            keep = np.flatnonzero(_crossed(self._levels[level], box, rays, ray))
            ray, box = ray[keep], box[keep]
            if level + 1 == len(self._levels):
                self._try(ray, box, rays)
            elif len(ray):
                children = np.concatenate([2 * box, 2 * box + 1])
                work.append((level + 1, np.concatenate([ray, ray]), children))
        return rays.distance, rays.triangle

    def blocks(self, origin: Floats, direction: Floats, beyond: Floats) -> NDArray[np.bool_]:
        """Whether each ray meets a triangle beyond."""
        return np.isfinite(self.meet(origin, direction, beyond)[0])

    def _try(self, ray: Ints, leaf: Ints, rays: _Rays) -> None:
        """Note the triangles of leaves that are met before what was met so far."""
        for member in range(_LEAF):
            face = self._order[leaf, member]
            at = _crossing(self._planes, face, rays, ray)
            hit = np.flatnonzero((at > rays.beyond[ray]) & (at < rays.distance[ray]))
            # The nearest is written last; of equals, that of the lowest number.
            last = hit[np.lexsort((-face[hit], -at[hit]))]
            rays.distance[ray[last]], rays.triangle[ray[last]] = at[last], face[last]


class _Rays(NamedTuple):
    """Rays by coordinate (3, m), and what they met so far (m,)."""

    origin: Floats
    direction: Floats
    inverse: Floats
    beyond: Floats
    distance: Floats
    triangle: Ints


def _crossed(bounds: Floats, box: Ints, rays: _Rays, ray: Ints) -> NDArray[np.bool_]:
    """(p,) whether rays cross boxes where they still look. Source: Kay and Kajiya, 1986."""
    enter, leave = rays.beyond[ray], rays.distance[ray]
    for axis in range(3):
        start, inverse = rays.origin[axis][ray], rays.inverse[axis][ray]
        one = (bounds[axis][box] - start) * inverse
        other = (bounds[3 + axis][box] - start) * inverse
        enter = np.maximum(enter, np.minimum(one, other))
        leave = np.minimum(leave, np.maximum(one, other))
    return enter <= leave


def _planes(corner: Floats) -> Floats:
    """(12, f) maps that take each triangle to (0,0,0), (1,0,0), (0,1,0).

    Source: Baldwin and Weber, "Fast Ray-Triangle Intersections by Coordinate Transformation", 2016.
    """
    e1, e2 = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    normal = np.cross(e1, e2)
    turn = np.linalg.inv(np.stack([e1, e2, normal], axis=2))
    shift = -np.einsum("fij,fj->fi", turn, corner[:, 0])
    return np.ascontiguousarray(np.concatenate([turn, shift[..., None]], axis=2).reshape(-1, 12).T)


def _crossing(planes: Floats, face: Ints, rays: _Rays, ray: Ints) -> Floats:
    """Distance (p,) at which rays cross triangles, inf where they miss."""
    origin, direction = rays.origin[:, ray], rays.direction[:, ray]

    def mapped(row: int) -> tuple[Floats, Floats]:
        a, b, c, shift = (planes[4 * row + k][face] for k in range(4))
        start = a * origin[0] + b * origin[1] + c * origin[2] + shift
        return start, a * direction[0] + b * direction[1] + c * direction[2]

    height, fall = mapped(2)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = -height / fall
        (u, du), (v, dv) = mapped(0), mapped(1)
        u, v = u + at * du, v + at * dv
        inside = (u >= -_SLACK) & (v >= -_SLACK) & (u + v <= 1 + _SLACK)
    return np.where(inside & np.isfinite(at), at, np.inf)
