"""The engine where no kernel was built: autograd and numpy."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import final

import torch
from torch import Tensor

from btfkit.fitting.neumip.data import Batch, Source
from btfkit.fitting.neumip.engines.base import PARAMETERS, Engine, Step
from btfkit.fitting.neumip.engines.compiled import Arrays
from btfkit.fitting.neumip.forward import loss_on_batch
from btfkit.native.neural import Loss
from btfkit.native.neural.adam import adam_plain
from btfkit.native.neural.layout import Array, Layout


@final
class Plain(Engine[Batch]):
    """Where no kernel was built: autograd on the CPU, and the kernels' twins for the rest."""

    def __init__(
        self, layout: Layout, arrays: dict[str, Array], source: Source, loss: Loss
    ) -> None:
        self._arrays, self._source = Arrays(layout, arrays), source
        self._layout, self._loss = layout, loss

    def batch(self, number: int, count: int) -> Batch:
        return self._source.batch(number, count)

    def pull(self, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
        weights, texels = (torch.from_numpy(a).requires_grad_() for a in self.parameters())
        loss = loss_on_batch(self._layout, weights, texels, batch, self._loss)
        by_weights, by_texels = torch.autograd.grad(loss, (weights, texels))
        return loss.detach(), by_weights, by_texels

    def push(self, loss: Tensor, gradients: Sequence[Tensor], step: Step) -> float:
        for name, rate, gradient in zip(PARAMETERS, step.rates, gradients, strict=True):
            slots = self._arrays.slots(name)
            adam_plain(slots, gradient.numpy(), rate, step.number, step.betas, dense=step.dense)
        return float(loss) if self._arrays.settle(step) else math.nan

    def parameters(self) -> tuple[Array, Array]:
        return self._arrays.parameters()

    def state(self) -> dict[str, Array]:
        return self._arrays.state()

    def restore(self, state: Mapping[str, Array]) -> None:
        self._arrays.restore(state)
