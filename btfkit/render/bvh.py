"""A tree of boxes over triangles, built and walked level by level in whole arrays."""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]
Ints = NDArray[np.intp]
_LEAF = 4
# Barycentric slack, so that no ray slips between two triangles that share an edge.
_SLACK = 1e-10
# Pairs of ray and box held at once.
_MOST_PAIRS = 1 << 22


@final
class Bvh:
    """A complete binary tree: each level halves its triangles at the median of the longest side.

    Args:
        corner: (f, 3, 3) triangles.
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
        self._first = corner[:, 0]
        self._edges = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
        at = corner[self._order].reshape(leaves, -1, 3)
        self._levels = [(at.min(axis=1), at.max(axis=1))]
        while len(self._levels[0][0]) > 1:
            low, high = self._levels[0]
            pair = (low.reshape(-1, 2, 3).min(axis=1), high.reshape(-1, 2, 3).max(axis=1))
            self._levels.insert(0, pair)

    def meet(self, origin: Floats, direction: Floats, beyond: Floats) -> tuple[Floats, Ints]:
        """Distance (m,) of the first triangle beyond, inf for none, and which it is (m,)."""
        distance, triangle = np.full(len(origin), np.inf), np.zeros(len(origin), np.intp)
        with np.errstate(divide="ignore"):
            inverse = 1 / direction
        rays = np.arange(len(origin))
        work = [(0, rays, np.zeros(len(rays), np.intp))]
        while work:
            level, ray, box = work.pop()
            if len(ray) > _MOST_PAIRS:
                half = len(ray) // 2
                work += [(level, ray[half:], box[half:]), (level, ray[:half], box[:half])]
                continue
            low, high = self._levels[level]
            keep = _crossed(
                low[box], high[box], origin[ray], inverse[ray], beyond[ray], distance[ray]
            )
            ray, box = ray[keep], box[keep]
            if level + 1 < len(self._levels):
                if len(ray):
                    work.append(
                        (level + 1, np.tile(ray, 2), np.concatenate([2 * box, 2 * box + 1]))
                    )
            else:
                self._leaves(ray, box, origin, direction, beyond, distance, triangle)
        return distance, triangle

    def _leaves(
        self,
        ray: Ints,
        box: Ints,
        origin: Floats,
        direction: Floats,
        beyond: Floats,
        distance: Floats,
        triangle: Ints,
    ) -> None:
        """Lower `distance` and set `triangle` where a triangle of a leaf is met earlier."""
        ray = np.repeat(ray, _LEAF)
        face = self._order[box].ravel()
        at = _crossing(
            origin[ray], direction[ray], self._first[face], *(e[face] for e in self._edges)
        )
        hit = np.flatnonzero((at > beyond[ray]) & (at < distance[ray]))
        ray, face, at = ray[hit], face[hit], at[hit]
        order = np.lexsort((face, at, ray))
        ray, face, at = ray[order], face[order], at[order]
        first = np.ones(len(ray), bool)
        first[1:] = ray[1:] != ray[:-1]
        distance[ray[first]], triangle[ray[first]] = at[first], face[first]


def _crossed(
    low: Floats, high: Floats, origin: Floats, inverse: Floats, beyond: Floats, until: Floats
) -> NDArray[np.bool_]:
    """(m,) whether rays cross boxes between two distances. Source: Kay and Kajiya, 1986."""
    with np.errstate(invalid="ignore"):
        one, other = (low - origin) * inverse, (high - origin) * inverse
    # A ray within a wall of the box gives 0 x inf: that axis decides nothing.
    enter = np.fmax.reduce(np.fmin(one, other), axis=1)
    leave = np.fmin.reduce(np.fmax(one, other), axis=1)
    slack = 1e-9 * (1 + np.abs(leave))
    return (enter <= leave + slack) & (leave + slack > beyond) & (enter < until)


def _crossing(origin: Floats, direction: Floats, first: Floats, e1: Floats, e2: Floats) -> Floats:
    """Distance (m,) at which rays cross triangles, inf where they miss.

    Source: Möller and Trumbore, "Fast, Minimum Storage Ray/Triangle Intersection", 1997.
    """
    across = np.cross(direction, e2)
    scale = np.einsum("ij,ij->i", e1, across)
    away = origin - first
    over = np.cross(away, e1)
    with np.errstate(divide="ignore", invalid="ignore"):
        a = np.einsum("ij,ij->i", away, across) / scale
        b = np.einsum("ij,ij->i", direction, over) / scale
        at = np.einsum("ij,ij->i", e2, over) / scale
        inside = (a >= -_SLACK) & (b >= -_SLACK) & (a + b <= 1 + _SLACK)
    return np.where(inside & np.isfinite(at), at, np.inf)
