"""Sampling lobes traced by Dr.Jit, as `btfkit.materials.lobes` has them."""

from __future__ import annotations

import math
from typing import Any, NamedTuple, final

import drjit as dr
import mitsuba as mi
import numpy as np

from btfkit.conventions import LEAST_FACING
from btfkit.materials.lobes import LobeTable
from btfkit.render.mitsuba.pyramid import kept


class Drawn(NamedTuple):
    """The lobe of a place as a view sees it.

    Attributes:
        normal: of the GGX lobe. alpha: its roughness. share: of the samples.
    """

    normal: Any
    alpha: Any
    share: Any


@final
class Lobes:
    """A table of lobes in the variant that is set.

    Args:
        table: what `Material.lobes` gives.
    """

    def __init__(self, table: LobeTable) -> None:
        self._table = table
        sizes = [level.shape[:2] for level in table.levels]
        starts = np.cumsum([0, *(h * w for h, w in sizes)])[:-1]
        flat = np.concatenate([level.reshape(-1, 5) for level in table.levels])
        self._cells, self._grazing = kept(flat[:, :4]), kept(flat[:, 4])
        shapes = np.array([(w, h, start) for (h, w), start in zip(sizes, starts, strict=True)])
        self._sizes = [mi.UInt32(part.astype(np.uint32)) for part in shapes.T]
        cells = sizes[0]
        self._texels = max(g / c for g, c in zip(table.grid, cells, strict=True))

    def __call__(self, uv: Any, view: Any, footprint: Any, active: Any) -> Drawn:
        """The lobe at a place (u, v) in one tile, or clamped to it."""
        wide = dr.log2(dr.clip(2 * footprint / self._texels, 1, 1e30))
        # Halves round to even, as numpy's do.
        level = dr.minimum(mi.UInt32(dr.round(wide)), len(self._table.levels) - 1)
        w, h, start = (dr.gather(mi.UInt32, table, level, active) for table in self._sizes)
        inside = [x - dr.floor(x) if self._table.wrap == "wrap" else dr.clip(x, 0, 1) for x in uv]
        col = dr.minimum(mi.UInt32(inside[0] * mi.Float(w)), w - 1)
        row = dr.minimum(mi.UInt32(inside[1] * mi.Float(h)), h - 1)
        at = start + row * w + col
        x, y, alpha, share = dr.gather(mi.Vector4f, self._cells, at, active)
        grazing = dr.gather(mi.Float, self._grazing, at, active)
        normal = dr.normalize(mi.Vector3f(-x, -y, 1))
        facing = dr.dot(view, normal)
        schlick = (1 - dr.clip(facing, 0, 1)) ** 5
        share = share + (grazing - share) * schlick
        return Drawn(normal, dr.maximum(alpha, 1e-3), dr.select(facing > LEAST_FACING, share, 0))


def draw(lobe: Drawn, view: Any, pick: Any, numbers: Any) -> Any:
    """A light; as `density.draw`."""
    first, second = (dr.clip(x, 2.0**-24, 1 - 2.0**-24) for x in (numbers.x, numbers.y))
    sine, cosine = dr.sincos(2 * math.pi * second)
    radius = dr.sqrt(first)
    even = mi.Vector3f(radius * cosine, radius * sine, dr.sqrt(1 - first))
    frame = mi.Frame3f(lobe.normal)
    local = frame.to_local(view)
    local.z = dr.maximum(local.z, LEAST_FACING)
    cap = dr.normalize(mi.Vector3f(lobe.alpha * local.x, lobe.alpha * local.y, local.z))
    up = (1 - first) * (1 + cap.z) - cap.z
    aside = dr.sqrt(dr.maximum(1 - up * up, 0))
    half = dr.normalize(mi.Vector3f(
        lobe.alpha * (cap.x + aside * cosine), lobe.alpha * (cap.y + aside * sine),
        dr.maximum(cap.z + up, 1e-9),
    ))  # fmt: skip
    glossy = frame.to_world(2 * dr.dot(local, half) * half - local)
    glossy = dr.normalize(glossy)
    glossy.z = dr.abs(glossy.z)
    return dr.select(pick < lobe.share, glossy, even)


def pdf(lobe: Drawn, light: Any, view: Any) -> Any:
    """Density over solid angle; as `density.pdf`."""
    below = mi.Vector3f(light.x, light.y, -light.z)
    gloss = _glossy(lobe, light, view) + _glossy(lobe, below, view)
    found = (1 - lobe.share) * light.z / math.pi + lobe.share * gloss
    return dr.select(light.z > 0, found, 0)


def _glossy(lobe: Drawn, light: Any, view: Any) -> Any:
    half = light + view
    square = dr.squared_norm(half)
    known = square > 1e-12
    half = half * dr.rsqrt(dr.maximum(square, 1e-12))
    up = dr.dot(half, lobe.normal)
    aside = dr.squared_norm(dr.cross(half, lobe.normal))
    facing = dr.maximum(dr.dot(view, lobe.normal), LEAST_FACING)
    rough = lobe.alpha * lobe.alpha
    spread = rough / (math.pi * dr.square(up * up * rough + aside))
    mask = 2 * (facing + dr.sqrt(rough + (1 - rough) * facing * facing))
    return dr.select((up > 0) & known, spread / mask, 0)
