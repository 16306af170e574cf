"""NeuMIP's published recipe in plain torch: what ours is measured against.

Source: Kuznetsov et al., "NeuMIP: Multi-Resolution Neural Materials", ACM TOG 40(4), 2021,
sections 3 and 4, and the program released with it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar, final

import numpy as np
import torch
from torch import Tensor

from btfkit.errors import FitError
from btfkit.fitting.neumip.blurring import blur_at, blurred
from btfkit.fitting.neumip.data import Batch
from btfkit.fitting.neumip.forward import forward, loss_of, loss_on_batch, tensors
from btfkit.fitting.neumip.recipe import Recipe
from btfkit.fitting.neumip.settings import PaperSettings
from btfkit.fitting.neumip.start import initial_texels
from btfkit.materials.neumip import material as evaluated
from btfkit.materials.neumip.spec import NeuMIPSpec
from btfkit.native.neural.adam import adam_plain
from btfkit.native.neural.layout import Array
from btfkit.native.neural.plain import YUV_TO_RGB


@final
class NeuMIPPaper(Recipe[PaperSettings]):
    """The published recipe: Adam at a constant rate, blurred textures, batches of 4 a texel."""

    model: ClassVar[str] = "neumip-paper"
    material_type: ClassVar[type[evaluated.NeuMIPMaterial]] = evaluated.NeuMIPPaper
    settings_type = PaperSettings

    def _spec(self, size: tuple[int, int], levels: int) -> NeuMIPSpec:
        c = len(self._header.channels)
        released = self.settings.outputs == 6
        if released and c != 3:
            raise FitError(f"the published program answers 3 channels; the data have {c}")
        return NeuMIPSpec(
            size,
            levels,
            offset=self.settings.offset,
            output="released" if released else "relu",
            channels=c,
            precision=self.settings.precision,  # type: ignore[arg-type]
        )

    def _begin(self, rng: np.random.Generator) -> None:
        layout = self.layout
        parts = []
        for network in ([layout.offset[1]] if layout.offset else []) + [layout.decoder]:
            flat = np.zeros(network.size, np.float32)
            for matrix, bias in network.layers(flat):
                # The default of torch.nn.Linear, which the published program relies on.
                reach = 1 / math.sqrt(matrix.shape[1])
                matrix[:] = rng.uniform(-reach, reach, matrix.shape)
                bias[:] = rng.uniform(-reach, reach, bias.shape)
            parts.append(flat)
        # A last layer that begins below zero everywhere would never learn.
        if layout.output == "relu":
            parts[-1][-layout.channels :] = np.abs(parts[-1][-layout.channels :]) + 0.1
        found = {"weights": np.concatenate(parts), "texels": initial_texels(layout, rng)}
        for name, array in list(found.items()):
            found |= {f"{name}.first": np.zeros_like(array), f"{name}.second": np.zeros_like(array)}
        self._progress = np.zeros(1, np.float32)
        self._arrays = found | {"progress": self._progress}

    def _tensors(self) -> dict[str, Tensor]:
        return {name: torch.from_numpy(array.copy()) for name, array in self._arrays.items()}

    def _put(self, state: Mapping[str, Tensor]) -> None:
        for name, array in self._arrays.items():
            array[...] = state[name].numpy()

    def step(self, progress: float) -> float:
        h, w = self.spec.size
        batch = self._source.batch(self._steps, self.settings.batch or 4 * h * w)
        self._steps += 1
        self.queries += len(batch)
        self._progress[0] = progress
        weights, texels = (
            torch.from_numpy(self._arrays[name]).requires_grad_() for name in ("weights", "texels")
        )
        loss = self._loss(weights, self._blurred(texels), batch)
        found = torch.autograd.grad(loss, (weights, texels))
        for name, gradient in zip(("weights", "texels"), found, strict=True):
            a = self._arrays
            slots = (a[name], a[f"{name}.first"], a[f"{name}.second"])
            adam_plain(slots, gradient.numpy(), 1e-3 * self._rate, self._steps, (0.9, 0.999))
        return float(loss.detach())

    def _loss(self, weights: Tensor, texels: Tensor, batch: Batch) -> Tensor:
        if self.spec.output != "released":
            return loss_on_batch(self.layout, weights, texels, batch, "square")
        raw = forward(self.layout, weights, texels, *tensors(batch))
        mixed = torch.tensor(YUV_TO_RGB, dtype=raw.dtype)
        rgb = torch.expm1((raw[:, :3] @ mixed.T).clamp(max=20))
        rgb = rgb * (0.1 + torch.sigmoid(raw[:, 3:]))
        target = torch.from_numpy(batch.target)
        log = torch.log1p(rgb.clamp(min=-0.1))
        square = loss_of(self.layout, log, target, None, "square")
        good = torch.isfinite(target)
        linear = torch.where(good, (rgb - torch.where(good, target, 0.0)).abs(), 0.0).mean()
        return square + 0.1 * linear

    def _blurred(self, texels: Tensor) -> Tensor:
        """Every level blurred alike, in tiles."""
        sigma = blur_at(float(self._progress[0]))
        if not sigma:
            return texels
        parts = [
            blurred(texture, sigma / 2**level, wrap=self.layout.wrap).flatten(0, 1)
            for levels in self.layout.textures(texels)
            for level, texture in enumerate(levels)
        ]
        return torch.cat(parts)

    def _current(self) -> tuple[Array, Array]:
        with torch.no_grad():
            texels = self._blurred(torch.from_numpy(self._arrays["texels"]))
        return self._arrays["weights"], texels.numpy()
