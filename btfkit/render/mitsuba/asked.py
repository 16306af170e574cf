"""What a BSDF is asked, as a material takes it: uv, footprint and curvature."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import drjit as dr

# Attribute of a mesh: its second fundamental form xx, xy, yy in a unit of uv; see `meshes`.
CURVATURE = "vertex_curvature"


@final
@dataclass(frozen=True)
class Asked:
    """How a surface's coordinates become those of a material.

    Attributes:
        repeat: tiles to a unit of uv. grid: (h, w) of the material.
        least: footprint, texels, where the integrator gives no ray differentials.
    """

    repeat: float
    grid: tuple[int, int]
    least: float

    def uv(self, si: Any) -> tuple[Any, Any]:
        """u and v in tiles; v of a mesh points up, ours down."""
        return si.uv.x * self.repeat, (1 - si.uv.y) * self.repeat

    def curvature(self, si: Any, active: Any) -> Any:
        """Along the projected view ray, 1/tile width; straight down the mean."""
        known = active & si.shape.has_attribute(CURVATURE)
        xx, xy, yy = si.shape.eval_attribute_3(CURVATURE, si, known)
        x, y = si.wi.x, si.wi.y
        square = x * x + y * y
        along = (xx * x * x + 2 * xy * x * y + yy * y * y) / dr.maximum(square, 1e-12)
        found = dr.select(square < 1e-12, (xx + yy) / 2, along)
        return dr.select(known, found / self.repeat, 0)

    def footprint(self, si: Any) -> Any:
        """Standard deviation of a pixel, texels: half its steps, as the renderer has it."""
        h, w = self.grid
        variance = 0.0
        for step in (si.duv_dx, si.duv_dy):
            x, y = step.x * (self.repeat * w), step.y * (self.repeat * h)
            variance = variance + (x * x + y * y) / 8
        return dr.maximum(dr.sqrt(variance), self.least)
