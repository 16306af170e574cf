"""What a NeuMIP model looks like to its kernels.

A model is two flat float32 arrays. `weights` holds the networks, layer by layer: (out, in)
row-major, then the (out,) biases; the offset network first. `texels` (t, 8) holds all textures
one after the other, row-major; a texture uses the first of the eight numbers of a texel. Heights
lie before all textures, eight of them in the room of one texel, and after them in the same way
the opacity of heights that have holes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, final

import numpy as np
from numpy.typing import NDArray

from btfkit.conventions import CURVED_LOOKS
from btfkit.program import (
    Activation,
    Dense,
    DepthNetwork,
    Head,
    Heights,
    Program,
    Texture,
    frame_products,
)

Array = NDArray[np.float32]
Output = Literal["log", "relu", "mask"]
Networks = Literal["float32", "bfloat16"]

CHANNELS = 8  # numbers a texel


@final
@dataclass(frozen=True)
class Pyramid:
    """Textures of one kind, finest first, read together by level.

    Attributes:
        sizes: (h, w) of each level.
        channels: numbers used of a texel, 1 to 8.
        view, light: the lookup lies at uv + depth * (view * H(view) - light * H(light)).
        shift: level of the data, log2(2 * footprint), at which the finest texture is right.
        name: in the program; its place where it has none.
    """

    sizes: tuple[tuple[int, int], ...]
    channels: int
    view: float = 1.0
    light: float = 0.0
    shift: float = 0.0
    name: str = ""

    @property
    def texels(self) -> int:
        return sum(h * w for h, w in self.sizes)


@final
@dataclass(frozen=True)
class Network:
    """A small dense network.

    Attributes:
        widths: inputs (features, then directions), hidden layers, outputs.
        directions: which of `conventions.KERNEL_INPUTS` follow the features.
        activation: after every layer but the last.
    """

    widths: tuple[int, ...]
    directions: tuple[str, ...]
    activation: Activation = "relu"

    @property
    def size(self) -> int:
        return sum((a + 1) * b for a, b in zip(self.widths, self.widths[1:], strict=False))

    def layers(self, flat: NDArray[Any]) -> list[tuple[NDArray[Any], NDArray[Any]]]:
        """(out, in) matrix and (out,) bias of each layer, as views of its flat weights."""
        found, at = [], 0
        for a, b in zip(self.widths, self.widths[1:], strict=False):
            matrix = flat[at : at + a * b].reshape(b, a)
            at += (a + 1) * b
            found.append((matrix, flat[at - b : at]))
        return found

    def dense(self, flat: NDArray[Any]) -> tuple[Dense, ...]:
        """The layers as a program has them, views of the flat weights."""
        layers = self.layers(flat)
        kinds = (self.activation,) * (len(layers) - 1) + ("linear",)
        return tuple(Dense(*layer, kind) for layer, kind in zip(layers, kinds, strict=True))


@final
@dataclass(frozen=True)
class Layout:
    """All that decides a model's shape and how it is read.

    Attributes:
        decoder: features and directions to log(1 + rgb).
        banks: pyramids whose features, one after the other, the decoder takes.
        offset: the texture and network of the ray depth; None without them.
        heights: (h, w) of a texture of heights, whose first crossing with the view ray gives the
            ray depth in place of the network; None without it.
        curved: whether curvature bends the rays through the heights, which may then pass them.
        holes: whether curved heights have an opacity, as `program.Heights` has it.
        looks: at most along a ray that may pass the heights.
        frames: vectors among the first bank's features, three numbers each: the decoder takes
            the products of each with the half vector and with the light, after the features.
        channels: of the answer. output: "log" as it comes, "relu" with negative numbers cut,
            "mask" with the first half times 0.1 + sigmoid(second half).
        aspect: tile width / tile height.
        depth_scale: tile widths a unit of the offset network, or of the heights.
        wrap: whether textures tile, or clamp at their borders.
    """

    decoder: Network
    banks: tuple[Pyramid, ...]
    offset: tuple[Pyramid, Network] | None = None
    heights: tuple[int, int] | None = None
    frames: int = 0
    channels: int = 3
    output: Output = "log"
    aspect: float = 1.0
    depth_scale: float = 1.0
    wrap: bool = True
    curved: bool = False
    holes: bool = False
    looks: int = CURVED_LOOKS

    def __post_init__(self) -> None:
        if self.offset and self.heights:
            raise ValueError("a ray depth comes from a network or from heights, not from both")
        if self.curved and not self.heights:
            raise ValueError("curvature bends rays through heights; there are none")
        if self.looks < 1:
            raise ValueError(f"looks = {self.looks}; expected 1 or more")
        if self.holes and not self.curved:
            raise ValueError("holes are those of curved heights; there are none")
        if "curvature" in self.decoder.directions and not self.curved:
            raise ValueError("the input curvature is that of curved heights; there are none")

    @property
    def has_depth(self) -> bool:
        """Whether lookups move with the view at all."""
        return self.offset is not None or self.heights is not None

    @property
    def pyramids(self) -> tuple[Pyramid, ...]:
        return ((self.offset[0],) if self.offset else ()) + self.banks

    @property
    def weights(self) -> int:
        return (self.offset[1].size if self.offset else 0) + self.decoder.size

    @property
    def texels(self) -> int:
        return self._rows_of_heights + sum(pyramid.texels for pyramid in self.pyramids)

    @property
    def _rows_of_heights(self) -> int:
        return self._rows_of_plane * (1 + self.holes)

    @property
    def _rows_of_plane(self) -> int:
        return -(-self.heights[0] * self.heights[1] // CHANNELS) if self.heights else 0

    @property
    def needs_light(self) -> bool:
        return any(bank.light for bank in self.banks)

    def split(self, weights: Any) -> tuple[Any, Any]:
        """The flat weights of the offset network (empty without one) and of the decoder."""
        cut = self.offset[1].size if self.offset else 0
        return weights[:cut], weights[cut:]

    def textures(self, texels: Any) -> list[list[Any]]:
        """(h, w, 8) views of each pyramid's levels; the offset texture first."""
        found, at = [], self._rows_of_heights
        for pyramid in self.pyramids:
            levels = []
            for h, w in pyramid.sizes:
                levels.append(texels[at : at + h * w].reshape(h, w, CHANNELS))
                at += h * w
            found.append(levels)
        return found

    def finest(self, texels: Any) -> list[Any]:
        """(h, w, k) views of the finest level of each pyramid, and of the heights."""
        heights = [self.surface(texels)[..., None]] if self.heights else []
        return [levels[0] for levels in self.textures(texels)] + heights

    def surface(self, texels: Any) -> Any:
        """(h, w) view of the heights, units of depth_scale."""
        assert self.heights is not None
        h, w = self.heights
        return texels[: self._rows_of_plane].reshape(-1)[: h * w].reshape(h, w)

    def cover(self, texels: Any) -> Any:
        """(h, w) view of the heights' opacity; None where they have no holes."""
        if not self.holes or self.heights is None:
            return None
        h, w = self.heights
        plane = texels[self._rows_of_plane : self._rows_of_heights]
        return plane.reshape(-1)[: h * w].reshape(h, w)

    def program(
        self,
        weights: NDArray[Any],
        texels: NDArray[Any],
        *,
        channels: tuple[str, ...] = (),
        grid: tuple[int, int] | None = None,
        networks: Networks = "float32",
        released: bool = False,
        leveled: bool = True,
    ) -> Program:
        """The model as data: views of its two flat arrays.

        Args:
            weights: (self.weights,). texels: (self.texels, 8).
            channels: names of the answer's; numbers where there are none.
            grid: (h, w) of the data's; where only the layout is known, one of its aspect.
            networks: what is multiplied. released: whether `output` is the published program's.
            leveled: whether footprints count.
        """
        first, second = self.split(weights)
        levels = self.textures(texels)
        depth: Heights | DepthNetwork | None = None
        if self.heights:
            depth = Heights(
                self.surface(texels), self.depth_scale, self.curved, self.cover(texels), self.looks
            )
        if self.offset:
            pyramid, network = self.offset
            texture = _texture("offset", pyramid, levels.pop(0))
            inputs = (*texture.features, *network.directions)
            depth = DepthNetwork(texture, inputs, network.dense(first), self.depth_scale)
        textures = tuple(
            _texture(bank.name or f"bank{k}", bank, found)
            for k, (bank, found) in enumerate(zip(self.banks, levels, strict=True))
        )
        features = [name for texture in textures for name in texture.features]
        masked = self.output == "mask" or released
        c = self.channels // 2 if released else self.channels
        return Program(
            channels=channels or tuple(str(k) for k in range(c)),
            grid=grid or self.banks[0].sizes[0],
            aspect=self.aspect,
            wrap=self.wrap,
            textures=textures,
            inputs=(*features, *frame_products(self.frames), *self.decoder.directions),
            layers=self.decoder.dense(second),
            heads=(Head("log", c), Head("mask", c)) if masked else (Head("log", c),),
            output="released" if released else "relu" if self.output == "relu" else "log",
            depth=depth,
            frames=self.frames,
            leveled=leveled,
            rounded=networks == "bfloat16",
            full_sphere=self.curved,
        )


def _texture(name: str, pyramid: Pyramid, levels: list[Any]) -> Texture:
    used = tuple(level[..., : pyramid.channels] for level in levels)
    return Texture(name, used, pyramid.view, pyramid.light, pyramid.shift)
