"""What every fitted model is when it is used: a spec, weights, and answers to queries."""

from __future__ import annotations

import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from btfkit import queries
from btfkit.btf import BTF, QUANTITY, RGB, Wrap
from btfkit.native.prepare import Prepared, prepare
from btfkit.queries import Query, Response

Array = NDArray[np.float32]
# Queries are answered in blocks, so that a picture of any size needs bounded memory.
_BLOCK = 1 << 18


@final
@dataclass(frozen=True)
class Header:
    """What a material carries beside its weights.

    Attributes:
        grid: (h, w) of the data's grid, in which footprints count.
        channels: one name a channel.
        wrap: "wrap" where the material tiles, "clamp" where it does not.
        texel_mm: edge of a texel of the data's grid, None where unknown.
        licence: that of the data; None where not stated.
        provenance: source, settings, versions; JSON types only.
        steps: training steps that led here.
        quantity: what the answers are.
    """

    grid: tuple[int, int]
    channels: tuple[str, ...] = RGB
    wrap: Wrap = "wrap"
    texel_mm: float | None = None
    licence: str | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)
    steps: int = 0
    quantity: str = QUANTITY

    def __post_init__(self) -> None:
        if len(self.grid) != 2 or not all(isinstance(n, int) and n > 0 for n in self.grid):
            raise ValueError(f"grid = {self.grid}; expected (h, w), both positive")
        if not self.channels or not all(isinstance(name, str) for name in self.channels):
            raise ValueError(f"channels = {self.channels}; expected one name a channel")
        if self.wrap not in ("wrap", "clamp"):
            raise ValueError(f"wrap = {self.wrap!r}; expected 'wrap' or 'clamp'")

    @staticmethod
    def of(btf: BTF) -> Header:
        """What a material of a BTF says about itself."""
        return Header(
            grid=btf.shape[1:3],
            channels=btf.channels,
            wrap=btf.wrap,
            texel_mm=btf.texel_mm,
            licence=btf.licence,
            provenance=dict(btf.provenance),
        )

    @property
    def aspect(self) -> float:
        """Tile width / tile height."""
        return self.grid[1] / self.grid[0]


class Material(ABC):
    """Answers queries with reflectance and opacity. Immutable; safe to share among threads.

    A model overrides `shapes` and `_answer`, and says by class attributes what it can do.

    Attributes:
        model: the name in `MODELS`; spec_type: its frozen dataclass.
        spec: what decides the shapes.
        weights: arrays by name, as `shapes` lists them.
        header: what the answers mean and where the material comes from.
    """

    model: ClassVar[str]
    spec_type: ClassVar[type]
    has_levels: ClassVar[bool] = False
    has_curvature: ClassVar[bool] = False
    full_sphere: ClassVar[bool] = False

    def __init__(self, spec: Any, weights: Mapping[str, NDArray[Any]], header: Header) -> None:
        expected = self.shapes(spec, header)
        found = {name: tuple(array.shape) for name, array in weights.items()}
        if found != expected:
            wrong = sorted(
                f"{name}: {found.get(name, 'missing')} for {expected.get(name, 'nothing')}"
                for name in found.keys() | expected.keys()
                if found.get(name) != expected.get(name)
            )
            raise ValueError(f"weights do not fit the spec of {self.model}: {'; '.join(wrong)}")
        self.spec = spec
        self.weights = dict(weights)
        self.header = header
        self._warned: set[str] = set()

    @classmethod
    @abstractmethod
    def shapes(cls, spec: Any, header: Header) -> dict[str, tuple[int, ...]]:
        """Shape of every array of weights for a spec."""

    @abstractmethod
    def _answer(self, query: Query) -> tuple[Array, Array | None]:
        """Reflectance (b, c) and opacity (b,), None for opaque, of a flat query.

        uv is reduced to the tile or clamped to it, 0..1; every value is finite, view is above
        the horizon, and light too unless the model answers for the full sphere. Where one
        footprint or curvature holds for all, its stride is 0.
        """

    def _answer_lights(
        self, uv: ArrayLike, light: ArrayLike, view: ArrayLike, footprint: ArrayLike
    ) -> Array | None:
        """Reflectance (m, ..., c) where views of (...) share m lights of (m, 1, ..., 3).

        What a model that keeps what does not depend on the light answers faster than query by
        query; None where it does not, or where the queries have to be looked at one by one.
        """
        del uv, light, view, footprint
        return None

    @final
    def evaluate(
        self,
        uv: ArrayLike,
        light: ArrayLike,
        view: ArrayLike,
        footprint: ArrayLike = 0.5,
        curvature: ArrayLike = 0.0,
    ) -> Response:
        """Reflectance and opacity; shapes broadcast.

        Args:
            uv: (..., 2) u in tile widths along +x, v in tile heights down the rows.
            light, view: (..., 3) directions away from the surface; normalised here.
            footprint: (...) standard deviation of the Gaussian kernel, texels of the grid.
            curvature: (...) along the projected view ray, 1/tile width, positive convex.

        Returns:
            reflectance (..., c) and opacity (...). Queries that are not finite or seen from
            below the horizon answer 0 with opacity 0, and a warning counts them. Flat models
            answer 0 with opacity 1 for lights below the horizon.

        Raises:
            ValueError: wrong last axes, or shapes that do not broadcast.
        """
        if queries.share_lights(uv, light, view, footprint) and not np.any(curvature):
            rgb = self._answer_lights(uv, light, view, footprint)
            if rgb is not None:
                return Response(rgb, np.ones(rgb.shape[:-1], np.float32))
        query, shape = queries.flatten(uv, light, view, footprint, curvature)
        b, c = math.prod(shape), len(self.header.channels)
        rgb, opacity = np.empty((b, c), np.float32), np.empty(b, np.float32)
        masked = 0
        for start in range(0, b, _BLOCK):
            some = slice(start, start + _BLOCK)
            block = Query(*(part if len(part) == 1 else part[some] for part in query))
            masked += self._answer_block(block, rgb[some], opacity[some])
        if masked:
            warnings.warn(
                f"{masked} of {b} queries are not finite or seen from below the "
                "horizon; they answer 0 with opacity 0",
                stacklevel=2,
            )
        return Response(rgb.reshape(*shape, c), opacity.reshape(shape))

    def _answer_block(self, query: Query, rgb: Array, opacity: Array) -> int:
        """Answer one block into `rgb` and `opacity`; returns how many are masked."""
        ready = prepare(*query, opacity, wrap=self.header.wrap == "wrap", below=self.full_sphere)
        self._warn_of_missing_parts(ready)
        m = len(ready.uv)
        if ready.rows is not None:
            rgb[:] = 0
        if not m:
            return ready.masked
        blur, bend = (np.broadcast_to(part, m) for part in (ready.footprint, ready.curvature))
        values, cover = self._answer(Query(ready.uv, ready.light, ready.view, blur, bend))
        rows = slice(None) if ready.rows is None else ready.rows
        if cover is not None:
            opacity[rows] = cover
            values = np.where(cover[:, None] > 0, values, 0.0)
        rgb[rows] = values
        return ready.masked

    def _warn_of_missing_parts(self, ready: Prepared) -> None:
        for part, has, asked in (
            ("footprint", self.has_levels, ready.blurred),
            ("curvature", self.has_curvature, ready.curved),
        ):
            if asked and not has and part not in self._warned:
                self._warned.add(part)
                what = "at its finest level" if part == "footprint" else "on the plane"
                warnings.warn(f"{self.model} knows no {part}: it answers {what}", stacklevel=4)
