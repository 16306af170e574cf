"""A BTF traced by Dr.Jit: textures blended over triangles of measured directions.

What `materials.measured.interpolation` answers of lists in which all views have the same lights.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, final

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from btfkit.materials.base import Material
from btfkit.materials.measured.interpolation import GRAZING, Interpolation
from btfkit.materials.measured.triangulation import DirectionMesh
from btfkit.render.mitsuba.pyramid import beside, kept
from btfkit.render.picture import to_rgb

Numbers = list[Any]
# Bytes of textures in memory, four float32 a texel.
_MOST_BYTES = 4 << 30


class Viewed(NamedTuple):
    """All that does not depend on the light.

    Attributes:
        uv, view: as asked. corners: three rows of the table of views, and their weights.
        taps: four texels beside uv, and their weights.
    """

    uv: Numbers
    view: Numbers
    corners: tuple[Numbers, Numbers]
    taps: list[tuple[Any, Any]]


@final
class Measured:
    """The interpolation of a BTF in the variant that is set.

    Raises:
        TypeError: not a BTF; or one whose views have lights of their own, near lights, or more
            texels than fit in memory.
    """

    bends = passes = False
    # No textures of it can be differentiated.
    pyramids: Mapping[str, Any] = {}

    def __init__(self, material: Material) -> None:
        if not isinstance(material, Interpolation):
            raise TypeError(
                f"{material.model} is not measured; expected a BTF: models are of type btfkit"
            )
        n, (h, w) = material.spec.pairs, material.spec.size
        if 16 * n * h * w > _MOST_BYTES:
            raise TypeError(
                f"{n} textures of {h} x {w} texels take {16 * n * h * w / 2**30:.1f} GiB; at most "
                f"{_MOST_BYTES >> 30}: ingest a part (--roi, --views), or fit a model"
            )
        self._nest = material.nest()
        self._aspect, self._wrap = material.header.aspect, material.header.wrap == "wrap"
        channels = material.header.channels
        spare = len(channels) > 3
        to = to_rgb(channels) if spare else np.eye(len(channels), dtype=np.float32)
        self.rgb = (np.eye(3) if spare else to_rgb(channels)).tolist()
        self._count = to.shape[1]
        texels = np.zeros((n, h, w, 4), np.float32)
        for k in range(n):
            values = material.texture(k)
            good: NDArray[np.bool_] = np.all(np.isfinite(values), axis=2)
            texels[k, ..., : self._count] = np.where(good[..., None], values, 0) @ to
            texels[k, ..., 3] = good
        self._texels = kept(texels)
        self._size, self._pairs = (w, h), mi.UInt32(self._nest.pairs.reshape(-1))
        self._inner = len(self._nest.pairs[0])
        self._outer_mesh, self._inner_mesh = (
            _Triangles(mesh) for mesh in (self._nest.outer, self._nest.inner)
        )
        self._cosines = mi.Float(np.maximum(material.light_cosines(), GRAZING))

    def place(self, seen: Viewed) -> Numbers:
        """Where on the tile the view ray ends: a BTF has no depth."""
        return seen.uv

    def opacity(self, seen: Viewed, active: Any) -> Any:
        """Opaque."""
        return mi.Float(1)

    def seen(
        self, uv: Numbers, view: Numbers, footprint: Any, active: Any, curvature: Any = 0.0
    ) -> Viewed:
        """The part that all lights of a view share."""
        w, h = self._size
        (x0, x1, fx), (y0, y1, fy) = (
            beside(place, size, wrap=self._wrap) for place, size in zip(uv, (w, h), strict=True)
        )
        rows, columns = ((y0, 1 - fy), (y1, fy)), ((x0, 1 - fx), (x1, fx))
        taps = [(y * w + x, share * part) for y, share in rows for x, part in columns]
        mesh = self._inner_mesh if self._nest.light_first else self._outer_mesh
        return Viewed(uv, view, mesh(view, active), taps)

    def answer(self, seen: Viewed, light: Numbers, active: Any) -> tuple[Numbers, Any]:
        """Reflectance by channel under a light, and opacity."""
        first = self._nest.light_first
        lit = (self._outer_mesh if first else self._inner_mesh)(light, active)
        outer, inner = (lit, seen.corners) if first else (seen.corners, lit)
        w, h = self._size
        total = mi.Vector4f(0)
        for row, share in zip(*outer, strict=True):
            for column, part in zip(*inner, strict=True):
                pair = dr.gather(mi.UInt32, self._pairs, row * self._inner + column, active)
                cosine = dr.gather(mi.Float, self._cosines, pair, active)
                gain = dr.maximum(light[2], GRAZING) / cosine
                texel: Any = sum(
                    weight * dr.gather(mi.Vector4f, self._texels, pair * (w * h) + at, active)
                    for at, weight in seen.taps
                )
                total += share * part * texel * mi.Vector4f(gain, gain, gain, 1)
        known = dr.select(total.w > 0, 1 / dr.maximum(total.w, 1e-12), 0)
        return [total[k] * known for k in range(self._count)], mi.Float(1)


@final
class _Triangles:
    """A triangulation of directions: rows of its table and their weights, of a direction."""

    def __init__(self, mesh: DirectionMesh) -> None:
        tables = mesh.tables()
        self._cells, self._most = tables.cells, tables.reaching.shape[1]
        self._half = tables.half
        self._reaching = mi.UInt32(tables.reaching.astype(np.uint32).reshape(-1))
        self._rows = mi.UInt32(tables.rows.astype(np.uint32).reshape(-1))
        self._frame = kept(tables.frame)
        self._origin = kept(tables.origin)

    def __call__(self, way: Numbers, active: Any) -> tuple[Numbers, Numbers]:
        x, y = way[0] / (1 + way[2]), way[1] / (1 + way[2])
        cell = [
            mi.UInt32(dr.clip((p / self._half + 1) * (self._cells / 2), 0, self._cells - 1))
            for p in (x, y)
        ]
        home = (cell[0] * self._cells + cell[1]) * self._most
        best, chosen = mi.Float(-dr.inf), mi.UInt32(0)
        for k in range(self._most):
            triangle = dr.gather(mi.UInt32, self._reaching, home + k, active)
            inside = dr.minimum(*self._two(triangle, x, y, active))
            better = inside > best
            best, chosen = dr.select(better, inside, best), dr.select(better, triangle, chosen)
        a, b = self._barycentric(chosen, x, y, active)
        weights = [dr.select(each < 1e-6, 0, each) for each in (a, b, 1 - a - b)]
        total = weights[0] + weights[1] + weights[2]
        rows = [dr.gather(mi.UInt32, self._rows, chosen * 3 + k, active) for k in range(3)]
        return rows, [each / dr.maximum(total, 1e-12) for each in weights]

    def _two(self, triangle: Any, x: Any, y: Any, active: Any) -> tuple[Any, Any]:
        a, b = self._barycentric(triangle, x, y, active)
        return dr.minimum(a, b), 1 - a - b

    def _barycentric(self, triangle: Any, x: Any, y: Any, active: Any) -> tuple[Any, Any]:
        frame = dr.gather(mi.Vector4f, self._frame, triangle, active)
        origin = dr.gather(mi.Vector2f, self._origin, triangle, active)
        u, v = x - origin.x, y - origin.y
        return frame[0] * u + frame[1] * v, frame[2] * u + frame[3] * v
