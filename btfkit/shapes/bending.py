"""How a mesh bends at its vertices: what a material with silhouettes is told on it.

A second fundamental form is a symmetric tensor of the object's space here, with the normal as its
null direction: along a unit tangent x a surface bends by x · form x, in 1/length, positive convex.
As tensors, forms of neighbouring vertices add, whatever becomes of texture coordinates between
them, and what is interpolated between vertices is k(x) for every x.

Source: Rusinkiewicz, "Estimating Curvatures and Their Derivatives on Triangle Meshes", 2004,
section 3, with triangles weighted by area.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from btfkit.directions import rotation

Floats = NDArray[np.floating]
Ints = NDArray[np.integer]
# Corners this near, as a share of the mesh's size, and with normals this near are one vertex.
_SAME_PLACE, _SAME_NORMAL = 1e-6, 1e-4
# Cosine between a triangle and the normal of its vertex below which it says nothing of it.
_OPPOSITE = -0.5


class Principal(NamedTuple):
    """How v vertices bend most and least.

    Attributes:
        most, least: (v,) curvatures, 1/length, positive convex.
        along_most, along_least: (v, 3) unit tangents, at right angles; any such two where the
            surface bends alike in all directions.
    """

    most: Floats
    least: Floats
    along_most: Floats
    along_least: Floats


def vertex_curvature(
    position: Floats, normal: Floats, uv: Floats, faces: Ints
) -> NDArray[np.float32]:
    """Second fundamental form (v, 3) xx, xy, yy at each vertex, times the width of a unit of u.

    x runs along dp/du, y is normal x x, positive is convex. The width is one for the whole mesh,
    its mean by area. Triangles without area, in space or in uv, tell nothing; a vertex of none but
    such is flat.

    Args:
        position, normal: (v, 3), normals of length 1. uv: (v, 2). faces: (f, 3) vertices.
    """
    corner, n, at = position[faces].astype(float), normal[faces].astype(float), uv[faces]
    edges = corner[:, 1:] - corner[:, :1]
    (u1, v1), (u2, v2) = (np.moveaxis(at[:, k].astype(float) - at[:, 0], -1, 0) for k in (1, 2))
    mapped = u1 * v2 - u2 * v1
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / 2
    good = (area > 1e-30) & (np.abs(mapped) > 1e-14)
    if not good.any():
        return np.zeros((len(position), 3), np.float32)
    scale = np.where(good, mapped, 1)[:, None]
    du = (v2[:, None] * edges[:, 0] - v1[:, None] * edges[:, 1]) / scale
    width = float(np.average(np.linalg.norm(du[good], axis=1), weights=area[good]))
    form = vertex_forms(corner[good], n[good], faces[good], len(position))
    total = np.zeros((len(position), 3))
    for k in range(3):
        np.add.at(total, faces[good, k], du[good] * area[good, None])
    found = np.stack(along_frame(form, normal.astype(float), total), axis=1) * width
    return np.asarray(found, np.float32)


def vertex_forms(corner: Floats, normal: Floats, faces: Ints, count: int) -> Floats:
    """Second fundamental forms (count, 3, 3) at vertices, 1/length: means of those of triangles.

    Triangles without area say nothing; a vertex of none but such is flat.

    Args:
        corner, normal: (f, 3, 3) positions and unit normals of the corners of triangles.
        faces: (f, 3) which of `count` vertices each is.
    """
    edges = corner[:, 1:] - corner[:, :1]
    across = np.cross(edges[:, 0], edges[:, 1])
    area = np.linalg.norm(across, axis=1)
    size = np.square(edges).sum(axis=(1, 2))
    good = area > 1e-12 * np.maximum(size, 1e-30)
    corner, normal, faces, edges = corner[good], normal[good], faces[good], edges[good]
    flat = across[good] / area[good, None]
    # Whichever way a triangle is wound, its vertices' normals say where outside is.
    flat *= np.where(np.einsum("ij,ikj->i", flat, normal) < 0, -1.0, 1.0)[:, None]
    form = _of_triangles(edges, normal, flat)
    total, weight = np.zeros((count, 6)), np.zeros(count)
    for k in range(3):
        own = normal[:, k]
        share = area[good] * (np.einsum("ij,ij->i", flat, own) > _OPPOSITE)
        turn = rotation(flat, own)
        turned = turn @ form @ turn.transpose(0, 2, 1)
        for entry, (i, j) in enumerate(_ENTRIES):
            total[:, entry] += np.bincount(faces[:, k], turned[:, i, j] * share, count)
        weight += np.bincount(faces[:, k], share, count)
    mean = total / np.maximum(weight, 1e-300)[:, None]
    return np.asarray(mean[:, _PLACES])


# The six numbers of a symmetric tensor, and where each stands.
_ENTRIES = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_PLACES = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


def vertices(corner: Floats, normal: Floats) -> Ints:
    """(f, 3) which vertex each corner of triangles is: one place with one normal is one vertex.

    Creases, where normals differ, part what they separate; seams of uv do not. Any number of
    triangles may meet in a vertex or an edge.

    Args:
        corner, normal: (f, 3, 3) positions and unit normals.
    """
    size = max(float(np.ptp(corner.reshape(-1, 3), axis=0).max()), 1e-300)
    place = np.rint(corner.reshape(-1, 3) / (size * _SAME_PLACE)).astype(np.int64)
    way = np.rint(normal.reshape(-1, 3) / _SAME_NORMAL).astype(np.int64)
    # One number for each, as rows are slow to tell apart; odd factors spread them over 64 bits.
    factors = np.array(
        [0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9,
         0xD6E8FEB86659FD93, 0xA0761D6478BD642F, 0xE7037ED1A0B428DB], np.uint64,
    )  # fmt: skip
    keys = np.concatenate([place, way], axis=1).astype(np.uint64) * factors
    mixed = keys ^ (keys >> np.uint64(29))
    _, index = np.unique((mixed * factors[::-1]).sum(axis=1, dtype=np.uint64), return_inverse=True)
    return np.asarray(index, np.intp).reshape(-1, 3)


def along_frame(form: Floats, normal: Floats, x: Floats) -> tuple[Floats, Floats, Floats]:
    """xx, xy, yy (v,) of forms (v, 3, 3) along tangents x (v, 3), of any length, and normal x x."""
    x = x - normal * np.einsum("ij,ij->i", x, normal)[:, None]
    x = x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-300)
    y = np.cross(normal, x)
    bent = np.einsum("ijk,ik->ij", form, x)
    return (
        np.einsum("ij,ij->i", x, bent),
        np.einsum("ij,ij->i", y, bent),
        np.einsum("ij,ijk,ik->i", y, form, y),
    )


def principal(form: Floats, normal: Floats) -> Principal:
    """Principal curvatures and directions of forms (v, 3, 3) at unit normals (v, 3)."""
    # The axis farthest from the normal has the longest part in the tangent plane.
    axis = np.eye(3)[np.abs(normal).argmin(axis=1)]
    x = axis - normal * np.einsum("ij,ij->i", axis, normal)[:, None]
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(normal, x)
    xx, xy, yy = along_frame(form, normal, x)
    mean, spread = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    angle = np.arctan2(2 * xy, xx - yy) / 2
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    return Principal(mean + spread, mean - spread, cos * x + sin * y, cos * y - sin * x)


def _of_triangles(edges: Floats, normal: Floats, flat: Floats) -> Floats:
    """Forms (f, 3, 3) of triangles: edges (f, 2, 3), corner normals (f, 3, 3), flat ones (f, 3)."""
    x = edges[:, 0] / np.linalg.norm(edges[:, 0], axis=1, keepdims=True)
    frame = np.stack([x, np.cross(flat, x)], axis=1)
    turns = normal[:, 1:] - normal[:, :1]
    step, turn = (np.einsum("fak,fek->fae", frame, d) for d in (edges, turns))
    # Closed form: a general inverse of a million small matrices takes half a minute.
    (a, b), (c, d) = np.moveaxis(step, 0, -1)
    inverse = np.stack([np.stack([d, -b], -1), np.stack([-c, a], -1)], -2)
    form = turn @ (inverse / (a * d - b * c)[:, None, None])
    form = (form + form.transpose(0, 2, 1)) / 2
    return np.asarray(frame.transpose(0, 2, 1) @ form @ frame)
