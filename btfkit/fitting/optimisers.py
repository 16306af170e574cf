"""Optimisers of small networks, without what torch's own bring along.

The first step of any `torch.optim.Optimizer` imports torch's compiler: seconds that a
short fit does not have.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from typing import Any, final

import torch
from torch import Tensor, nn


class Optimiser(ABC):
    """Parameters of one learning rate, and what is kept of each.

    Attributes:
        param_groups: one, as torch has them: "params" and "lr".
        state: tensors by name, for each parameter that has moved.
    """

    def __init__(self, parameters: Iterable[nn.Parameter], lr: float) -> None:
        self.param_groups: list[dict[str, Any]] = [{"params": list(parameters), "lr": lr}]
        self.state: dict[nn.Parameter, dict[str, Tensor]] = {}

    @torch.no_grad()
    def step(self) -> None:
        """Move every parameter that has a gradient."""
        (group,) = self.param_groups
        for parameter in group["params"]:
            if parameter.grad is not None:
                slots = self.state.setdefault(parameter, {})
                self._move(parameter, parameter.grad, slots, group["lr"])

    @abstractmethod
    def _move(
        self, parameter: nn.Parameter, gradient: Tensor, slots: dict[str, Tensor], lr: float
    ) -> None:
        """Move one, and what is kept of it; `slots` is empty the first time."""

    def zero_grad(self, *, set_to_none: bool = True) -> None:
        """Forget all gradients."""
        if not set_to_none:
            raise ValueError("gradients are forgotten, not kept at 0")
        for parameter in self.param_groups[0]["params"]:
            parameter.grad = None

    def state_dict(self) -> dict[str, Any]:
        """What is kept, by the parameters' numbers, and the rate."""
        (group,) = self.param_groups
        kept = {k: self.state[p] for k, p in enumerate(group["params"]) if p in self.state}
        return {"state": kept, "param_groups": [{"lr": group["lr"]}]}

    def load_state_dict(self, packed: Mapping[str, Any]) -> None:
        """Take back what `state_dict` gave."""
        (group,), (told,) = self.param_groups, packed["param_groups"]
        group["lr"] = told["lr"]
        self.state = {group["params"][k]: dict(slots) for k, slots in packed["state"].items()}


@final
class Adam(Optimiser):
    """Adam, as `torch.optim.Adam` takes its steps.

    Source: Kingma and Ba, "Adam: A Method for Stochastic Optimization", 2015.
    """

    def __init__(
        self, parameters: Iterable[nn.Parameter], *, lr: float, betas: tuple[float, float]
    ) -> None:
        super().__init__(parameters, lr)
        self._betas = betas

    def _move(
        self, parameter: nn.Parameter, gradient: Tensor, slots: dict[str, Tensor], lr: float
    ) -> None:
        if not slots:
            slots |= {name: torch.zeros_like(parameter) for name in ("exp_avg", "exp_avg_sq")}
            slots["step"] = torch.zeros(())
        slots["step"] += 1
        first, second = self._betas
        step, mean, square = float(slots["step"]), slots["exp_avg"], slots["exp_avg_sq"]
        mean.lerp_(gradient, 1 - first)
        square.mul_(second).addcmul_(gradient, gradient, value=1 - second)
        root = square.sqrt().div_(math.sqrt(1 - second**step)).add_(1e-8)
        parameter.addcdiv_(mean, root, value=-lr / (1 - first**step))
