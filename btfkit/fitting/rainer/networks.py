"""Networks of the two autoencoders: a decoder, and an encoder for each kind of code."""

from __future__ import annotations

from itertools import pairwise
from typing import final

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from btfkit.conventions import LEAK
from btfkit.materials.rainer import HIDDEN, RainerSpec


@final
class Layers(nn.Module):
    """Linear layers with leaky ReLU between them."""

    def __init__(self, sizes: list[int], generator: torch.Generator) -> None:
        super().__init__()
        layers = [nn.Linear(a, b) for a, b in pairwise(sizes)]
        for layer in layers:
            nn.init.kaiming_uniform_(layer.weight, a=LEAK, generator=generator)
            nn.init.zeros_(layer.bias)
        self.layers = nn.ModuleList(layers)

    def forward(self, x: Tensor) -> Tensor:
        """(..., sizes[0]) to (..., sizes[-1])."""
        for index, layer in enumerate(self.layers):
            x = layer(x)
            if index + 1 < len(self.layers):
                x = F.leaky_relu(x, LEAK)
        return x


@final
class Decoder(nn.Module):
    """latents, light x y, view x y -> log(1 + value), whitened where the model is."""

    def __init__(self, spec: RainerSpec, generator: torch.Generator) -> None:
        super().__init__()
        sizes = [spec.latents + 4, *[spec.width] * HIDDEN, spec.channels]
        self.network = Layers(sizes, generator)

    def forward(self, codes: Tensor, light: Tensor, view: Tensor) -> Tensor:
        """(..., c) for codes (..., latents), light and view (..., 2); shapes broadcast."""
        shape = torch.broadcast_shapes(codes.shape[:-1], light.shape[:-1], view.shape[:-1])
        parts = [part.expand(*shape, part.shape[-1]) for part in (codes, light, view)]
        return self.network(torch.cat(parts, dim=-1))

    def arrays(self) -> dict[str, Tensor]:
        """The weights by the names of `materials.rainer.decoder_shapes`."""
        return {
            f"decoder.{k}.{name}": value.detach()
            for k, layer in enumerate(self.network.layers)
            for name, value in layer.named_parameters()
        }


@final
class TableEncoder(nn.Module):
    """The values of a texel under fixed pairs -> its code.

    Args:
        probes: pairs. channels: of a value. latents: of a code.
    """

    def __init__(
        self, probes: int, channels: int, latents: int, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.network = Layers([probes * channels, 256, 106, latents], generator)

    def forward(self, values: Tensor, light: Tensor, view: Tensor) -> Tensor:
        """(t, latents) of values (t, probes, c); the pairs are known by their place."""
        del light, view
        return self.network(values.flatten(1))


@final
class SetEncoder(nn.Module):
    """Any number of values, each with its light and view -> a code, whatever their order.

    What one network makes of each sample is averaged, so that one encoder serves materials
    that were measured under different directions.

    Source: Zaheer et al., "Deep sets", 2017.
    """

    def __init__(self, channels: int, latents: int, generator: torch.Generator) -> None:
        super().__init__()
        self.sample = Layers([channels + 4, 96, 96, 192], generator)
        self.join = Layers([192, 128, latents], generator)

    def forward(self, values: Tensor, light: Tensor, view: Tensor) -> Tensor:
        """(t, latents) of values (t, k, c) under light and view (t or 1, k, 2)."""
        shape = values.shape[:2]
        parts = [values, light.expand(*shape, 2), view.expand(*shape, 2)]
        x = torch.cat(parts, dim=-1)
        *hidden, last = self.sample.layers
        for layer in hidden:
            x = F.leaky_relu(layer(x), LEAK)
        # The last layer is linear: after the mean it has two thirds less of all to multiply.
        return self.join(last(x.mean(dim=1)))
