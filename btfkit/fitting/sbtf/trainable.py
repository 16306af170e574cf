"""SBTF while it is fitted: heights from the parallax of views, or those of a known relief.

Source: Kuznetsov et al., "Rendering Neural Materials on Curved Surfaces", 2022; what is learnt
there of opacity and offset is geometry here, docs/sbtf.md has the comparison.
"""

from __future__ import annotations

from typing import ClassVar, final

import numpy as np

from btfkit.btf import BTF
from btfkit.errors import FitError
from btfkit.fitting.neumip.settings import INPUTS
from btfkit.fitting.neumip.trainable import Marching
from btfkit.fitting.sbtf.outlines import moved
from btfkit.fitting.sbtf.settings import Settings
from btfkit.materials.neumip import material as evaluated
from btfkit.materials.neumip.spec import NeuMIPSpec
from btfkit.materials.sbtf import material as sbtf
from btfkit.native.neural.layout import Array
from btfkit.native.neural.lookup import bilinear
from btfkit.program import Heights
from btfkit.relief.relief import Relief

# Steps between looks at outlines, and rows of a look.
_OUTLINE_STEPS, _OUTLINE_ROWS = 4, 2048


@final
class SBTF(Marching[Settings]):
    """NeuMIP whose rays are bent; queries with curvature teach it colours on curved surfaces."""

    model: ClassVar[str] = "sbtf"
    material_type: ClassVar[type[evaluated.NeuMIPMaterial]] = sbtf.SBTF
    settings_type = Settings
    _given: Array | None = None

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
            hidden=(s.width,) * 3,
            activation=s.activation,  # type: ignore[arg-type]
            directions=(*INPUTS[s.inputs], *told),
            output=s.output,  # type: ignore[arg-type]
            channels=len(self._header.channels),
            precision=s.precision,  # type: ignore[arg-type]
            networks=s.networks,  # type: ignore[arg-type]
        )

    def know(self, relief: Relief) -> None:
        """Take the heights of the relief behind the data, its top at 0."""
        if self.settings.heights == "found":
            return
        height = relief.under_surface()[0].height / np.float32(self.spec.depth_scale)
        h, w = self.spec.size
        if (h, w) != relief.size:
            u, v = np.meshgrid((np.arange(w) + 0.5) / w, (np.arange(h) + 0.5) / h)
            at = np.stack([u, v], axis=-1).reshape(-1, 2)
            height = bilinear(height[..., None], at, wrap=relief.wrap == "wrap").reshape(h, w)
        self._given = height.astype(np.float32)
        self._keep_given()

    def step(self, progress: float) -> float:
        if self._given is None and self.settings.heights == "given":
            raise FitError(
                "heights=given, and the source is no relief",
                remedy="leave heights out, and they are found",
            )
        loss = super().step(progress)
        self._keep_given()
        if self._outlined and self._given is None and self._steps % _OUTLINE_STEPS == 0:
            self._heed_outlines(progress)
        return loss

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
        surface = self.layout.surface(texels)
        found = Heights(surface, self.layout.depth_scale, curved=True)
        passes = np.asarray(np.isnan(batch.target[rows]).all(axis=1))
        surface += moved(
            found, batch.uv[rows], batch.view[rows], batch.curvature[rows], passes,
            aspect=self.layout.aspect, wrap=self.layout.wrap,
        )  # fmt: skip

    def _keep_given(self) -> None:
        if self._given is not None:
            _, texels = self.engine.parameters()
            self.layout.surface(texels)[...] = self._given
