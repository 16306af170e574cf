"""A relief as a material: the tracer answers, nothing is fitted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, final

import numpy as np

from btfkit.materials.base import Array, Header, Material
from btfkit.materials.lobes import LobeTable
from btfkit.materials.lobes.sampling import derived
from btfkit.native.neural import plain
from btfkit.queries import Query
from btfkit.relief.relief import Relief
from btfkit.relief.trace import SAMPLES, geometry, trace


@final
@dataclass(frozen=True)
class TracedSpec:
    """How a relief is traced.

    Attributes:
        samples: rays a query. bounces: interreflections. seed: of both.
    """

    samples: int = SAMPLES
    bounces: int = 0
    seed: int = 0


@final
class TracedRelief(Material):
    """A relief on the plane, or under a curved surface where no height should be above 0.

    Footprints count its own texels. On a curved surface rays pass what the relief does not fill.
    """

    model: ClassVar[str] = "relief"
    spec_type: ClassVar[type] = TracedSpec
    has_levels: ClassVar[bool] = True
    has_curvature: ClassVar[bool] = True
    full_sphere: ClassVar[bool] = True
    computed: ClassVar[bool] = True

    def __init__(self, relief: Relief, spec: TracedSpec | None = None) -> None:
        header = Header(
            grid=relief.size,
            channels=relief.channels,
            wrap=relief.wrap,
            texel_mm=relief.texel_mm,
            provenance=dict(relief.provenance),
        )
        super().__init__(spec or TracedSpec(), {}, header)
        self.thickness = max(-float(relief.height.min()), 0.0)
        self._relief, self._geometry = relief, geometry(relief)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self._relief, self.spec)

    @classmethod
    def shapes(cls, spec: TracedSpec, header: Header) -> dict[str, tuple[int, ...]]:
        return {}

    def ray_depths(self, uv: Array, view: Array) -> Array:
        height, wrap = self._relief.height, self._relief.wrap == "wrap"
        along = plain.ray(view, self._relief.aspect, 1.0)
        met = plain.crossing(height, uv, along, wrap=wrap) * plain.lift(view)
        return np.asarray(met, np.float32)

    @property
    def lobes(self) -> LobeTable:
        """As of every material, but fitted to answers of one ray each: the mean is the same."""
        if self._lobes is None:
            one = TracedRelief(self._relief, replace(self.spec, samples=1))
            self._lobes = derived(one)
        return self._lobes

    def _answer(self, query: Query) -> tuple[Array, Array | None]:
        spec = self.spec
        traced = trace(
            self._geometry, query, samples=spec.samples, bounces=spec.bounces, seed=spec.seed
        )
        return traced.rgb, traced.opacity
