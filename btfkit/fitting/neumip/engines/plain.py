"""The engine where no kernel was built: autograd and numpy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import final

import torch
from torch import Tensor

from btfkit.fitting.neumip.data import Batch
from btfkit.fitting.neumip.engines.base import PARAMETERS, Step
from btfkit.fitting.neumip.engines.compiled import OnCPU
from btfkit.fitting.neumip.forward import loss_on_batch
from btfkit.native.neural.adam import adam_plain


@final
class Plain(OnCPU):
    """Where no kernel was built: autograd on the CPU, and the kernels' twins for the rest."""

    def pull(self, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
        weights, texels = (torch.from_numpy(a).requires_grad_() for a in self.parameters())
        loss = loss_on_batch(self._layout, weights, texels, batch, self._loss)
        by_weights, by_texels = torch.autograd.grad(loss, (weights, texels))
        return loss.detach(), by_weights, by_texels

    def push(self, loss: Tensor, gradients: Sequence[Tensor], step: Step) -> float:
        for name, rate, gradient in zip(PARAMETERS, step.rates, gradients, strict=True):
            slots = self.slots(name)
            adam_plain(slots, gradient.numpy(), rate, step.number, step.betas, dense=step.dense)
        return float(loss) if self.settle(step) else math.nan
