"""Polygons of meshes as triangles, concave ones too."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]
Vector = Sequence[float]


def cut(points: Sequence[Vector]) -> list[tuple[int, int, int]]:
    """Corners of the triangles of a polygon (n, 3): a fan where that covers it."""
    n = len(points)
    order = [(0, i, i + 1) for i in range(1, n - 1)]
    if n > 3 and not (n == 4 and _is_folded_out(*points)):
        flat = _flattened(np.asarray(points, float))
        order = order if _is_convex(flat) else _triangulated(flat) or order
    return order


def _is_folded_out(a: Vector, b: Vector, c: Vector, d: Vector) -> bool:
    """Whether the triangles a b c and a c d face the same side; in plain Python, for many quads."""
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    wx, wy, wz = d[0] - a[0], d[1] - a[1], d[2] - a[2]
    first = (uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx)
    second = (vy * wz - vz * wy, vz * wx - vx * wz, vx * wy - vy * wx)
    return first[0] * second[0] + first[1] * second[1] + first[2] * second[2] > 0


def _flattened(points: Floats) -> Floats:
    """(n, 2) corners of a polygon (n, 3) as seen against its normal: counter-clockwise.

    Source of the normal: Newell's method.
    """
    following = np.roll(points, -1, axis=0)
    normal = np.cross(points - points[0], following - points[0]).sum(axis=0)
    axis = int(np.abs(normal).argmax())
    first, second = np.delete(np.arange(3), axis)
    # Leaving y out turns the other two around.
    mirrored = (normal[axis] < 0) != (axis == 1)
    return points[:, [second, first]] if mirrored else points[:, [first, second]]


def _is_convex(flat: Floats) -> bool:
    """Whether a fan from the first corner covers a polygon (n, 2): it turns left throughout."""
    edge = np.roll(flat, -1, axis=0) - flat
    turn = edge[:, 0] * np.roll(edge[:, 1], -1) - edge[:, 1] * np.roll(edge[:, 0], -1)
    return bool((turn >= -1e-12 * np.abs(edge).max() ** 2).all())


def _triangulated(flat: Floats) -> list[tuple[int, int, int]]:
    """Corners of the triangles of a polygon (n, 2), turning left; empty where it has no inside."""
    import mapbox_earcut

    found = mapbox_earcut.triangulate_float64(
        np.ascontiguousarray(flat, np.float64), np.array([len(flat)], np.uint32)
    ).reshape(-1, 3)
    triangles = []
    for a, b, c in found.tolist():
        (x0, y0), (x1, y1) = flat[b] - flat[a], flat[c] - flat[a]
        triangles.append((a, b, c) if x0 * y1 >= y0 * x1 else (a, c, b))
    return triangles
