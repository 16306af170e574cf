"""The plugins: what Mitsuba makes of a name in a scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi

from btfkit import io
from btfkit.materials.base import Material
from btfkit.materials.file import load
from btfkit.materials.measured.interpolation import Interpolation
from btfkit.render.mitsuba.asked import Asked
from btfkit.render.mitsuba.pointwise import Pointwise
from btfkit.render.mitsuba.traced import Traced


def register() -> None:
    """Register the plugins in the variant that is set.

    Raises:
        RuntimeError: none is set.
    """
    if mi.variant() is None:
        raise RuntimeError("no variant of Mitsuba is set; mitsuba.set_variant('llvm_ad_rgb') first")
    model, measured = _classes()
    mi.register_bsdf("btfkit", model)
    mi.register_bsdf("btfkit_measured", measured)


def _classes() -> tuple[Any, Any]:
    """The classes: their base exists only once a variant is set."""
    reflects = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.SpatiallyVarying
    reflects |= mi.BSDFFlags.FrontSide | mi.BSDFFlags.Anisotropic
    null = mi.BSDFFlags.Null | mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide

    class Btfkit(mi.BSDF):  # type: ignore[misc]
        """A fitted model."""

        def __init__(self, props: Any) -> None:
            mi.BSDF.__init__(self, props)
            self._name = str(props["filename"])
            # As other plugins' files: beside the scene, too.
            material = self._opened(Path(str(mi.file_resolver().resolve(self._name))))
            self._asked = Asked(
                repeat=float(props.get("repeat", 1.0)),
                grid=material.header.grid,
                least=float(props.get("footprint", 0.5)),
            )
            kind = Traced if dr.is_jit_v(mi.Float) else Pointwise
            self._does = kind(material, self._asked)
            self.m_components = [reflects, null] if self._does.passes else [reflects]
            self.m_flags = reflects | (null if self._does.passes else 0)

        def _opened(self, path: Path) -> Material:
            return load(path)

        def traverse(self, callback: Any) -> None:
            self._does.traverse(callback)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self._does.eval(ctx, si, wo, active)

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self._does.pdf(ctx, si, wo, active)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self._does.eval_pdf(ctx, si, wo, active)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
            return self._does.sample(ctx, si, sample1, sample2, active)

        def eval_null_transmission(self, si: Any, active: Any = True) -> Any:
            return self._does.eval_null_transmission(si, active)

        def to_string(self) -> str:
            name, repeat = self._name, self._asked.repeat
            return f"{type(self).__name__}[filename={name!r}, repeat={repeat}]"

    class BtfkitMeasured(Btfkit):
        """A BTF: its textures, blended between the directions that were measured."""

        def _opened(self, path: Path) -> Material:
            return Interpolation.of(io.open(path))

    return Btfkit, BtfkitMeasured
