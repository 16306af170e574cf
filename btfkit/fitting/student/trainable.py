"""A student while it is fitted: NeuMIP's march and frames, two small layers, a teacher's answers.

Source: Hinton, Vinyals and Dean, "Distilling the knowledge in a neural network", 2015, for the
idea; the teacher's textures are taken over where they are of the student's kind.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar, final

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import BTF
from btfkit.conventions import LEAK
from btfkit.errors import FitError
from btfkit.fitting.loop import Generators
from btfkit.fitting.neumip.data import Source
from btfkit.fitting.neumip.engines.base import Step
from btfkit.fitting.neumip.settings import INPUTS
from btfkit.fitting.neumip.trainable import Marching
from btfkit.fitting.student.lessons import Lessons, pairs_of
from btfkit.fitting.student.settings import Settings
from btfkit.footprint import FINEST, blur_of, gaussian, most_levels
from btfkit.materials import PROGRAMS
from btfkit.materials.base import Header, Material
from btfkit.materials.neumip import material as evaluated
from btfkit.materials.neumip.spec import NeuMIPSpec
from btfkit.native.neural.lookup import resized
from btfkit.program import Heights, Program
from btfkit.queries import QuerySet

_LAYERS = 2
# Of the texture of the depth network: a height and its slopes, twice; the footprint of the second.
_DEPTH_CHANNELS, _LARGE = 6, 2.0


@final
class Student(Marching[Settings]):
    """A NeuMIP for phones and games.

    Args:
        teacher: whose answers it learns; None learns from the data, as `neumip` does.
    """

    model: ClassVar[str] = "student"
    material_type: ClassVar[type[evaluated.NeuMIPMaterial]] = evaluated.Student
    settings_type = Settings

    def __init__(
        self,
        source: BTF | QuerySet,
        train: NDArray[np.intp],
        test: NDArray[np.intp],
        *,
        settings: Mapping[str, str],
        generators: Generators,
        progress: Any = None,
        teacher: Material | None = None,
    ) -> None:
        self._teacher = teacher
        self._program = None
        if teacher is not None and teacher.model in PROGRAMS:
            self._program = teacher.program()
        self._taken = False
        super().__init__(
            source, train, test, settings=settings, generators=generators, progress=progress
        )

    def _headed(self, source: BTF | QuerySet) -> Header:
        own, teacher = super()._headed(source), self._teacher
        if teacher is None:
            return own
        has, needs = teacher.header, own
        if (has.grid, has.channels) != (needs.grid, needs.channels):
            raise FitError(
                f"the teacher has a grid {has.grid} and channels {', '.join(has.channels)}, the "
                f"data {needs.grid} and {', '.join(needs.channels)}",
                remedy="name the data that it was fitted to, or none",
            )
        return has

    def _levels(self, source: BTF | QuerySet, size: tuple[int, int]) -> int:
        if self._teacher is None:
            return super()._levels(source, size)
        if self._program is None:
            return most_levels(size) if self._teacher.has_levels else 1
        levels = self._program.textures[0].levels
        if levels[0].shape[:2] == size:
            return len(levels)
        return most_levels(size) if self._program.leveled else 1

    def _batches(
        self,
        source: BTF | QuerySet,
        train: NDArray[np.intp],
        test: NDArray[np.intp],
        progress: Any,
    ) -> Source:
        if self._teacher is None:
            return super()._batches(source, train, test, progress)
        return Lessons(
            self._teacher,
            levels=self._data_levels(),
            seed=self._generators.seed,
            pairs=pairs_of(source, train),
        )

    def _spec(self, size: tuple[int, int], levels: int) -> NeuMIPSpec:
        s = self.settings
        return NeuMIPSpec(
            size,
            levels,
            features=s.features,
            coarse=s.coarse,
            offset=_DEPTH_CHANNELS,
            offset_hidden=(s.depth_width,),
            offset_activation="leaky",
            frames=min(s.frames, s.features // 3),
            hidden=(s.width,) * _LAYERS,
            activation=s.activation,  # type: ignore[arg-type]
            directions=INPUTS[s.inputs],
            output=s.output,  # type: ignore[arg-type]
            channels=len(self._header.channels),
            precision=s.precision,  # type: ignore[arg-type]
            networks=s.networks,  # type: ignore[arg-type]
        )

    def _begin(self, rng: np.random.Generator) -> None:
        super()._begin(rng)
        if self._program is not None:
            self._taken = self._take_over(self._program)

    def _take_over(self, program: Program) -> bool:
        """Take the teacher's heights and features where they are of the student's shape."""
        weights, texels = self.engine.parameters()
        depth, texture = program.depth, program.textures[0]
        first, *banks = self.layout.textures(texels)
        taken = False
        if isinstance(depth, Heights):
            unit = np.float32(depth.scale / self.layout.depth_scale)
            heights = _resized(depth.heights, self.spec.size, wrap=self.layout.wrap) * unit
            first[0][..., :_DEPTH_CHANNELS] = self._relief(heights)
            self._pass_heights(weights)
            taken = True
        k = self.spec.features
        same = [level.shape for level in texture.levels] == [(*x.shape[:2], k) for x in banks[0]]
        if same and program.frames == self.spec.frames:
            for level, given in zip(banks[0], texture.levels, strict=True):
                level[..., :k] = given
            taken = True
        return taken

    def _relief(self, heights: NDArray[Any]) -> NDArray[Any]:
        """(h, w, 6) heights and how they change along u and v, as they are and in the large."""
        found = []
        for blur in (FINEST, _LARGE):
            matrices = (gaussian(n, blur_of(blur), wrap=self.layout.wrap) for n in heights.shape)
            down, across = matrices
            soft = down @ heights @ across.T
            slopes = [np.gradient(soft, axis=axis) for axis in (1, 0)]
            # Of a like size: what the layer takes is to begin alike.
            scale = np.std(heights) / max(*(np.std(slope) for slope in slopes), 1e-6)
            found += [soft, *(slope * scale for slope in slopes)]
        return np.stack(found, axis=-1)

    def _pass_heights(self, weights: NDArray[Any]) -> None:
        """The depth network as one that answers the height itself, whatever the view."""
        assert self.layout.offset is not None
        network = self.layout.offset[1]
        (first, bias), (last, rest) = network.layers(self.layout.split(weights)[0])
        bias[:], rest[:] = 0, 0
        last[:] *= 0.1
        first[:2] = 0
        first[0, 0], first[1, 0] = 1, -1
        # The difference of two leaky rectifiers is straight.
        last[0, :2] = np.array([1, -1]) / (1 + LEAK)

    def plan(self, progress: float, count: int) -> Step:
        step = super().plan(progress, count)
        # What the teacher found of the relief is not to be blurred away.
        return replace(step, blur=0.0) if self._taken else step

    def untrained(self) -> tuple[str, ...]:
        teacher = self._teacher
        if teacher is None or not teacher.has_curvature:
            return ()
        return (f"curvature: a student answers on the plane; its teacher, {teacher.model}, bends",)


def _resized(heights: NDArray[Any], size: tuple[int, ...], *, wrap: bool) -> NDArray[Any]:
    """Heights (h, w) at the texel centres of another size, blurred to its texels first."""
    # A texel of the new size is `ratio` of the old ones: a footprint of ratio / 2.
    ratios = (old / new for old, new in zip(heights.shape, size, strict=True))
    down, across = (
        gaussian(old, blur_of(max(0.5 * ratio, 0.5)), wrap=wrap)
        for old, ratio in zip(heights.shape, ratios, strict=True)
    )
    return resized(down @ heights @ across.T, size, wrap=wrap)
