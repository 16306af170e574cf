"""What both NeuMIP recipes share while they are fitted: data, shapes, flat parameters, state."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import BTF, Wrap
from btfkit.errors import FitError
from btfkit.fitting.loop import Generators, State, Trainable
from btfkit.fitting.neumip.data import Batch, Source, TexelSource
from btfkit.fitting.neumip.rows import source_of
from btfkit.fitting.neumip.settings import Shared, refuse_unused
from btfkit.fitting.prior.pairs import Guesses
from btfkit.footprint import most_levels
from btfkit.materials.base import Header
from btfkit.materials.neumip import arrays as neumip_arrays
from btfkit.materials.neumip import material as evaluated
from btfkit.materials.neumip.spec import NeuMIPSpec
from btfkit.native.neural.layout import Array
from btfkit.queries import QuerySet
from btfkit.settings import parsed

S = TypeVar("S", bound=Shared)


class Recipe(Trainable, ABC, Generic[S]):
    """What both recipes share: data, flat parameters, state, score."""

    material_type: ClassVar[type[evaluated.NeuMIPMaterial]]
    settings_type: type[S]

    def __init__(
        self,
        source: BTF | QuerySet,
        train: NDArray[np.intp],
        test: NDArray[np.intp],
        *,
        settings: Mapping[str, str],
        generators: Generators,
        progress: Any = None,
    ) -> None:
        self.settings = s = parsed(self.settings_type, self.model, settings)
        refuse_unused(s, self.model, settings, pictures=isinstance(source, BTF))
        self._generators, self._data = generators, source
        self._header = self._headed(source)
        size = texture_size(self._header.grid, s.size)
        levels = s.levels or self._levels(source, size)
        self.spec = self._spec(size, min(levels, most_levels(size)))
        self.layout = self.spec.layout(self._header)
        self._guesses: Guesses | None = None
        self._source = self._batches(source, train, test, progress)
        self.masked = self._source.masked
        self._held = self._source.held_out()
        self._pairs = len(train)
        self._begin(generators.numpy)

    def _headed(self, source: BTF | QuerySet) -> Header:
        """What the model will say of itself."""
        return header_of(source, self.settings)

    def _levels(self, source: BTF | QuerySet, size: tuple[int, int]) -> int:
        """Levels of detail where no setting names them."""
        return _levels_for(source, size)

    def _batches(
        self,
        source: BTF | QuerySet,
        train: NDArray[np.intp],
        test: NDArray[np.intp],
        progress: Any,
    ) -> Source:
        """What is drawn from, once the model's shapes are known."""
        levels = self._data_levels()
        found = source_of(
            source, train, test, levels=levels, curved=self.spec.curved,
            seed=self._generators.seed, pool_bytes=self.settings.pool_mb << 20, progress=progress,
        )  # fmt: skip
        if isinstance(source, BTF) and isinstance(found, TexelSource):
            self._guesses = self._guessed(source, train, levels)
            found.guess(self._guesses)
        return found

    @property
    def begun(self) -> bool:
        """Whether textures began from a guess."""
        return self._guesses is not None

    @property
    def source(self) -> Source:
        """Where batches come from."""
        return self._source

    def _guessed(self, btf: BTF, train: NDArray[np.intp], levels: int) -> Guesses | None:
        """What is trained on where no pair is; as published, nothing."""
        del btf, train, levels
        return None

    def _data_levels(self) -> int:
        """Levels of the data's own grid that the model's pyramid reaches to."""
        if self.spec.levels == 1:
            return 1
        finest = math.ceil(self.spec.begins(self._header))
        return min(self.spec.levels + finest, most_levels(self._header.grid))

    @abstractmethod
    def _spec(self, size: tuple[int, int], levels: int) -> NeuMIPSpec:
        """The model's shapes for a finest texture of `size`."""

    @abstractmethod
    def _begin(self, rng: np.random.Generator) -> None:
        """Make weights, texels and their moments for the first step."""

    @abstractmethod
    def _current(self) -> tuple[Array, Array]:
        """Weights and texels as the model would be saved now."""

    @abstractmethod
    def _tensors(self) -> State:
        """Copies of all that the steps change, but the counters."""

    @abstractmethod
    def _put(self, state: Mapping[str, Any]) -> None:
        """Take back what `_tensors` gave."""

    def _answers(self, material: evaluated.NeuMIPMaterial, held: Batch) -> Array:
        """Reflectance (b, c) of a material for the held-out queries."""
        blur = 0.5 if held.footprint is None else held.footprint
        return material.evaluate(held.uv, held.light, held.view, blur).reflectance

    def material(self) -> evaluated.NeuMIPMaterial:
        arrays = neumip_arrays.name_arrays(self.spec, self.layout, *self._current())
        return self.material_type(self.spec, arrays, self._header)

    def score(self) -> float:
        held = self._held
        good = np.isfinite(held.target)
        if not good.any():
            return math.nan
        answer = self._answers(self.material(), held)
        with np.errstate(invalid="ignore"):
            error = np.log1p(np.maximum(held.target, -0.1)) - np.log1p(answer)
        return float(np.square(error[good]).mean())

    def state(self) -> State:
        return self._tensors() | {"numbers": self._counters()}

    def restore(self, state: Mapping[str, Any]) -> None:
        self._put(state)
        self._count_from(state["numbers"])


def header_of(source: BTF | QuerySet, settings: Shared) -> Header:
    """What a material of the data says about itself.

    Raises:
        FitError: queries that do not say the size of the grid, and no setting does.
    """
    if isinstance(source, BTF):
        return Header.of(source)
    if source.size is None:
        if source.footprint is not None:
            raise FitError(
                "these queries have footprints but no size of the grid that they count in",
                remedy="store size = (h, w) in the query file",
            )
        if not settings.size:
            raise FitError(
                "these queries do not say the size of the data's grid",
                remedy="store size = (h, w) in the query file, or --set size=N",
            )
    wrap: Wrap = "wrap" if settings.wrap == "wrap" else "clamp"
    grid = source.size or (settings.size, settings.size)
    return Header(grid=grid, channels=source.channels, wrap=wrap)


def texture_size(grid: tuple[int, int], rows: int) -> tuple[int, int]:
    """(h, w) of textures with `rows` rows; 0 rows: those of the grid."""
    if not rows:
        return grid
    return rows, max(round(rows * grid[1] / grid[0]), 1)


def _levels_for(source: BTF | QuerySet, size: tuple[int, int]) -> int:
    if isinstance(source, BTF):
        return most_levels(size)
    if source.footprint is None:
        return 1
    widest = float(np.nanmax(np.where(np.isfinite(source.footprint), source.footprint, 0.5)))
    return 1 + max(math.ceil(math.log2(max(2 * widest, 1))), 0)
