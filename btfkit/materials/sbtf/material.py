"""SBTF as it is used: rays that curvature bends meet a texture of heights, or pass it.

What NeuMIP answers on the plane is answered on curved surfaces: opacity and the place that is seen
come from geometry, exactly on a cylinder. Layers take light and view in the frame where the ray
meets the heights, so that what was learnt on the plane is right there, and the curvature where it
was learnt.

Source: Kuznetsov et al., "Rendering Neural Materials on Curved Surfaces", 2022, whose networks of
opacity and offset the march replaces.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any, ClassVar, final

import numpy as np
from numpy.typing import NDArray

from btfkit.materials.base import Array, Header
from btfkit.materials.neumip.material import NeuMIPMaterial
from btfkit.materials.neumip.spec import NeuMIPSpec
from btfkit.materials.sbtf.footprints import softened
from btfkit.native.neural import bent, plain
from btfkit.program import Heights
from btfkit.queries import Query

# Standard deviation, texels, of the footprint of one texel, with room for a rounding.
_SHARP = 0.5001


# Part of its heights' range that a model may stand above the plane with little of its outline lost.
_LITTLE = 0.05


def stands_above(heights: Array) -> bool:
    """Whether heights (h, w) stand above the plane by more than a little, which stops all rays."""
    low, high = float(heights.min()), float(heights.max())
    return high > _LITTLE * (high - low)


@final
class SBTF(NeuMIPMaterial):
    """NeuMIP with silhouettes, on planes and under curved surfaces.

    Opacity is that of a ray; under a footprint wider than a texel the share of its rays that are
    stopped, and the answer is the mean of theirs.

    Attributes:
        thickness: from the surface to the lowest height, tile widths; of a material with holes, to
            its underside.
        sharpest: (concave, convex) curvature, 1/tile width, beyond which heights would reach the
            axis of curvature; infinite where none would. What bends more is answered as these,
            and a warning says so once.
    """

    model: ClassVar[str] = "sbtf"
    has_curvature: ClassVar[bool] = True
    has_drift: ClassVar[bool] = True
    full_sphere: ClassVar[bool] = True

    def __init__(self, spec: NeuMIPSpec, weights: Mapping[str, NDArray[Any]], header: Header):
        if not (spec.heights and spec.curved):
            raise ValueError(
                f"heights = {spec.heights}, curved = {spec.curved}; an sbtf has curved heights"
            )
        super().__init__(spec, weights, header)
        found = self._program.depth
        assert isinstance(found, Heights)
        self._depth = found
        self.thickness = max(-float(found.heights.min()), 0.0) * found.scale
        self.sharpest = bent.sharpest(found)

    @property
    def stands_above(self) -> bool:
        """Whether its heights do; then `under_surface` is what shows outlines."""
        return stands_above(self._depth.heights)

    def under_surface(self) -> tuple[SBTF, float]:
        """The same with its highest point at 0, for a bounding surface, and what was added.

        Rays on curved surfaces begin at 0, so what a measured sample has above the plane of its
        pictures stops them all. On the plane the places that are seen move with the heights: what
        was measured at uv is answered where its ray crosses the new plane.
        """
        heights = np.asarray(self._depth.heights, np.float32)
        top = heights.max()
        weights = {**self.weights, "texture.heights": (heights - top)[..., None]}
        return SBTF(self.spec, weights, self.header), -float(top) * self._depth.scale

    def _answer(self, query: Query) -> tuple[Array, Array | None]:
        rows = self._may_pass(query)
        return softened(query, None, rows, self.header.grid, self._answer_sharp)

    def _answer_along(self, query: Query, drift: Array) -> tuple[Array, Array | None]:
        rows = self._may_pass(query)
        return softened(query, drift, rows, self.header.grid, self._answer_sharp)

    def _answer_lights(
        self, query: Query, drift: Array | None = None
    ) -> tuple[Array, Array | None]:
        rows = self._may_pass(query)
        return softened(query, drift, rows, self.header.grid, self._answer_lights_sharp)

    def _may_pass(self, query: Query) -> NDArray[np.intp]:
        """Rows whose footprint is wider than a texel and of which a part may pass."""
        if query.footprint.strides == (0,) and not query.footprint[:1] > _SHARP:
            return np.zeros(0, np.intp)
        wide = np.flatnonzero(query.footprint > _SHARP)
        if not len(wide) or self.spec.holes:
            return wide
        bend = self._bend(query)
        if bend is None:
            return wide[:0]
        rays = bent.rays_of(self._depth, query.view[wide], bend[wide], self.header.aspect)
        return np.asarray(wide[~rays.reaches], np.intp)

    def _answer_sharp(self, query: Query, drift: Array | None) -> tuple[Array, Array]:
        bend, footprint = self._bend(query), self._footprint(query)
        parts = (query.uv, query.light, query.view, footprint, bend)
        if self._kernel is None:
            answer, found = plain.answer(self._program, *parts, drift)
            opacity = np.ones(len(answer), np.float32) if found is None else found
        else:
            opacity = np.empty(len(query.uv), np.float32)
            answer = self._kernel.evaluate(
                self.flat, self.texels, *parts, opacity=opacity, drift=drift
            )
        return answer.astype(np.float32, copy=False), opacity.astype(np.float32, copy=False)

    def _answer_lights_sharp(self, query: Query, drift: Array | None) -> tuple[Array, Array]:
        assert self._kernel is not None
        bend, opacity = self._bend(query), np.empty(len(query.uv), np.float32)
        parts = (query.uv, query.light, query.view, self._footprint(query), bend)
        answer = self._kernel.evaluate_lights(
            self.flat, self.texels, *parts, opacity=opacity, drift=drift
        )
        return answer, opacity

    def _bend(self, query: Query) -> Array | None:
        """Curvature (b,); None, which the plane's rays take, where there is none."""
        bend = np.ascontiguousarray(query.curvature, np.float32)
        if not len(bend):
            return None
        ends = float(bend.min()), float(bend.max())
        if not any(ends):
            return None
        low, high = self.sharpest
        if ends[0] >= low and ends[1] <= high:
            return bend
        self._warn_of_sharp(ends)
        return np.clip(bend, low, high).astype(np.float32, copy=False)

    def _warn_of_sharp(self, ends: tuple[float, float]) -> None:
        if "sharp" not in self._warned:
            low, high = self.sharpest
            self._warned.add("sharp")
            worst, most = (ends[1], high) if ends[1] > high else (ends[0], low)
            warnings.warn(
                f"a curvature of {worst:g} / tile bends heights to their axis; "
                f"{most:g} / tile is answered there. Use larger tiles on the shape",
                stacklevel=5,
            )
