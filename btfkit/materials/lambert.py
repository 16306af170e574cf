"""Lambert's law with a texture of albedo: the least that a material can be."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, final

import numpy as np
from numpy.typing import NDArray

from btfkit.materials.base import Array, Header, Material
from btfkit.materials.bilinear import lookup
from btfkit.program import Head, Program, Texture
from btfkit.queries import Query


@final
@dataclass(frozen=True)
class LambertSpec:
    """All that decides the shapes: size (h, w) of the albedo, channels of the answer."""

    size: tuple[int, int]
    channels: int = 3


@final
class Lambert(Material):
    """albedo(u, v) x cosine of the light."""

    model: ClassVar[str] = "lambert"
    spec_type: ClassVar[type] = LambertSpec

    def __init__(
        self, spec: LambertSpec, weights: Mapping[str, NDArray[Any]], header: Header
    ) -> None:
        super().__init__(spec, weights, header)
        self._albedo = np.asarray(self.weights["texture"], np.float32)

    @classmethod
    def shapes(cls, spec: LambertSpec, header: Header) -> dict[str, tuple[int, ...]]:
        return {"texture": (*spec.size, spec.channels)}

    def _answer(self, query: Query) -> tuple[Array, Array | None]:
        return lookup(self._albedo, query.uv, self.header.wrap) * query.light[:, 2:], None

    def program(self) -> Program:
        albedo = Texture("albedo", (self._albedo,))
        return Program(
            channels=self.header.channels,
            grid=self.header.grid,
            aspect=self.header.aspect,
            wrap=self.header.wrap == "wrap",
            textures=(albedo,),
            inputs=albedo.features,
            layers=(),
            heads=(Head("linear", self.spec.channels),),
            output="cosine",
            leveled=False,
        )
