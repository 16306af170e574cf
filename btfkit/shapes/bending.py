"""How a mesh bends at its vertices: what a material with silhouettes is told on it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]


def vertex_curvature(
    position: Floats, normal: Floats, uv: Floats, faces: NDArray[np.integer]
) -> NDArray[np.float32]:
    """Second fundamental form (v, 3) xx, xy, yy at each vertex, times the width of a unit of u.

    x runs along dp/du, y is normal x x, positive is convex. The width is one for the whole mesh,
    its mean by area. Triangles without area, in space or in uv, tell nothing; a vertex of none but
    such is flat.

    Args:
        position, normal: (v, 3), normals of length 1. uv: (v, 2). faces: (f, 3) vertices.

    Source: Rusinkiewicz, "Estimating Curvatures and Their Derivatives on Triangle Meshes", 2004,
    section 3, with triangles weighted by area.
    """
    corner, n, at = position[faces].astype(float), normal[faces].astype(float), uv[faces]
    edges = np.stack([corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]], axis=1)
    (u1, v1), (u2, v2) = (np.moveaxis(at[:, k].astype(float) - at[:, 0], -1, 0) for k in (1, 2))
    mapped = u1 * v2 - u2 * v1
    flat = np.cross(edges[:, 0], edges[:, 1])
    area = np.linalg.norm(flat, axis=1) / 2
    good = (area > 1e-30) & (np.abs(mapped) > 1e-14)
    scale = np.where(good, mapped, 1)[:, None]
    du = (v2[:, None] * edges[:, 0] - v1[:, None] * edges[:, 1]) / scale
    width = (
        float(np.average(np.linalg.norm(du[good], axis=1), weights=area[good])) if good.any() else 0
    )
    middle = n.sum(axis=1)
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-30)
    x = du - middle * np.einsum("ij,ij->i", du, middle)[:, None]
    x /= np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-30)
    frame = np.stack([x, np.cross(middle, x)], axis=1)
    every = np.stack([corner[:, (k + 1) % 3] - corner[:, k] for k in range(3)], axis=1)
    turns = np.stack([n[:, (k + 1) % 3] - n[:, k] for k in range(3)], axis=1)
    step, turn = (np.einsum("fak,fek->fea", frame, d) for d in (every, turns))
    form = _least_squares(step, turn)
    total, weight = np.zeros((len(position), 3)), np.zeros(len(position))
    rows = good & np.isfinite(form).all(axis=1)
    for k in range(3):
        np.add.at(total, faces[rows, k], form[rows] * area[rows, None])
        np.add.at(weight, faces[rows, k], area[rows])
    found = total / np.maximum(weight, 1e-30)[:, None] * width
    return found.astype(np.float32)


def _least_squares(step: Floats, turn: Floats) -> Floats:
    """(f, 3) xx, xy, yy of the symmetric form that takes steps (f, 3, 2) to turns (f, 3, 2)."""
    x, y = step[..., 0], step[..., 1]
    none = np.zeros_like(x)
    rows = np.concatenate([np.stack([x, y, none], -1), np.stack([none, x, y], -1)], axis=1)
    wanted = np.concatenate([turn[..., 0], turn[..., 1]], axis=1)
    normal_matrix = np.einsum("fri,frj->fij", rows, rows)
    size = np.trace(normal_matrix, axis1=1, axis2=2)
    normal_matrix += (1e-9 * size + 1e-30)[:, None, None] * np.eye(3)
    found: Floats = np.linalg.solve(normal_matrix, np.einsum("fri,fr->fi", rows, wanted)[..., None])
    return found[..., 0]
