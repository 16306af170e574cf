"""A triangle mesh as a shape: smooth normals and curvature, uv steps of each triangle."""

from __future__ import annotations

from typing import ClassVar, final

import numpy as np
from numpy.typing import NDArray

from btfkit.shapes.bending import along_frame, vertex_forms, vertices
from btfkit.shapes.bvh import Ints
from btfkit.shapes.closed import Floats, Meeting, Shape, Surface
from btfkit.shapes.embree import rays_to
from btfkit.shapes.triangles import Triangles


@final
class Mesh(Shape):
    """A mesh, moved to the centre of its box and scaled into the unit sphere.

    Curvature is that of its vertices, interpolated for any tangent (`bending`), and theirs that of
    the normals around, so faceted meshes have none. A triangle whose texture coordinates have no
    area keeps a frame of its own and shows one texel.

    Args:
        triangles: what it is made of.
        repeat: tiles across the unit of its texture coordinates. aspect: tile width / height.
    """

    convex: ClassVar[bool] = False

    def __init__(self, triangles: Triangles, *, repeat: int = 1, aspect: float = 1.0) -> None:
        self.half_height = 1.04
        at = triangles.corner
        centre = (at.min(axis=(0, 1)) + at.max(axis=(0, 1))) / 2
        self._corner = (at - centre) / np.linalg.norm(at - centre, axis=2).max()
        edges = self._corner[:, 1:] - self._corner[:, :1]
        flat = np.cross(edges[:, 0], edges[:, 1])
        area = np.linalg.norm(flat, axis=1)
        self._flat = flat / area[:, None]
        # Normals say where outside is; faces wound the other way are turned.
        inward = np.einsum("ij,ikj->i", self._flat, triangles.normal) < 0
        self._flat[inward] *= -1
        self._normal = triangles.normal
        # Rows run down from the top, v of an OBJ up from the bottom.
        self._uv = (triangles.uv * [1, -1] + [0, 1]) * [repeat, repeat * aspect]
        self._du, self._dv = _uv_edges(edges, self._uv)
        index = vertices(self._corner, self._normal)
        self._form = vertex_forms(self._corner, self._normal, index, int(index.max()) + 1)
        self._vertex = index
        width = np.linalg.norm(self._du, axis=1)
        self.tile = float(np.average(width, weights=area))
        self._tree = rays_to(self._corner)

    def meet(self, origin: Floats, direction: Floats, beyond: Floats) -> Meeting:
        return Meeting(*self._tree.meet(origin, direction, beyond))

    def blocks(self, origin: Floats, direction: Floats, beyond: Floats) -> NDArray[np.bool_]:
        return self._tree.blocks(origin, direction, beyond)

    def surface(self, origin: Floats, direction: Floats, met: Meeting) -> Surface:
        face = met.part
        point = origin + met.distance[:, None] * direction
        weight = self._barycentric(point, face)
        normal = np.einsum("ij,ijk->ik", weight, self._normal[face])
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        flat = self._flat[face]
        normal = np.where(length > 1e-6, normal / np.maximum(length, 1e-6), flat)
        # On the surface that the normals stand for no facet shadows its neighbour.
        # Source: Hanika, "Hacking the Shadow Terminator", Ray Tracing Gems II, 2021.
        below = np.einsum(
            "ijk,ijk->ij", point[:, None] - self._corner[face], self._normal[face]
        )  # fmt: skip
        lift = np.minimum(below, 0)[..., None] * self._normal[face]
        start = point - np.einsum("ij,ijk->ik", weight, lift)
        uv = np.einsum("ij,ijk->ik", weight, self._uv[face])
        form = np.einsum("ij,ijkl->ikl", weight, self._form[self._vertex[face]])
        bend = np.stack(along_frame(form, normal, self._du[face]), axis=1)
        return Surface(point, normal, flat, uv, self._du[face], self._dv[face], bend, start)

    def _barycentric(self, point: Floats, face: Ints) -> Floats:
        """Barycentric coordinates (m, 3) of points on triangles."""
        first, second, third = np.moveaxis(self._corner[face], 1, 0)
        b, c = _solved(second - first, third - first, point - first)
        return np.clip(np.stack([1 - b - c, b, c], axis=1), 0, 1)


def _solved(e1: Floats, e2: Floats, step: Floats) -> tuple[Floats, Floats]:
    """a, b (m,) with a e1 + b e2 nearest to step, all (m, 3)."""
    aa, ab, bb = (np.einsum("ij,ij->i", p, q) for p, q in ((e1, e1), (e1, e2), (e2, e2)))
    pa, pb = (np.einsum("ij,ij->i", step, e) for e in (e1, e2))
    area = aa * bb - ab**2
    return (bb * pa - ab * pb) / area, (aa * pb - ab * pa) / area


def _uv_edges(edges: Floats, uv: Floats) -> tuple[Floats, Floats]:
    """Step of the point a tile in u and in v, (f, 3) each."""
    (u1, v1), (u2, v2) = (np.moveaxis(uv[:, k] - uv[:, 0], -1, 0) for k in (1, 2))
    area = u1 * v2 - u2 * v1
    flat = np.abs(area) < 1e-14
    scale = np.where(flat, 1.0, area)[:, None]
    du = (v2[:, None] * edges[:, 0] - v1[:, None] * edges[:, 1]) / scale
    dv = (u1[:, None] * edges[:, 1] - u2[:, None] * edges[:, 0]) / scale
    side = edges[:, 0]
    across = np.cross(np.cross(edges[:, 0], edges[:, 1]), side)
    across *= np.linalg.norm(side, axis=1, keepdims=True) / np.linalg.norm(
        across, axis=1, keepdims=True
    )
    return np.where(flat[:, None], side, du), np.where(flat[:, None], -across, dv)
