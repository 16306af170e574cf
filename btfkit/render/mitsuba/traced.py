"""Materials as BSDFs in variants that Dr.Jit traces."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from btfkit.materials.base import Material
from btfkit.materials.measured.interpolation import Interpolation
from btfkit.render.mitsuba import lobes as lobes_
from btfkit.render.mitsuba.asked import Asked
from btfkit.render.mitsuba.evaluation import Evaluation
from btfkit.render.mitsuba.measured import Measured


class _View(NamedTuple):
    """What all lights of a view share.

    Attributes:
        seen: where its rays end. lobe: that samples come from. cover: opacity, 0 from below.
    """

    seen: Any
    lobe: lobes_.Drawn
    cover: Any


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
        self._kept: tuple[tuple[int, ...], _View] | None = None

    def traverse(self, callback: Any) -> None:
        for name, pyramid in self._evaluation.pyramids.items():
            callback.put(name, pyramid.texels, mi.ParamFlags.Differentiable)

    def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        if not ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0):
            return mi.Spectrum(0)
        return self._value(self._view(si, active), wo, active)

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        if not ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0):
            return mi.Float(0)
        return self._density(ctx, self._view(si, active), wo, active)

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        if not ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0):
            return mi.Spectrum(0), mi.Float(0)
        view = self._view(si, active)
        # A path tracer samples next, in the same function of its kernel.
        if si.wi.z.state == dr.VarState.Symbolic:
            self._kept = _variables(si, active), view
        return self._value(view, wo, active), self._density(ctx, view, wo, active)

    def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
        reflected = ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0)
        passed = self.passes and ctx.is_enabled(mi.BSDFFlags.Null, 1)
        found = dr.zeros(mi.BSDFSample3f)
        found.eta = 1.0
        if not reflected and not passed:
            return found, mi.Spectrum(0)
        kept, self._kept = self._kept, None
        same = kept is not None and kept[0] == _variables(si, active)
        view = kept[1] if kept is not None and same else self._view(si, active)
        cover = view.cover if passed else mi.Float(1)
        if not reflected:
            cover = mi.Float(0)
        hits = active & (sample1 < cover)
        # What is left of the number that chose between them chooses the lobe.
        pick = sample1 / dr.maximum(cover, 1e-6) if passed else sample1
        wo = lobes_.draw(view.lobe, si.wi, pick, sample2)
        density = self._density(ctx, view, wo, hits)
        value = self._value(view, wo, hits) / dr.select(density > 0, density, 1)
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
        share = mi.Float(1) if reflected else 1 - view.cover
        return found, dr.select(through, mi.Spectrum(share), value) & (through | hits)

    def eval_null_transmission(self, si: Any, active: Any = True) -> Any:
        if not self.passes:
            return mi.Spectrum(0)
        return mi.Spectrum(1 - self._view(si, active).cover) & active

    def _view(self, si: Any, active: Any) -> _View:
        """What lights of a view share."""
        active = active & (si.wi.z > 0)
        u, v = self._asked.uv(si)
        if self._material.header.wrap == "wrap":
            uv = [u - dr.floor(u), v - dr.floor(v)]
        else:
            uv = [dr.clip(u, 0, 1), dr.clip(v, 0, 1)]
        way = [si.wi.x, si.wi.y, si.wi.z]
        bent = self._asked.curvature(si, active) if self._evaluation.bends else 0.0
        footprint = self._asked.footprint(si)
        # Each takes what it has seen itself.
        seen: Any = self._evaluation.seen(uv, way, footprint, active, bent)
        lobe = self._lobes(self._evaluation.place(seen), si.wi, footprint, active)
        # From behind there is nothing: what passed it leaves the body as it came.
        cover = mi.Float(1)
        if self.passes:
            cover = dr.select(si.wi.z > 0, self._evaluation.opacity(seen, active), 0)
        return _View(seen, lobe, cover)

    def _density(self, ctx: Any, view: _View, wo: Any, active: Any) -> Any:
        found = lobes_.pdf(view.lobe, wo, mi.Vector3f(*view.seen.view))
        if self.passes and ctx.is_enabled(mi.BSDFFlags.Null, 1):
            found *= view.cover
        return dr.select(active & (view.seen.view[2] > 0), found, 0)

    def _value(self, view: _View, wo: Any, active: Any) -> Any:
        lit = active & (view.seen.view[2] > 0) & (wo.z > 0)
        found, cover = self._evaluation.answer(view.seen, [wo.x, wo.y, wo.z], lit)
        rgb = [sum(m[k] * x for m, x in zip(self._rgb, found, strict=True) if m[k])
               for k in range(3)]  # fmt: skip
        value = mi.Spectrum(*rgb) * (cover / math.pi if self.passes else 1 / math.pi)
        return value & lit


def _variables(si: Any, active: Any) -> tuple[int, ...]:
    """Which variables of Dr.Jit an interaction is made of."""
    parts = [*si.wi, *si.uv, *si.duv_dx, *si.duv_dy, si.shape, si.prim_index, mi.Bool(active)]
    return tuple(part.index for part in parts)
