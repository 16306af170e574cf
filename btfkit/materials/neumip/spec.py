"""What decides a NeuMIP's shapes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, final

from btfkit.conventions import CURVED_LOOKS
from btfkit.footprint import level_sizes, resolved_level
from btfkit.materials.base import Header
from btfkit.native.neural.layout import Layout, Network, Networks, Output, Pyramid
from btfkit.program import Activation

Precision = Literal["float32", "float16", "int8"]
# Levels that the coarse bank begins above the finest one.
_COARSE = 2


@final
@dataclass(frozen=True)
class NeuMIPSpec:
    """All that decides a NeuMIP's shapes and how its numbers are read.

    Attributes:
        size: (h, w) of the finest texture.
        levels: of the pyramid; 1 for a single scale.
        features: channels of the pyramid, 1 to 8.
        coarse: channels of a second pyramid that begins two levels up; 0 for none.
        light: channels of a texture that is read where the light comes in; 0 for none.
        offset: channels of the offset texture, 1 to 8; 0 for no offset network.
        heights: whether the ray depth is where the view ray meets a texture of heights; then
            there is no offset network, whatever `offset` says.
        curved: whether curvature bends the rays through the heights.
        holes: whether curved heights have an opacity.
        looks: at most along a ray that may pass curved heights.
        finer: levels of detail by which every texture is finer than what it answers for alone: a
            Gaussian of half a texel leaves more than that texel holds.
        frames: vectors among the pyramid's channels, three each, whose products with the half
            vector and the light the decoder takes too: 0, 1 or 2.
        hidden, offset_hidden: widths of the hidden layers.
        activation, offset_activation: of the hidden layers.
        directions: what the decoder takes beside the features.
        output: "log", "relu" or "mask" as in `Layout`; "released" for the six numbers of the
            published program: exp(YUV to RGB) - 1, times 0.1 + sigmoid.
        depth_scale: tile widths a unit of the offset network, or of the heights.
        channels: of the answer.
        precision: of the stored textures; heights take at least float16.
        networks: what evaluation multiplies after each network's first layer. "bfloat16" is
            faster where the processor multiplies pairs of them, and equal elsewhere but for
            rounding; these matrices are stored rounded, in float32.
    """

    size: tuple[int, int]
    levels: int = 1
    features: int = 7
    coarse: int = 0
    light: int = 0
    offset: int = 7
    hidden: tuple[int, ...] = (25, 25, 25)
    offset_hidden: tuple[int, ...] = (25, 25, 25)
    activation: Activation = "relu"
    offset_activation: Activation = "relu"
    directions: tuple[str, ...] = ("lx", "ly", "vx", "vy")
    output: Literal["log", "relu", "mask", "released"] = "log"
    depth_scale: float = 0.05
    channels: int = 3
    precision: Precision = "float32"
    heights: bool = False
    frames: int = 0
    networks: Networks = "float32"
    curved: bool = False
    holes: bool = False
    looks: int = CURVED_LOOKS
    finer: float = 0.0

    def begins(self, header: Header) -> float:
        """Level of the data's grid that the finest texture resolves."""
        return resolved_level(self.size, header.grid)

    def layout(self, header: Header) -> Layout:
        """The model as its kernels see it."""
        shift = self.begins(header) + self.finer
        banks = [
            Pyramid(
                level_sizes(self.size, self.levels), self.features, shift=shift, name="features"
            )
        ]
        if self.coarse:
            base = level_sizes(self.size, _COARSE + 1)[-1]
            levels = max(self.levels - _COARSE, 1)
            start = resolved_level(base, header.grid) + self.finer
            banks.append(
                Pyramid(level_sizes(base, levels), self.coarse, shift=start, name="coarse")
            )
        if self.light:
            banks.append(Pyramid((self.size,), self.light, light=1.0, shift=shift, name="light"))
        outputs = self.channels * (2 if self.output in ("mask", "released") else 1)
        inputs = sum(bank.channels for bank in banks) + 2 * self.frames + len(self.directions)
        decoder = Network((inputs, *self.hidden, outputs), self.directions, self.activation)
        offset = None
        if self.offset and not self.heights:
            widths = (self.offset + 2, *self.offset_hidden, 1)
            network = Network(widths, ("vx", "vy"), self.offset_activation)
            offset = (Pyramid((self.size,), self.offset), network)
        # The kernels give the raw numbers of "released"; their channels are all of them.
        released = self.output == "released"
        output: Output = "log" if self.output == "released" else self.output
        return Layout(
            decoder,
            tuple(banks),
            offset,
            self.size if self.heights else None,
            self.frames,
            channels=outputs if released else self.channels,
            output=output,
            aspect=header.aspect,
            depth_scale=self.depth_scale,
            wrap=header.wrap == "wrap",
            curved=self.curved,
            holes=self.holes,
            looks=self.looks,
        )
