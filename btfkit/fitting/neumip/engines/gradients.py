"""What answers, and takes gradients, where torch holds the parameters."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor

# uv, light, view and footprint of queries.
Tensors = tuple[Tensor, Tensor, Tensor, Tensor | None]


class Gradients(ABC):
    """What answers, and takes gradients, of one layout whose parameters torch holds."""

    @abstractmethod
    def evaluate(
        self, weights: Tensor, texels: Tensor, batch: Tensors, *, raw: bool = False
    ) -> Tensor:
        """Reflectance (b, c) of a batch, or the decoder's raw numbers; no gradients."""

    @abstractmethod
    def gradients(
        self,
        weights: Tensor,
        texels: Tensor,
        batch: Tensors,
        target: Tensor,
        weight: Tensor | None = None,
        *,
        loss: str = "square",
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Loss of a batch as `forward.loss_of`, its gradients by weights and by texels."""
