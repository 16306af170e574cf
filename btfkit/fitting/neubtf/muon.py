"""Muon: momentum whose matrices are made orthogonal before they are added to the weights.

Source: Jordan et al., "Muon: An optimizer for hidden layers in neural networks", 2024.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import final

import torch
from torch import Tensor, nn

from btfkit.fitting.optimisers import Optimiser

# Coefficients of the quintic whose iteration lifts all singular values to about 1; from the source.
_QUINTIC = (3.4445, -4.7750, 2.0315)
_ITERATIONS = 5


@final
class Muon(Optimiser):
    """Nesterov momentum, orthogonalised.

    Args:
        parameters: matrices (out, in).
        lr: what the spectral norm of a square matrix moves by in a step.
        momentum: share of the momentum that a step keeps.
    """

    def __init__(
        self, parameters: Iterable[nn.Parameter], *, lr: float = 0.0, momentum: float = 0.95
    ) -> None:
        super().__init__(parameters, lr)
        self._keep = momentum

    def _move(
        self, parameter: nn.Parameter, gradient: Tensor, slots: dict[str, Tensor], lr: float
    ) -> None:
        keep = self._keep
        if not slots:
            slots["momentum"] = torch.zeros_like(parameter)
        momentum: Tensor = slots["momentum"].lerp_(gradient, 1 - keep)
        out, into = parameter.shape
        scale = math.sqrt(max(1.0, out / into))
        parameter.add_(orthogonalised(gradient.lerp(momentum, keep)), alpha=-lr * scale)


def orthogonalised(matrix: Tensor) -> Tensor:
    """A matrix of the same singular vectors whose singular values lie near 1; 0 stays 0."""
    a, b, c = _QUINTIC
    tall = matrix.shape[0] > matrix.shape[1]
    x = matrix.T if tall else matrix
    x = x / x.norm().clamp_min(1e-12)
    # Every iteration multiplies by a polynomial of the Gram matrix; they are gathered, and the wide
    # matrix is multiplied once.
    gram, factor = x @ x.T, torch.eye(len(x), dtype=x.dtype, device=x.device)
    for _ in range(_ITERATIONS):
        step = b * gram + c * gram @ gram
        step.diagonal().add_(a)
        factor = step @ factor
        gram = step @ step @ gram
    found = factor @ x
    return found.T if tall else found
