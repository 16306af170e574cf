"""The engine of the compiled kernels, and what every engine on the CPU keeps its arrays in."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, final

import numpy as np

from btfkit.fitting.neumip.data import Batch, Source
from btfkit.fitting.neumip.engines.base import MOMENTS, PARAMETERS, Engine, Step
from btfkit.native.neural import Kernel, Loss
from btfkit.native.neural.blur import blur
from btfkit.native.neural.layout import Array, Layout

if TYPE_CHECKING:
    from torch import Tensor


class OnCPU(Engine[Batch]):
    """Weights, texels and their moments in numpy, as `state` names them."""

    def __init__(
        self, layout: Layout, arrays: dict[str, Array], source: Source, loss: Loss
    ) -> None:
        self._layout, self._arrays = layout, arrays
        self._source, self._loss = source, loss

    def batch(self, number: int, count: int) -> Batch:
        return self._source.batch(number, count)

    def parameters(self) -> tuple[Array, Array]:
        return self._arrays["weights"], self._arrays["texels"]

    def slots(self, name: str) -> tuple[Array, Array, Array]:
        """A parameter and both its moments."""
        first, second = (self._arrays[f"{name}.{moment}"] for moment in MOMENTS)
        return self._arrays[name], first, second

    def settle(self, step: Step) -> bool:
        """What follows Adam: decay and blur; whether what depths come from is finite."""
        weights, texels = self.parameters()
        weights *= np.float32(step.kept)
        if step.blur:
            # A relief is found from its large forms to its small ones.
            for texture in self._layout.finest(texels):
                blur(texture, step.blur**2, wrap=self._layout.wrap)
        # A depth that is no number is looked up at a border, with a finite loss.
        good = np.isfinite(weights).all()
        if self._layout.heights:
            good &= np.isfinite(self._layout.surface(texels)).all()
        return bool(good)

    def state(self) -> dict[str, Array]:
        return {name: array.copy() for name, array in self._arrays.items()}

    def restore(self, state: Mapping[str, Array]) -> None:
        for name, array in self._arrays.items():
            array[...] = state[name]


@final
class Compiled(OnCPU):
    """The kernels: gradients and Adam in C++, summed over its threads in between."""

    def __init__(
        self, layout: Layout, arrays: dict[str, Array], source: Source, loss: Loss
    ) -> None:
        super().__init__(layout, arrays, source, loss)
        self._kernel = Kernel(layout)

    def take(self, batch: Batch, step: Step) -> float:
        # The kernel keeps its gradients.
        return self._moved(self._gradients(batch), step)

    def pull(self, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
        import torch

        loss = torch.tensor(self._gradients(batch), dtype=torch.float64)
        weights, texels = map(torch.from_numpy, self._kernel.gradients())
        return loss, weights, texels

    def push(self, loss: Tensor, gradients: Sequence[Tensor], step: Step) -> float:
        weights, texels = gradients
        self._kernel.replace(weights.numpy(), texels.numpy())
        return self._moved(float(loss), step)

    def _moved(self, loss: float, step: Step) -> float:
        weights, texels = (self.slots(name) for name in PARAMETERS)
        self._kernel.adam(
            weights, texels, lr=step.rates, step=step.number, betas=step.betas, dense=step.dense
        )
        return loss if self.settle(step) else math.nan

    def _gradients(self, batch: Batch) -> float:
        loss, _ = self._kernel.train(
            *self.parameters(), batch.uv, batch.light, batch.view, batch.footprint, batch.target,
            batch.weight, loss=self._loss, curvature=batch.curvature,
        )  # fmt: skip
        return loss

    def gradients_alone(self, count: int) -> Callable[[], object]:
        """A call that takes the gradient of one and the same batch again: the kernel alone."""
        batch = self.batch(0, count)
        return lambda: self._gradients(batch)
