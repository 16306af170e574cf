"""Curvature as it is published for silhouettes: the least along a short curve past the entry.

Source: Kuznetsov et al., "Rendering Neural Materials on Curved Surfaces", 2022, section 4.2 and
Fig. 2 (b): the minimum of the curvature along the ray over a short curve on the surface past the
shading point, in the plane of ray and normal. The paper leaves open how short it is.
"""

from __future__ import annotations

from typing import ClassVar, final

import numpy as np
from numpy.typing import NDArray

from btfkit.shapes.closed import Floats, Foot, Meeting, Shape, Surface

# Below this sine to the normal a ray has no plane with it.
_STRAIGHT = 1e-6
# The surface is sought no deeper than so many steps under the one that was walked to.
_DEEPEST = 3.0


@final
class MinimumCurvature(Shape):
    """A shape that bends, in all directions, by the least curvature past where a ray meets it.

    The curve follows the surface in the plane of ray and normal, away from the eye, and ends where
    the surface does. Rays along the normal have no such plane, and keep how the surface bends. Of a
    surface seen from behind it is the least as seen from there. What a ray meets, uv, normals and
    feet are the shape's own.

    Only `surface` is filtered, so `render` still tells its chord to a ray that grazes a material of
    a known thickness; with the material's `thickness` at 0 it tells the filtered curvature alone.

    Args:
        shape: what is filtered.
        reach: length of the curve, tile widths, over 0.
        steps: places of the curve that are looked at beside the entry, alike apart.

    Raises:
        ValueError: no length, or no step.
    """

    # What the shape is may not be known here; followed shadows are right on any.
    convex: ClassVar[bool] = False

    def __init__(self, shape: Shape, reach: float, steps: int = 8) -> None:
        if not (np.isfinite(reach) and reach > 0 and steps >= 1):
            raise ValueError(
                f"a curve of {reach} tile widths in {steps} steps; expected a finite length "
                "over 0 and one step at least"
            )
        self._shape, self._steps = shape, steps
        self._step = reach * shape.tile / steps
        self.half_height, self.tile = shape.half_height, shape.tile

    def meet(self, origin: Floats, direction: Floats, beyond: Floats) -> Meeting:
        return self._shape.meet(origin, direction, beyond)

    def blocks(self, origin: Floats, direction: Floats, beyond: Floats) -> NDArray[np.bool_]:
        return self._shape.blocks(origin, direction, beyond)

    def foot(self, point: Floats, up: Floats) -> Foot:
        return self._shape.foot(point, up)

    def surface(self, origin: Floats, direction: Floats, met: Meeting) -> Surface:
        found = self._shape.surface(origin, direction, met)
        ahead = direction - found.normal * _dot(direction, found.normal)[:, None]
        length = np.linalg.norm(ahead, axis=1)
        rows = np.flatnonzero(length > _STRAIGHT)
        if not rows.size:
            return found
        side = np.where(_dot(found.flat, direction) > 0, -1.0, 1.0)[rows]
        least = side * self._least(
            found.point[rows], found.normal[rows], ahead[rows] / length[rows, None],
            _along(found, rows, ahead[rows] / length[rows, None]), side,
        )  # fmt: skip
        bend = np.array(found.bend, float)
        bend[rows] = np.stack([least, 0 * least, least], axis=1)
        return found._replace(bend=bend)

    def _least(
        self, point: Floats, up: Floats, ahead: Floats, bend: Floats, side: Floats
    ) -> Floats:
        """Least curvature (m,) as seen from the eye, over curves from points (m, 3).

        Args:
            up, ahead: (m, 3) normals and unit tangents away from the eye.
            bend: (m,) along them. side: (m,) 1 of what is seen from outside, -1 from within.
        """
        least, across = side * bend, np.cross(up, ahead)
        alive = np.arange(len(point))
        for _ in range(self._steps):
            above = point + self._step * (ahead + up)
            met = self._shape.meet(above, -up, np.zeros(len(alive)))
            good = met.distance < _DEEPEST * self._step
            if not good.any():
                break
            alive, above, up, across = alive[good], above[good], up[good], across[good]
            here = self._shape.surface(above, -up, Meeting(met.distance[good], met.part[good]))
            ahead = np.cross(across, here.normal)
            ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-30)
            found = side[alive] * _along(here, np.arange(len(alive)), ahead)
            least[alive] = np.minimum(least[alive], found)
            # Within the plane, so that the next step stays in it.
            point, up = here.point, np.cross(ahead, across)
        return least


def _along(surface: Surface, rows: NDArray[np.intp], tangent: Floats) -> Floats:
    """Normal curvature (k,) of some points of a surface along unit tangents (k, 3)."""
    normal, du, bend = surface.normal[rows], surface.du[rows], surface.bend[rows]
    x = du - normal * _dot(du, normal)[:, None]
    x = x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-30)
    a, b = _dot(tangent, x), _dot(tangent, np.cross(normal, x))
    return np.asarray(bend[:, 0] * a**2 + 2 * bend[:, 1] * a * b + bend[:, 2] * b**2)


def _dot(a: Floats, b: Floats) -> Floats:
    return np.einsum("ij,ij->i", a, b)
