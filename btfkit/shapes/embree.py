"""Rays and triangles by Embree: which triangle in float32, where in float64.

The plain twin, and what serves where there is no wheel of Embree, is `bvh.Bvh`.
"""

from __future__ import annotations

import importlib.util
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit.shapes.bvh import Bvh, Floats, Ints

# The mesh lies within this of the origin; rays begin no farther away, for float32's sake.
_REACH = 1.01
# A triangle that a ray begins on may be met again; it is stepped over, each time twice as far.
_STEP, _MOST_TRIES = 1e-6, 24
# Where float32 and float64 differ by more, the ray lies within the triangle's plane.
_AGREE = 1e-4


@final
class Embree:
    """Triangles as Embree holds them.

    Args:
        corner: (f, 3, 3) triangles that have an area, within the unit sphere.
    """

    def __init__(self, corner: Floats) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        # Robust: no ray slips between triangles that share an edge.
        self._scene = EmbreeScene(robust=True)
        self._mesh = TriangleMesh(self._scene, np.ascontiguousarray(corner, np.float32))
        self._first = corner[:, 0]
        self._normal = np.cross(corner[:, 1] - self._first, corner[:, 2] - self._first)

    def meet(self, origin: Floats, direction: Floats, beyond: Floats) -> tuple[Floats, Ints]:
        """Distance (m,) of the first triangle beyond, inf for none, and which it is (m,)."""
        distance, triangle = np.full(len(origin), np.inf), np.zeros(len(origin), np.intp)
        alive, start = _entered(origin, direction, beyond)
        way = np.ascontiguousarray(direction[alive], np.float32)
        step = _STEP
        for _ in range(_MOST_TRIES):
            if not alive.size:
                break
            at = (origin[alive] + start[:, None] * direction[alive]).astype(np.float32)
            met = self._scene.run(at, way, output=True)
            hit = np.flatnonzero(met["primID"] >= 0)
            face, rough = met["primID"][hit].astype(np.intp), start[hit] + met["tfar"][hit]
            alive, start, way = alive[hit], start[hit], way[hit]
            fine = self._crossed(face, origin[alive], direction[alive])
            found = np.where(np.abs(fine - rough) < _AGREE, fine, rough)
            ahead = found > beyond[alive]
            distance[alive[ahead]], triangle[alive[ahead]] = found[ahead], face[ahead]
            alive, way = alive[~ahead], way[~ahead]
            start = np.maximum(start[~ahead], rough[~ahead]) + step
            step *= 2
        return distance, triangle

    def blocks(self, origin: Floats, direction: Floats, beyond: Floats) -> NDArray[np.bool_]:
        """Whether each ray meets a triangle beyond."""
        found = np.zeros(len(origin), bool)
        alive, start = _entered(origin, direction, beyond)
        at = (origin[alive] + start[:, None] * direction[alive]).astype(np.float32)
        way = np.ascontiguousarray(direction[alive], np.float32)
        # Any triangle ends the search; whether it is the one that the ray begins on is seen then.
        some = alive[self._scene.run(at, way, query="OCCLUDED") >= 0]
        found[some] = np.isfinite(self.meet(origin[some], direction[some], beyond[some])[0])
        return found

    def _crossed(self, face: Ints, origin: Floats, direction: Floats) -> Floats:
        """Distance (m,) at which rays cross the planes of triangles; not finite if never."""
        normal = self._normal[face]
        height = np.einsum("ij,ij->i", self._first[face] - origin, normal)
        with np.errstate(divide="ignore", invalid="ignore"):
            return height / np.einsum("ij,ij->i", direction, normal)


def _entered(origin: Floats, direction: Floats, beyond: Floats) -> tuple[Ints, Floats]:
    """Rays that pass the sphere about the mesh, and from which distance on they are in it."""
    along = np.einsum("ij,ij->i", origin, direction)
    inside = _REACH**2 - np.einsum("ij,ij->i", origin, origin) + along**2
    alive = np.flatnonzero(inside > 0)
    return alive, np.maximum(beyond[alive], -along[alive] - np.sqrt(inside[alive]))


def available() -> bool:
    """Whether Embree is installed."""
    return importlib.util.find_spec("embreex") is not None


def rays_to(corner: Floats) -> Embree | Bvh:
    """What finds triangles (f, 3, 3) within the unit sphere: Embree, or its twin without it."""
    return Embree(corner) if available() else Bvh(corner)
