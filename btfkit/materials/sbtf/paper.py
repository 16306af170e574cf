"""SBTF as published: opacity, offset and colour, a texture and a small network each.

Source: Kuznetsov et al., "Rendering Neural Materials on Curved Surfaces", 2022, section 4. What
the paper leaves open, and what is taken here: docs/sbtf.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar, Literal, final

import numpy as np
from numpy.typing import NDArray

from btfkit.materials.base import Array, Header, Material
from btfkit.native.neural import plain
from btfkit.program import Cover, Dense, Head, OffsetNetwork, Program, Texture
from btfkit.queries import Query

MODULES = ("opacity", "offset", "colour")
_VIEW, _LIGHT = ("vx", "vy", "vz"), ("lx", "ly", "lz")


@final
@dataclass(frozen=True)
class SBTFPaperSpec:
    """All that decides the shapes.

    Attributes:
        size: (h, w) of each texture.
        features: channels of each texture.
        hidden: widths of the hidden layers of each network.
        opacity: "cosine" the cosine of the view at which rays begin to pass; "direct" the opacity.
        offset_curvature: whether the offset network takes the curvature: equation 6 leaves it out,
            the list of modules and figure 4 have it.
        channels: of the answer.
        precision: of the stored textures.
    """

    size: tuple[int, int]
    features: int = 7
    hidden: tuple[int, ...] = (24, 24, 24)
    opacity: Literal["cosine", "direct"] = "cosine"
    offset_curvature: bool = True
    channels: int = 3
    precision: Literal["float32", "float16"] = "float16"

    def inputs(self, module: str) -> tuple[str, ...]:
        """What a module's network takes after its features."""
        if module == "colour":
            return (*_LIGHT, *_VIEW, "curvature")
        told = module == "opacity" or self.offset_curvature
        return (*_VIEW, "curvature") if told else _VIEW

    def widths(self, module: str) -> tuple[int, ...]:
        """Inputs, hidden layers and outputs of a module's network."""
        outputs = {"opacity": 1, "offset": 2, "colour": self.channels}[module]
        return (self.features + len(self.inputs(module)), *self.hidden, outputs)


@final
class SBTFPaper(Material):
    """The published model: what `sbtf` is compared with. Its evaluation is that of its program."""

    model: ClassVar[str] = "sbtf-paper"
    spec_type: ClassVar[type] = SBTFPaperSpec
    has_curvature: ClassVar[bool] = True
    full_sphere: ClassVar[bool] = True

    def __init__(self, spec: SBTFPaperSpec, weights: Mapping[str, NDArray[Any]], header: Header):
        super().__init__(spec, weights, header)
        self._program = self._as_program()

    @classmethod
    def shapes(cls, spec: SBTFPaperSpec, header: Header) -> dict[str, tuple[int, ...]]:
        found: dict[str, tuple[int, ...]] = {}
        for module in MODULES:
            found[f"texture.{module}"] = (*spec.size, spec.features)
            widths = spec.widths(module)
            for k, (a, b) in enumerate(pairwise(widths)):
                found[f"{module}.{k}.weight"] = (b, a)
                found[f"{module}.{k}.bias"] = (b,)
        return found

    def program(self) -> Program:
        return self._program

    def _answer(self, query: Query) -> tuple[Array, Array | None]:
        parts = (query.uv, query.light, query.view, None, query.curvature)
        return plain.answer(self._program, *parts)

    def _as_program(self) -> Program:
        spec, header = self.spec, self.header
        opacity, offset, colour = (
            Texture(module, (self._wide(f"texture.{module}"),), view=float(module == "colour"))
            for module in MODULES
        )
        inputs = [
            (*texture.features, *spec.inputs(texture.name)) for texture in (opacity, offset, colour)
        ]
        return Program(
            channels=header.channels,
            grid=header.grid,
            aspect=header.aspect,
            wrap=header.wrap == "wrap",
            textures=(colour,),
            inputs=inputs[2],
            layers=self._layers("colour"),
            heads=(Head("linear", spec.channels),),
            output="linear",
            depth=OffsetNetwork(offset, inputs[1], self._layers("offset")),
            cover=Cover(spec.opacity, opacity, inputs[0], self._layers("opacity")),
            leveled=False,
            full_sphere=True,
        )

    def _layers(self, module: str) -> tuple[Dense, ...]:
        last = len(self.spec.hidden)
        return tuple(
            Dense(
                self._wide(f"{module}.{k}.weight"),
                self._wide(f"{module}.{k}.bias"),
                "relu" if k < last else "linear",
            )
            for k in range(last + 1)
        )

    def _wide(self, name: str) -> Array:
        return np.asarray(self.weights[name], np.float32)
