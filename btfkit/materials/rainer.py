"""The autoencoders of Rainer et al. as they are used: texel codes and a wide decoder, in numpy.

Sources: Rainer, Jakob, Ghosh and Weyrich, "Neural BTF compression and interpolation", Computer
Graphics Forum 38(2), 2019, and Rainer, Ghosh, Jakob and Weyrich, "Unified neural encoding of
BTFs", Computer Graphics Forum 39(2), 2020. Sizes follow the counts of weights that Kuznetsov et
al. 2021 give for both; activations and the domain log(1 + value) are ours.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, final

import numpy as np
from numpy.typing import NDArray

from btfkit.conventions import LEAK, MOST_LOG
from btfkit.materials.base import Array, Header, Material
from btfkit.materials.bilinear import lookup
from btfkit.program import Dense, Head, Program, Texture
from btfkit.queries import Query

WIDTH, HIDDEN = 106, 4
# Samples decoded at once: their hidden layers stay in a core's second-level cache.
_BLOCK = 1 << 11


@final
@dataclass(frozen=True)
class RainerSpec:
    """All that decides the shapes of an autoencoder's decoder and codes.

    Attributes:
        size: (h, w) of the codes. channels: of the answer.
        latents: of a texel.
        whitened: whether each texel has a mean and a deviation that its answers are scaled by.
        width: of the hidden layers.
    """

    size: tuple[int, int]
    channels: int = 3
    latents: int = 8
    whitened: bool = False
    width: int = WIDTH


def decoder_shapes(spec: RainerSpec) -> dict[str, tuple[int, ...]]:
    """Shapes of the decoder's weights: inputs are latents, light x y, view x y."""
    sizes = [spec.latents + 4, *[spec.width] * HIDDEN, spec.channels]
    shapes: dict[str, tuple[int, ...]] = {}
    for layer in range(HIDDEN + 1):
        shapes[f"decoder.{layer}.weight"] = (sizes[layer + 1], sizes[layer])
        shapes[f"decoder.{layer}.bias"] = (sizes[layer + 1],)
    return shapes


class _Rainer(Material):
    """Both autoencoders: they differ in the code of a texel, and in how it was found."""

    spec_type: ClassVar[type] = RainerSpec

    def __init__(
        self, spec: RainerSpec, weights: Mapping[str, NDArray[Any]], header: Header
    ) -> None:
        super().__init__(spec, weights, header)
        self._codes = np.asarray(self.weights["texture"], np.float32)
        self._layers = [
            (
                np.ascontiguousarray(self.weights[f"decoder.{k}.weight"].astype(np.float32).T),
                self.weights[f"decoder.{k}.bias"].astype(np.float32),
            )
            for k in range(HIDDEN + 1)
        ]
        self._whitening = None
        if spec.whitened:
            self._whitening = np.asarray(self.weights["texture.whitening"], np.float32)

    @classmethod
    def shapes(cls, spec: RainerSpec, header: Header) -> dict[str, tuple[int, ...]]:
        found = {"texture": (*spec.size, spec.latents), **decoder_shapes(spec)}
        if spec.whitened:
            found["texture.whitening"] = (*spec.size, 2 * spec.channels)
        return found

    def _answer(self, query: Query) -> tuple[Array, Array | None]:
        out = np.empty((len(query.uv), self.spec.channels), np.float32)
        for start in range(0, len(out), _BLOCK):
            part = Query(*(values[start : start + _BLOCK] for values in query))
            out[start : start + _BLOCK] = self._decoded(part)
        return out, None

    def _decoded(self, query: Query) -> Array:
        wrap = self.header.wrap
        codes = lookup(self._codes, query.uv, wrap)
        x = np.concatenate([codes, query.light[:, :2], query.view[:, :2]], axis=1)
        for layer, (weight, bias) in enumerate(self._layers):
            x = x @ weight
            x += bias
            if layer < HIDDEN:
                x = np.maximum(x, np.float32(LEAK) * x)
        if self._whitening is not None:
            white = lookup(self._whitening, query.uv, wrap)
            c = self.spec.channels
            x = white[:, :c] + white[:, c:] * x
        return np.maximum(np.expm1(np.minimum(x, np.float32(MOST_LOG))), np.float32(0))

    def program(self) -> Program:
        codes, white = Texture("codes", (self._codes,)), self._whitening
        kinds = ("leaky",) * HIDDEN + ("linear",)
        return Program(
            channels=self.header.channels,
            grid=self.header.grid,
            aspect=self.header.aspect,
            wrap=self.header.wrap == "wrap",
            textures=(codes,),
            inputs=(*codes.features, "lx", "ly", "vx", "vy"),
            layers=tuple(
                Dense(weight.T, bias, kind)  # type: ignore[arg-type]
                for (weight, bias), kind in zip(self._layers, kinds, strict=True)
            ),
            heads=(Head("log", self.spec.channels),),
            output="log",
            leveled=False,
            scaling=None if white is None else Texture("scaling", (white,)),
        )


@final
class Rainer19(_Rainer):
    """8 latents a texel, 12 -> 106 x 4 -> 3: 35725 weights for three channels."""

    model: ClassVar[str] = "rainer19"


@final
class Rainer20(_Rainer):
    """32 latents and a whitening a texel, 36 -> 106 x 4 -> 3: 38269 weights for three channels."""

    model: ClassVar[str] = "rainer20"
