"""The sinusoidal renderer of NeuBTF, trainable twin of `materials.neubtf.paper`."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any, final

import torch
from torch import Tensor, nn

from btfkit.materials.neubtf.paper import HIDDEN, NeuBTFSpec


def on_disc(direction: Tensor) -> Tensor:
    """Twin of `native.neural.plain.on_disc`: directions (..., 3) to (..., 2)."""
    tangential = torch.hypot(direction[..., 0], direction[..., 1])
    angle = torch.atan2(tangential, direction[..., 2])
    stretch = torch.where(tangential > 1e-6, angle / tangential.clamp_min(1e-6), 1.0)
    return direction[..., :2] * (stretch * (2 / math.pi))[..., None]


@final
class Renderer(nn.Module):
    """18 -> 32 -> 32 -> 32 -> c with LayerNorm, sines and residuals: 3011 weights for c = 3.

    The frequency multiplies what LayerNorm has normalised, sin(omega LN(z)): with omega inside
    the norm it cancels, and without a norm the latents alone decide the phase.

    Source: Rodriguez-Pardo et al. 2023, section 4; SIREN initialisation: Sitzmann et al. 2020.
    """

    def __init__(self, spec: NeuBTFSpec, generator: torch.Generator) -> None:
        super().__init__()
        self.omega = spec.omega
        sizes = [spec.latents + 4] + [spec.width] * HIDDEN
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(sizes))
        self.norms = nn.ModuleList(nn.LayerNorm(spec.width) for _ in range(HIDDEN))
        self.out = nn.Linear(spec.width, spec.channels)
        with torch.no_grad():
            layers: list[Any] = [*self.layers, self.out]
            for index, layer in enumerate(layers):
                fan = layer.weight.shape[1]
                bound = 1 / fan if index == 0 else math.sqrt(6 / fan) / spec.omega
                layer.weight.uniform_(-bound, bound, generator=generator)
                layer.bias.uniform_(-bound, bound, generator=generator)

    def forward(self, latents: Tensor, light: Tensor, view: Tensor) -> Tensor:
        """log(1 + rgb).

        Args:
            latents: (..., latents); light, view: (..., 2) as `on_disc` gives them, broadcasting.

        Returns:
            (..., c).
        """
        shape = torch.broadcast_shapes(latents.shape[:-1], light.shape[:-1], view.shape[:-1])
        parts = [part.expand(*shape, part.shape[-1]) for part in (latents, light, view)]
        x = torch.cat(parts, dim=-1)
        for index, (layer, norm) in enumerate(zip(self.layers, self.norms, strict=True)):
            activation = torch.sin(self.omega * norm(layer(x)))
            x = activation if index == 0 else x + activation
        return self.out(x)

    def arrays(self) -> dict[str, Tensor]:
        """The weights by the names of `materials.neubtf.paper.renderer_shapes`."""
        found = {}
        for index, (layer, norm) in enumerate(zip(self.layers, self.norms, strict=True)):
            for kind, module in (("", layer), (".norm", norm)):
                for name, value in module.named_parameters():
                    found[f"renderer.{index}{kind}.{name}"] = value
        for name, value in self.out.named_parameters():
            found[f"renderer.out.{name}"] = value
        return {name: value.detach() for name, value in found.items()}


@final
class ParallaxHead(nn.Module):
    """Latents and view -> signed height along the view ray, in tile widths; 0 at the start."""

    def __init__(self, spec: NeuBTFSpec, generator: torch.Generator) -> None:
        super().__init__()
        self.layers = nn.ModuleList([nn.Linear(spec.latents + 2, 16), nn.Linear(16, 1)])
        with torch.no_grad():
            bound = math.sqrt(1 / (spec.latents + 2))
            first: Any = self.layers[0]
            last: Any = self.layers[1]
            first.weight.uniform_(-bound, bound, generator=generator)
            for zero in (first.bias, last.weight, last.bias):
                zero.zero_()

    def forward(self, latents: Tensor, view: Tensor) -> Tensor:
        """(..., 1) heights of (..., latents) seen along (..., 2) view x and y."""
        first, last = self.layers
        inputs = torch.cat([latents, view.expand(*latents.shape[:-1], 2)], dim=-1)
        return last(torch.relu(first(inputs)))

    def arrays(self) -> dict[str, Tensor]:
        """The weights by the names of `materials.neubtf.paper.parallax_shapes`."""
        found = {}
        for index, layer in enumerate(self.layers):
            for name, value in layer.named_parameters():
                found[f"parallax.{index}.{name}"] = value.detach()
        return found
