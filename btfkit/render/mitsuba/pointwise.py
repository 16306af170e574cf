"""Materials as BSDFs in scalar variants: the material answers itself, point by point."""

from __future__ import annotations

import math
import warnings
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from btfkit.materials.base import Material
from btfkit.render.mitsuba.asked import CURVATURE, Asked
from btfkit.render.picture import to_rgb


class Pointwise:
    """A BSDF whose material is asked; methods as `mitsuba.BSDF` has them."""

    def __init__(self, material: Material, asked: Asked) -> None:
        self._material, self._asked = material, asked
        self._rgb = to_rgb(material.header.channels)
        try:
            self.passes = material.program().opacity != "none"
        except TypeError:
            self.passes = False

    def traverse(self, callback: Any) -> None:
        """Nothing has gradients here."""

    def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        if not (active and ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0) and _faces(si, wo)):
            return mi.Spectrum(0)
        value, cover = self._answered(si, wo)
        return mi.Spectrum(*(value * (cover if self.passes else 1)).tolist())

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        if not (active and ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0) and _faces(si, wo)):
            return 0.0
        found = float(self._material.pdf(light=[wo.x, wo.y, wo.z], **self._query(si)))
        return found * self._cover(si) if self._shares(ctx) else found

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

    def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
        found = dr.zeros(mi.BSDFSample3f)
        found.eta = 1.0
        reflected = ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0)
        passed = self.passes and ctx.is_enabled(mi.BSDFFlags.Null, 1)
        if not active or not (reflected or passed):
            return found, mi.Spectrum(0)
        cover = self._cover(si) if passed else float(si.wi.z > 0)
        if passed and (not reflected or sample1 >= cover):
            found.wo, found.pdf = -si.wi, 1 - cover if reflected else 1.0
            found.sampled_type, found.sampled_component = +mi.BSDFFlags.Null, 1
            return found, mi.Spectrum(1 if reflected else 1 - cover)
        if si.wi.z <= 0:
            return found, mi.Spectrum(0)
        random = [min(sample1 / max(cover, 1e-6), 1), sample2[0], sample2[1]]
        light, _ = self._material.sample(random=random, **self._query(si))
        found.wo = mi.Vector3f(*light.tolist())
        found.pdf = self.pdf(ctx, si, found.wo)
        found.sampled_type, found.sampled_component = +mi.BSDFFlags.GlossyReflection, 0
        value = self.eval(ctx, si, found.wo)
        return found, value / found.pdf if found.pdf > 0 else mi.Spectrum(0)

    def eval_null_transmission(self, si: Any, active: Any = True) -> Any:
        return mi.Spectrum(1 - self._cover(si) if self.passes and active else 0)

    def _shares(self, ctx: Any) -> bool:
        return self.passes and bool(ctx.is_enabled(mi.BSDFFlags.Null, 1))

    def _query(self, si: Any) -> dict[str, Any]:
        asked: dict[str, Any] = {"uv": self._asked.uv(si), "view": [si.wi.x, si.wi.y, si.wi.z]}
        asked["footprint"] = self._asked.footprint(si) if self._material.has_levels else 0.5
        return asked

    def _answered(self, si: Any, wo: Any) -> tuple[Any, float]:
        asked = self._query(si)
        if self._material.has_curvature and si.shape is not None:
            known = si.shape.has_attribute(CURVATURE)
            asked["curvature"] = self._asked.curvature(si, True) if known else 0.0
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            rgb, cover = self._material.evaluate(light=[wo.x, wo.y, wo.z], **asked)
        return rgb @ np.asarray(self._rgb) / math.pi, float(cover)

    def _cover(self, si: Any) -> float:
        return self._answered(si, mi.Vector3f(0, 0, 1))[1] if si.wi.z > 0 else 0.0


def _faces(si: Any, wo: Any) -> bool:
    return bool(si.wi.z > 0 and wo.z > 0)
