"""SBTF while it is fitted: heights from the parallax of views, or those of a known relief.

Source: Kuznetsov et al., "Rendering Neural Materials on Curved Surfaces", 2022; what is learnt
there of opacity and offset is geometry here, docs/sbtf.md has the comparison.
"""

from __future__ import annotations

from typing import Any, ClassVar, final

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import BTF
from btfkit.errors import FitError
from btfkit.fitting.loop import Trainable
from btfkit.fitting.neumip.data import Source
from btfkit.fitting.neumip.settings import INPUTS
from btfkit.fitting.neumip.trainable import Marching
from btfkit.fitting.sbtf import holes
from btfkit.fitting.sbtf.outlines import carved, moved
from btfkit.fitting.sbtf.settings import Settings
from btfkit.materials.neumip import material as evaluated
from btfkit.materials.neumip.spec import NeuMIPSpec
from btfkit.materials.sbtf import material as sbtf
from btfkit.native.neural.layout import Array
from btfkit.native.neural.lookup import resized
from btfkit.program import Heights
from btfkit.queries import QuerySet
from btfkit.relief.relief import Relief

# Steps between looks at outlines, and rows of a look; steps between looks at the thickness.
_OUTLINE_STEPS, _OUTLINE_ROWS, _THICKNESS_STEPS = 4, 2048, 100


