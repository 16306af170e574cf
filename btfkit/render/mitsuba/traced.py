"""Materials as BSDFs in variants that Dr.Jit traces."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi

from btfkit.materials.base import Material
from btfkit.materials.measured.interpolation import Interpolation
from btfkit.render.mitsuba import lobes as lobes_
from btfkit.render.mitsuba.asked import Asked
from btfkit.render.mitsuba.evaluation import Evaluation
from btfkit.render.mitsuba.measured import Measured


class Traced:
    """A BSDF whose evaluation is traced; methods as `mitsuba.BSDF` has them."""

    def __init__(self, material: Material, asked: Asked) -> None:
        self._material, self._asked = material, asked
        if isinstance(material, Interpolation):
            self._evaluation: Evaluation | Measured = Measured(material)
        else:
            self._evaluation = Evaluation(material.program())
        self._rgb, self.passes = self._evaluation.rgb, self._evaluation.passes
        self._lobes = lobes_.Lobes(material.lobes)

    def traverse(self, callback: Any) -> None:
        for name, pyramid in self._evaluation.pyramids.items():
            callback.put(name, pyramid.texels, mi.ParamFlags.Differentiable)

    def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        if not ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0):
            return mi.Spectrum(0)
        return self._value(self._seen(si, active), wo, active)

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        if not ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0):
            return mi.Float(0)
        seen = self._seen(si, active)
        return self._density(ctx, seen, self._lobe(si, seen, active), wo, active)

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

    def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
        reflected = ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0)
        passed = self.passes and ctx.is_enabled(mi.BSDFFlags.Null, 1)
        found = dr.zeros(mi.BSDFSample3f)
        found.eta = 1.0
        if not reflected and not passed:
            return found, mi.Spectrum(0)
        seen = self._seen(si, active)
        cover = self._cover(si, seen, active) if passed else mi.Float(1)
        if not reflected:
            cover = mi.Float(0)
        hits = active & (sample1 < cover)
        # What is left of the number that chose between them chooses the lobe.
        lobe = self._lobe(si, seen, active)
        pick = sample1 / dr.maximum(cover, 1e-6) if passed else sample1
        wo = lobes_.draw(lobe, si.wi, pick, sample2)
        density = self._density(ctx, seen, lobe, wo, hits)
        value = self._value(seen, wo, hits) / dr.select(density > 0, density, 1)
        hits &= density > 0
        if not passed:
            found.wo, found.pdf = wo, dr.select(hits, density, 0)
            found.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
            found.sampled_component = mi.UInt32(0)
            return found, value & hits
        through = active & ~(sample1 < cover)
        found.wo = dr.select(through, -si.wi, wo)
        found.pdf = dr.select(through, 1 - cover if reflected else 1.0, density)
        found.pdf = dr.select(through | hits, found.pdf, 0)
        found.sampled_component = dr.select(through, mi.UInt32(1), 0)
        found.sampled_type = dr.select(
            through, mi.UInt32(+mi.BSDFFlags.Null), +mi.BSDFFlags.GlossyReflection
        )
        # All that passes passes: where no reflection is asked for, its share is the weight.
        share = mi.Float(1) if reflected else 1 - self._cover(si, seen, active)
        return found, dr.select(through, mi.Spectrum(share), value) & (through | hits)

    def eval_null_transmission(self, si: Any, active: Any = True) -> Any:
        if not self.passes:
            return mi.Spectrum(0)
        return mi.Spectrum(1 - self._cover(si, self._seen(si, active), active)) & active

    def _seen(self, si: Any, active: Any) -> Any:
        """What lights of a view share; of equal arguments Dr.Jit computes it once."""
        active = active & (si.wi.z > 0)
        u, v = self._asked.uv(si)
        if self._material.header.wrap == "wrap":
            uv = [u - dr.floor(u), v - dr.floor(v)]
        else:
            uv = [dr.clip(u, 0, 1), dr.clip(v, 0, 1)]
        view = [si.wi.x, si.wi.y, si.wi.z]
        bent = self._asked.curvature(si, active) if self._evaluation.bends else 0.0
        return self._evaluation.seen(uv, view, self._asked.footprint(si), active, bent)

    def _lobe(self, si: Any, seen: Any, active: Any) -> lobes_.Drawn:
        active = active & (si.wi.z > 0)
        place = self._evaluation.place(seen)
        return self._lobes(place, si.wi, self._asked.footprint(si), active)

    def _density(self, ctx: Any, seen: Any, lobe: Any, wo: Any, active: Any) -> Any:
        found = lobes_.pdf(lobe, wo, mi.Vector3f(*seen.view))
        if self.passes and ctx.is_enabled(mi.BSDFFlags.Null, 1):
            found *= self._evaluation.opacity(seen, active)
        return dr.select(active & (seen.view[2] > 0), found, 0)

    def _value(self, seen: Any, wo: Any, active: Any) -> Any:
        lit = active & (seen.view[2] > 0) & (wo.z > 0)
        found, cover = self._evaluation.answer(seen, [wo.x, wo.y, wo.z], lit)
        rgb = [sum(m[k] * x for m, x in zip(self._rgb, found, strict=True) if m[k])
               for k in range(3)]  # fmt: skip
        value = mi.Spectrum(*rgb) * (cover / math.pi if self.passes else 1 / math.pi)
        return value & lit

    def _cover(self, si: Any, seen: Any, active: Any) -> Any:
        """Opacity; from behind there is nothing: what passed it leaves the body as it came."""
        return dr.select(si.wi.z > 0, self._evaluation.opacity(seen, active), 0)
