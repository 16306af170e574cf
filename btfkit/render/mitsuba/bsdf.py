"""The plugin `btfkit`: a material as a BSDF."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from btfkit.materials.file import load
from btfkit.render.mitsuba.evaluation import Evaluation
from btfkit.render.picture import to_rgb


def register() -> None:
    """Register the plugin in the variant that is set.

    Raises:
        RuntimeError: none is set.
    """
    if mi.variant() is None:
        raise RuntimeError("no variant of Mitsuba is set; mitsuba.set_variant('llvm_ad_rgb') first")
    mi.register_bsdf("btfkit", _bsdf_class())


def _bsdf_class() -> Any:
    """The class: its base exists only once a variant is set."""

    class Btfkit(mi.BSDF):  # type: ignore[misc]
        """A material of btfkit."""

        def __init__(self, props: Any) -> None:
            mi.BSDF.__init__(self, props)
            self._name = str(props["filename"])
            material = load(self._name)
            self._material = material
            self._repeat = float(props.get("repeat", 1.0))
            self._footprint = float(props.get("footprint", 0.5))
            self._rgb = to_rgb(material.header.channels).tolist()
            self._evaluation = Evaluation(material.program()) if dr.is_jit_v(mi.Float) else None
            lobe = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.SpatiallyVarying
            self.m_components = [lobe | mi.BSDFFlags.FrontSide | mi.BSDFFlags.Anisotropic]
            self.m_flags = self.m_components[0]

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            active = active & (si.wi.z > 0) & (wo.z > 0)
            u, v = si.uv.x * self._repeat, (1 - si.uv.y) * self._repeat
            footprint = self._spread(si)
            if self._evaluation is None:
                value = self._one((u, v), wo, si.wi, footprint) if active else [0.0] * 3
                return mi.Spectrum(*value)
            if self._material.header.wrap == "wrap":
                uv = [u - dr.floor(u), v - dr.floor(v)]
            else:
                uv = [dr.clip(u, 0, 1), dr.clip(v, 0, 1)]
            toward, eye = ([way.x, way.y, way.z] for way in (wo, si.wi))
            found, _ = self._evaluation(uv, toward, eye, footprint, active)
            rgb = [
                sum(m[k] * x for m, x in zip(self._rgb, found, strict=True) if m[k])
                for k in range(3)
            ]
            return mi.Spectrum(*rgb) / math.pi & active

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
            wo = mi.warp.square_to_cosine_hemisphere(sample2)
            chance = mi.warp.square_to_cosine_hemisphere_pdf(wo)
            active = active & (si.wi.z > 0) & (chance > 0)
            found = dr.zeros(mi.BSDFSample3f)
            found.wo, found.pdf, found.eta = wo, dr.select(active, chance, 0), 1.0
            found.sampled_type, found.sampled_component = +mi.BSDFFlags.GlossyReflection, 0
            value = self.eval(ctx, si, wo, active) / dr.select(active, chance, 1)
            return found, value & active if dr.is_jit_v(mi.Float) else value

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            active = active & (si.wi.z > 0) & (wo.z > 0)
            return dr.select(active, mi.warp.square_to_cosine_hemisphere_pdf(wo), 0)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def to_string(self) -> str:
            return f"Btfkit[filename={self._name!r}, repeat={self._repeat}]"

        def _spread(self, si: Any) -> Any:
            """Standard deviation of a pixel, texels: half its steps, as the renderer has it."""
            h, w = self._material.header.grid
            variance = 0.0
            for step in (si.duv_dx, si.duv_dy):
                x, y = step.x * (self._repeat * w), step.y * (self._repeat * h)
                variance = variance + (x * x + y * y) / 8
            return dr.maximum(dr.sqrt(variance), self._footprint)

        def _one(self, uv: Any, light: Any, view: Any, footprint: float) -> list[float]:
            toward, eye = ([way.x, way.y, way.z] for way in (light, view))
            kept = footprint if self._material.has_levels else 0.5
            found = self._material.evaluate(uv, toward, eye, footprint=kept).reflectance
            return (found @ np.asarray(self._rgb) / math.pi).tolist()

    return Btfkit