@final
class SBTF(Marching[Settings]):
    """NeuMIP whose rays are bent; queries with curvature teach it colours on curved surfaces."""

    model: ClassVar[str] = "sbtf"
    material_type: ClassVar[type[evaluated.NeuMIPMaterial]] = sbtf.SBTF
    settings_type = Settings
    _given: Array | None = None
    _opacity: Array | None = None
    _thickness: float = 0.0
    # Valid rows of queries that are trained on.
    _known: QuerySet | None = None

    def _spec(self, size: tuple[int, int], levels: int) -> NeuMIPSpec:
        s, source = self.settings, self._data
        bend = None if isinstance(source, BTF) else source.curvature
        told = ("curvature",) if s.curvature and bend is not None and bend.any() else ()
        return NeuMIPSpec(
            size,
            levels,
            features=s.features,
            coarse=s.coarse,
            offset=0,
            frames=min(s.frames, s.features // 3),
            heights=True,
            curved=True,
            holes=self._has_holes(),
            looks=s.looks,
            hidden=(s.width,) * 3,
            activation=s.activation,  # type: ignore[arg-type]
            directions=(*INPUTS[s.inputs], *told),
            output=s.output,  # type: ignore[arg-type]
            channels=len(self._header.channels),
            precision=s.precision,  # type: ignore[arg-type]
            networks=s.networks,  # type: ignore[arg-type]
        )

    def _has_holes(self) -> bool:
        if self.settings.holes != "auto":
            known = isinstance(self._data, QuerySet) and self._data.opacity is not None
            if self.settings.holes == "true" and not known:
                raise FitError(
                    "holes=true, and the data say nothing of opacity",
                    remedy="fit a relief or queries with opacity",
                )
            return self.settings.holes == "true"
        return isinstance(self._data, QuerySet) and holes.seen_through(self._data)

    def _batches(
        self,
        source: BTF | QuerySet,
        train: NDArray[np.intp],
        test: NDArray[np.intp],
        progress: Any,
    ) -> Source:
        if isinstance(source, QuerySet):
            rows = source.subset(train)
            self._known = rows.subset(rows.valid())
        return super()._batches(source, train, test, progress)

    def _begin(self, rng: np.random.Generator) -> None:
        super()._begin(rng)
        if self.spec.holes:
            assert self._known is not None
            self._opacity = holes.opacity_of(self._known, self.spec.size, wrap=self.layout.wrap)
            self._look_for_thickness()
            self._keep_given()

    def _begin_carved(self) -> None:
        """Begin with the heights that outlines tell, where no relief does."""
        if self._known is None or not self._outlined or self._given is not None:
            return
        layout = self.layout
        heights = carved(
            self._known, self.spec.size, scale=layout.depth_scale, aspect=layout.aspect,
            wrap=layout.wrap, opacity=self._opacity, seed=self._generators.seed,
        )  # fmt: skip
        if heights is None:
            return
        _, texels = self.engine.parameters()
        layout.surface(texels)[...] = heights
        if self.spec.holes:
            self._look_for_thickness()
            self._keep_given()

    def know(self, relief: Relief) -> None:
        """Take the heights, and the holes, of the relief behind the data; of queries, top at 0."""
        if self.settings.heights == "found":
            return
        wrap = relief.wrap == "wrap"
        # A BTF's plane is where it was measured; what is traced lies under its highest point.
        measured = isinstance(self._data, BTF)
        under = relief if measured else relief.under_surface()[0]
        height = under.height / np.float32(self.spec.depth_scale)
        self._given = resized(height, self.spec.size, wrap=wrap).astype(np.float32)
        if self.spec.holes and relief.opacity is not None:
            opacity = resized(relief.opacity, self.spec.size, wrap=wrap)
            self._opacity = opacity.astype(np.float32)
            self._thickness = self.settings.thickness / self.spec.depth_scale
            self._thickness = self._thickness or -float(self._given.min())
        self._keep_given()

    def step(self, progress: float) -> float:
        if self._given is None and self.settings.heights == "given":
            raise FitError(
                "heights=given, and the source is no relief",
                remedy="leave heights out, and they are found",
            )
        if not self._steps:
            self._begin_carved()
        loss = super().step(progress)
        if self.spec.holes and self._given is None and self._steps % _THICKNESS_STEPS == 0:
            self._look_for_thickness()
        self._keep_given()
        if self._outlined and self._given is None and self._steps % _OUTLINE_STEPS == 0:
            self._heed_outlines(progress)
        return loss

    def on_device(self, device: str) -> Trainable | None:
        source = self._data
        bend = None if isinstance(source, BTF) else source.curvature
        # Rays that curvature bends, or that pass holes, are marched by the CPU alone.
        if self.spec.holes or (bend is not None and bend.any()):
            return None
        return self._moved_to(device)

    def untrained(self) -> tuple[str, ...]:
        source = self._data
        if not isinstance(source, BTF) and source.curvature is not None and source.curvature.any():
            return ()
        given = "light, parallax and shadows" if isinstance(source, BTF) else "a known relief"
        heights = given if self._given is not None else "the parallax of its views"
        return (
            "curved surfaces: nothing was measured there; outlines and displaced places are those "
            f"of heights from {heights}, colours those of the plane where a ray ends"
            + self._above(),
        )

    def _above(self) -> str:
        """What is said of heights above the plane of a BTF."""
        if not isinstance(self._data, BTF):
            return ""
        found = self.layout.surface(self.engine.parameters()[1]) * self.spec.depth_scale
        if not sbtf.stands_above(found):
            return ""
        return (
            f"; heights lie {found.min():.3g} to {found.max():.3g} tile widths from the plane of "
            "the pictures, and stop all rays where they are above it: render moves them under it "
            "on shapes, SBTF.under_surface() in Python"
        )

    @property
    def _outlined(self) -> bool:
        """Whether the data say which rays pass."""
        source = self._data
        known = not isinstance(source, BTF) and source.opacity is not None
        return known and self.settings.outlines

    def _heed_outlines(self, progress: float) -> None:
        """Move heights towards the opacity of some rows of the last batch."""
        batch = self._source.batch(self._steps - 1, self._batch_size(progress))
        if batch.curvature is None:
            return
        rows = np.flatnonzero(batch.curvature > 0)[:_OUTLINE_ROWS]
        _, texels = self.engine.parameters()
        found = Heights(self.layout.surface(texels), self.layout.depth_scale, curved=True)
        passes = np.asarray(np.isnan(batch.target[rows]).all(axis=1))
        if self._opacity is not None:
            # What passes through a hole says nothing of heights.
            solid = holes.solid_at(self._opacity, batch.uv[rows], wrap=self.layout.wrap)
            rows, passes = rows[solid], passes[solid]
        step = moved(
            found, batch.uv[rows], batch.view[rows], batch.curvature[rows], passes,
            aspect=self.layout.aspect, wrap=self.layout.wrap,
        )  # fmt: skip

        def move(_: Array, texels: Array) -> None:
            surface = self.layout.surface(texels)
            surface += step

        self.engine.change(move)

    def _look_for_thickness(self) -> None:
        """How far the sheet reaches down, from the heights as they are and the rays that pass."""
        assert self._opacity is not None
        assert self._known is not None
        scale = self.layout.depth_scale
        if self.settings.thickness:
            self._thickness = self.settings.thickness / scale
            return
        _, texels = self.engine.parameters()
        self._thickness = holes.thickness_of(
            self.layout.surface(texels), self._opacity, self._known,
            scale=scale, aspect=self.layout.aspect, wrap=self.layout.wrap,
        )  # fmt: skip

    def _keep_given(self) -> None:
        def keep(_: Array, texels: Array) -> None:
            surface = self.layout.surface(texels)
            if self._given is not None:
                surface[...] = self._given
            if self._opacity is not None:
                surface[...] = holes.with_holes(surface, self._opacity, self._thickness)
                self.layout.cover(texels)[...] = self._opacity

        if self._given is not None or self._opacity is not None:
            self.engine.change(keep)
