"""What the shape keeps from its own light."""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit.materials.base import Material
from btfkit.render.gaze import Gaze, gaze
from btfkit.shapes.closed import NEAR, Floats, Meeting, Plane, Shape, Surface

Ints = NDArray[np.intp]
# Sheets that light may pass; the share of light not worth following.
_MOST_SHEETS, _NOTHING = 16, 1e-3
# Places and views that are looked at for holes: few views, since a lazy BTF decodes them.
_PROBES = (256, 16)
_ABOVE = np.array([0.0, 0.0, 1.0])


@final
class Shadows:
    """Shares of light that reach points of a shape, past the shape itself.

    Where a material without curvature is opaque in every one of some thousand random queries, it is
    taken for solid, and shadows ask it nothing.

    Args:
        material: what the shape is covered with. shape: what stands in the light.
        pixel: (2, 3) steps between samples; light that passes holes is blurred like a view.

    Attributes:
        holes: whether the material may be seen through.
        body: whether it fills the shape up to its surface, as models with curvature do: what
            passes it leaves the shape without meeting it from inside.
        asked: queries that the material answered.
    """

    def __init__(self, material: Material, shape: Shape, pixel: Floats) -> None:
        self._material, self._shape, self._pixel = material, shape, pixel
        self.holes = material.has_curvature or _has_holes(material)
        self.body = material.has_curvature and not isinstance(shape, Plane)
        self.asked = 0

    def none_on(self, seen: Gaze) -> bool:
        """Whether nothing of the shape can keep light from what is seen of it."""
        if isinstance(self._shape, Plane):
            return True
        return self._shape.convex and not self._material.full_sphere and bool(seen.outside.all())

    def reached(
        self, surface: Surface, seen: Gaze, light: Floats, local: Floats, rows: Ints
    ) -> Floats:
        """Share of the light, 0 to 1, that reaches some points.

        Args:
            surface, seen: m points and how they are seen.
            light, local: (m, 3) directions of the light, in the object's frame and the points'.
            rows: which of the points are asked for.
        """
        reached = np.ones(len(rows))
        if isinstance(self._shape, Plane):
            return reached
        index = np.arange(len(rows))
        if self._shape.convex:
            index = np.flatnonzero(~(seen.outside[rows] & (local[rows, 2] > 0)))
        if not index.size:
            return reached
        at = rows[index]
        outside = seen.outside[at, None]
        origin = np.where(outside, surface.start[at], surface.point[at])
        reached[index] = self._followed(
            origin, light[at], self._start(origin, light[at], local[at])
        )
        return reached

    def _start(self, origin: Floats, light: Floats, local: Floats) -> Floats:
        """Distance (m,) from which rays count what they meet.

        Light from below the horizon comes through the body that the material stands for: there the
        material itself answers for shadows, and rays count from where they leave the body.
        """
        start = np.full(len(origin), NEAR)
        below = np.flatnonzero(local[:, 2] <= 0)
        if below.size:
            met = self._shape.meet(origin[below], light[below], start[below])
            start[below] = np.where(np.isfinite(met.distance), met.distance + NEAR, NEAR)
        return start

    def _followed(self, origin: Floats, light: Floats, beyond: Floats) -> Floats:
        """Share (m,) of light that passes every sheet on its way."""
        if not self.holes:
            return 1.0 - self._shape.blocks(origin, light, beyond)
        through, alive = np.ones(len(origin)), np.arange(len(origin))
        for _ in range(_MOST_SHEETS):
            met = self._shape.meet(origin[alive], light[alive], beyond[alive])
            hit = np.isfinite(met.distance)
            alive, met = alive[hit], Meeting(met.distance[hit], met.part[hit])
            if not alive.size:
                return through
            through[alive] *= 1 - self._opacity(origin[alive], light[alive], met)
            beyond[alive] = met.distance + NEAR
            alive = alive[through[alive] > _NOTHING]
        through[alive] = 0
        return through

    def _opacity(self, origin: Floats, light: Floats, met: Meeting) -> Floats:
        """Opacity (m,) of sheets along rays, as seen from where the rays begin."""
        surface = self._shape.surface(origin, light, met)
        seen = gaze(self._material, self._shape, surface, -light, self._pixel)
        self.asked += len(light)
        opacity = self._material.evaluate(
            seen.uv, _ABOVE, seen.view, seen.footprint, seen.curvature, seen.told_drift
        ).opacity
        opacity = np.where(np.isfinite(opacity), opacity, 1.0)
        return np.where(seen.outside, opacity, 0.0) if self.body else opacity


def _has_holes(material: Material) -> bool:
    rng = np.random.default_rng(0)
    places, views = _PROBES
    z, angle = rng.random((views, 1)), 2 * np.pi * rng.random((views, 1))
    radius = np.sqrt(1 - z**2)
    view = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=2)
    uv = rng.random((views, places, 2))
    return bool((material.evaluate(uv, _ABOVE, view).opacity < 1).any())
