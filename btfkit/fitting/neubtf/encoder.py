"""The encoder of a NeuBTF with heights: a small U-Net that begins at half resolution.

Where the published U-Net takes 100 to 130 ms for a step at 128 x 128 on one thread, this one takes
33, and learns as much a step (docs/neubtf.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import final

import torch
import torch.nn.functional as F
from torch import Tensor, nn

WIDTHS = (24, 48, 96)
# The coarsest level has texels of this many of the guidance's.
STRIDE = 2 ** len(WIDTHS)
# No texel further away than this has a say in what a texel becomes: 42, a look's shift, and up to a
# whole stride.
REACH = 56
# Texels, down and across, by which a guidance is moved to be looked at several times.
LOOKS = ((0, 0), (1, 3), (3, 6), (6, 1))
# Larger guidance is encoded in parts of this many texels a side.
_PART = 1024


@final
class Convolution(nn.Module):
    """3 x 3 around the border; its kernel is kept as a matrix, which is what Muon moves."""

    def __init__(self, a: int, b: int, generator: torch.Generator, *, gain: float = 1.0) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(b, 9 * a))
        self.bias = nn.Parameter(torch.zeros(b))
        deviation = gain * math.sqrt(2 / (9 * a))
        nn.init.normal_(self.weight, std=deviation, generator=generator)

    def forward(self, x: Tensor) -> Tensor:
        """(b, a, h, w) to (b, b, h, w)."""
        x = torch.cat([x[:, :, -1:], x, x[:, :, :1]], dim=2)
        x = torch.cat([x[..., -1:], x, x[..., :1]], dim=3)
        return F.conv2d(x, self.weight.view(len(self.weight), x.shape[1], 3, 3), self.bias)


@final
class Encoder(nn.Module):
    """Guidance (b, inputs, h, w) to (b, outputs, h, w), sides being multiples of STRIDE."""

    def __init__(self, inputs: int, outputs: int, generator: torch.Generator) -> None:
        super().__init__()

        def two(a: int, b: int) -> nn.ModuleList:
            return nn.ModuleList([Convolution(a, b, generator), Convolution(b, b, generator)])

        self.down = nn.ModuleList(two(a, b) for a, b in pairwise((4 * inputs, *WIDTHS)))
        self.up = nn.ModuleList(two(a + b, a) for a, b in pairwise(WIDTHS))
        # It begins with the mean of what it is taught.
        self.out = Convolution(WIDTHS[0] + 4 * inputs, 4 * outputs, generator, gain=0.1)

    def matrices(self) -> list[nn.Parameter]:
        """What Muon moves: every kernel but the first and the last."""
        return [p for n, p in self.named_parameters() if n.endswith("weight") and not _ends(n)]

    def rest(self) -> list[nn.Parameter]:
        """What Adam moves: biases, the first and the last kernel."""
        return [p for n, p in self.named_parameters() if not n.endswith("weight") or _ends(n)]

    def forward(self, guidance: Tensor) -> Tensor:
        """(b, outputs, h, w) of a guidance (b, inputs, h, w)."""
        h, w = guidance.shape[-2:]
        if h % STRIDE or w % STRIDE:
            raise ValueError(f"guidance of {h} x {w}; expected multiples of {STRIDE}")
        first = x = F.pixel_unshuffle(guidance, 2)
        passed = []
        for level, block in enumerate(self.down):
            x = _through(block, F.avg_pool2d(x, 2) if level else x)
            passed.append(x)
        passed.pop()
        for block in reversed(self.up):
            finer = F.interpolate(x, scale_factor=2.0, mode="nearest")
            x = _through(block, torch.cat([passed.pop(), finer], dim=1))
        return F.pixel_shuffle(self.out(torch.cat([x, first], dim=1)), 2)


def encode_in_tiles(encoder: Encoder, guidance: Tensor, *, wrap: bool) -> Tensor:
    """(1, outputs, h, w) of a guidance (1, inputs, h, w) of any size, in bounded memory.

    The mean of several looks: between strides the encoder does not move with the image. Beyond the
    border a periodic guidance goes on from its other side, and needs sides that the stride divides;
    any other one is mirrored.
    """

    def looked_at(image: Tensor) -> Tensor:
        total = torch.zeros(())
        for down, across in LOOKS:
            seen = encoder(image.roll((down, across), (2, 3)))
            total = total + seen.roll((-down, -across), (2, 3))
        return total / len(LOOKS)

    if wrap and max(guidance.shape[-2:]) <= _PART:
        return looked_at(guidance)
    return in_parts(looked_at, guidance, wrap=wrap)


def in_parts(
    function: Callable[[Tensor], Tensor], image: Tensor, *, wrap: bool, reach: int = REACH
) -> Tensor:
    """(1, outputs, h, w) of a function of images (1, inputs, h, w) that sees no further than reach.

    It is given parts whose sides the stride divides, with `reach` texels and more around them;
    the stride divides that, too.
    """
    h, w = image.shape[-2:]
    bands = []
    for top in range(0, h, _PART):
        parts = []
        for left in range(0, w, _PART):
            high, wide = min(_PART, h - top), min(_PART, w - left)
            rows = _around(top, high, h, reach, wrap=wrap)
            cols = _around(left, wide, w, reach, wrap=wrap)
            answer = function(image[:, :, rows][:, :, :, cols])
            parts.append(answer[:, :, reach : reach + high, reach : reach + wide])
        bands.append(torch.cat(parts, dim=3))
    return torch.cat(bands, dim=2)


def _around(start: int, count: int, side: int, reach: int, *, wrap: bool) -> Tensor:
    """Indices of `count` texels and of `reach` and more on both sides of them."""
    length = -(-count // STRIDE) * STRIDE
    at = torch.arange(start - reach, start + length + reach)
    if wrap:
        return at % side
    at = at % (2 * side)
    return torch.where(at < side, at, 2 * side - 1 - at)


def _through(block: nn.Module, x: Tensor) -> Tensor:
    for layer in block.children():
        x = F.leaky_relu(layer(x), 0.1)
    return x


def _ends(name: str) -> bool:
    return name in ("down.0.0.weight", "out.weight")
