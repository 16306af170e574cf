"""NeuMIP on a torch device: parameters, moments and batches are there, the schedule is not.

What takes the gradients is plain torch, or on CUDA the fused kernels where Triton is installed and
knows the layout. A state goes from here to the CPU's kernels and back.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import final

import numpy as np
import torch
from torch import Tensor

from btfkit.conventions import MOST_LOG
from btfkit.fitting.neumip import forward
from btfkit.fitting.neumip.data import Batch, Source
from btfkit.fitting.neumip.engines import triton
from btfkit.fitting.neumip.engines.base import MOMENTS, PARAMETERS, Engine, Step
from btfkit.fitting.neumip.engines.device_draw import DeviceBatch, DeviceSource
from btfkit.fitting.neumip.engines.gradients import Gradients, Tensors
from btfkit.fitting.neumip.engines.triton import Fused, Matrix
from btfkit.materials.neumip import material as evaluated
from btfkit.native.neural import Loss
from btfkit.native.neural.blur import shares
from btfkit.native.neural.layout import Array, Layout
from btfkit.native.neural.plain import released as released_answer

_BLOCK = 1 << 20


@final
class Autograd(Gradients):
    """A layout in plain torch."""

    def __init__(self, layout: Layout) -> None:
        self._layout = layout

    def evaluate(
        self, weights: Tensor, texels: Tensor, batch: Tensors, *, raw: bool = False
    ) -> Tensor:
        with torch.no_grad():
            found = forward.forward(self._layout, weights, texels, *batch)
            if raw:
                return found
            return torch.expm1(forward.log_answer(self._layout, found).clamp(0, MOST_LOG))

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
        layout, leaves = self._layout, [p.detach().requires_grad_() for p in (weights, texels)]
        raw = forward.forward(layout, leaves[0], leaves[1], *batch)
        answer = forward.log_answer(layout, raw)
        total = forward.loss_of(layout, answer, target, weight, loss)
        by_weights, by_texels = torch.autograd.grad(total, leaves)
        return total.detach(), by_weights, by_texels


def gradients_on(layout: Layout, device: torch.device, *, matrix: Matrix = "bf16") -> Gradients:
    """What takes gradients on a device: fused kernels on CUDA where they can."""
    fused = device.type == "cuda" and triton.available()
    if fused and not triton.uncovered(layout):
        return Fused(layout, device, matrix=matrix)
    return Autograd(layout)


@final
class OnDevice(Engine[DeviceBatch]):
    """Parameters, moments and batches on a torch device.

    On CUDA nothing waits for a step: its loss is what the step before gave, so that the next batch
    is drawn meanwhile. Texture gradients are added up in any order there: equal seeds give equal
    models to rounding only.

    Args:
        layout: the model. state: parameters and moments, as engines name them.
        source: where the CPU would take its batches from.
        device: "cuda", or "cpu" for the same path without a GPU.
        loss: as `forward.loss_of`. matrix: what fused kernels round factors of products to.
    """

    def __init__(
        self,
        layout: Layout,
        state: Mapping[str, Array],
        source: Source,
        device: str,
        *,
        loss: Loss = "square",
        matrix: Matrix = "bf16",
    ) -> None:
        self.device, self._place = device, torch.device(device)
        self._layout, self._loss, self._matrix = layout, loss, matrix
        self._gradients = gradients_on(layout, self._place, matrix=matrix)
        self._source = DeviceSource(source, self._place)
        self._tensors = {
            name: torch.tensor(value, device=self._place) for name, value in state.items()
        }
        self._last: Tensor | None = None

    def batch(self, number: int, count: int) -> DeviceBatch:
        return self._source.batch(number, count)

    def pull(self, batch: DeviceBatch) -> tuple[Tensor, Tensor, Tensor]:
        tensors = self._tensors
        return self._gradients.gradients(
            tensors["weights"], tensors["texels"], batch.queries, batch.target, batch.weight,
            loss=self._loss,
        )  # fmt: skip

    def push(self, loss: Tensor, gradients: Sequence[Tensor], step: Step) -> float:
        tensors = self._tensors
        for name, rate, gradient in zip(PARAMETERS, step.rates, gradients, strict=True):
            first, second = (tensors[f"{name}.{moment}"] for moment in MOMENTS)
            slots = (tensors[name], first, second)
            adam(slots, gradient, rate, step.number, step.betas, dense=step.dense)
        tensors["weights"] *= step.kept
        if step.blur:
            smooth(self._layout, tensors["texels"], step.blur)
        # A depth that is no number is looked up at a border: look at what depths come from.
        good = torch.isfinite(tensors["weights"]).all()
        if self._layout.heights:
            good &= torch.isfinite(self._layout.surface(tensors["texels"])).all()
        return self._loss_of_step(torch.where(good, loss, math.nan))

    def _loss_of_step(self, loss: Tensor) -> float:
        if self._place.type != "cuda":
            return float(loss)
        before, self._last = self._last, loss
        return float(loss if before is None else before)

    def parameters(self) -> tuple[Array, Array]:
        weights, texels = (self._tensors[name].cpu().numpy() for name in PARAMETERS)
        return weights, texels

    def change(self, edit: Callable[[Array, Array], None]) -> None:
        arrays = self.parameters()
        edit(*arrays)
        for name, array in zip(PARAMETERS, arrays, strict=True):
            self._tensors[name].copy_(torch.from_numpy(array))

    def state(self) -> dict[str, Array]:
        return {name: tensor.to("cpu", copy=True).numpy() for name, tensor in self._tensors.items()}

    def restore(self, state: Mapping[str, Array]) -> None:
        self._last = None
        for name, tensor in self._tensors.items():
            tensor.copy_(torch.from_numpy(state[name]))

    def answers(self, material: evaluated.NeuMIPMaterial, held: Batch) -> Array:
        return evaluate_on_device(
            material, held.uv, held.light, held.view, held.footprint,
            device=self.device, matrix=self._matrix,
        )  # fmt: skip


def adam(
    slots: tuple[Tensor, Tensor, Tensor],
    gradient: Tensor,
    rate: float,
    step: int,
    betas: tuple[float, float],
    *,
    dense: bool,
) -> None:
    """`native.neural.adam.adam_plain` in torch, in place: parameters and both moments."""
    parameter, first, second = slots
    m = torch.lerp(first, gradient, 1 - betas[0])
    v = (second * betas[1]).addcmul_(gradient, gradient, value=1 - betas[1])
    root = (v / (1 - betas[1] ** step)).sqrt_().add_(1e-8)
    move = m / root * (-rate / (1 - betas[0] ** step))
    if not dense and parameter.ndim == 2:
        some = (gradient != 0).any(1)
        pairs = torch.nn.functional.pad(some, (0, len(some) % 2)).reshape(-1, 2).any(1)
        moved = pairs.repeat_interleave(2)[: len(some), None]
        m, v = torch.where(moved, m, first), torch.where(moved, v, second)
        move = torch.where(moved, move, 0.0)
    first.copy_(m)
    second.copy_(v)
    parameter += move


def smooth(layout: Layout, texels: Tensor, sigma: float) -> None:
    """Blur the finest textures in place by `sigma` texels, as on the CPU."""
    for texture in layout.finest(texels):
        for share in shares(sigma**2):
            for axis in (0, 1):
                if texture.shape[axis] > 1:
                    texture += share * _laplacian(texture, axis, wrap=layout.wrap)


def _laplacian(texture: Tensor, axis: int, *, wrap: bool) -> Tensor:
    if wrap:
        return texture.roll(1, axis) + texture.roll(-1, axis) - 2 * texture
    step = texture.diff(dim=axis)
    still = torch.zeros_like(texture.narrow(axis, 0, 1))
    return torch.cat([step, still], axis) - torch.cat([still, step], axis)


def evaluate_on_device(
    material: evaluated.NeuMIPMaterial,
    uv: Array,
    light: Array,
    view: Array,
    footprint: Array | None = None,
    *,
    device: str = "cuda",
    matrix: Matrix = "bf16",
) -> Array:
    """Reflectance (b, c) of a material, computed on a device.

    Args:
        material: a NeuMIP. uv: (b, 2). light, view: (b, 3) unit vectors.
        footprint: (b,) texels of the grid; None is 0.5 throughout.
        device: of torch. matrix: what factors of products are rounded to, by fused kernels.
    """
    place = torch.device(device)
    run = gradients_on(material.layout, place, matrix=matrix)
    released = material.spec.output == "released"
    weights, texels = (torch.from_numpy(a).to(place) for a in (material.flat, material.texels))
    rgb = np.zeros((len(uv), len(material.header.channels)), np.float32)
    for start in range(0, len(uv), _BLOCK):
        rows = slice(start, start + _BLOCK)
        parts = [
            torch.from_numpy(np.ascontiguousarray(part[rows], np.float32)).to(place)
            for part in (uv, light, view)
        ]
        blur = None
        if footprint is not None:
            blur = torch.from_numpy(np.ascontiguousarray(footprint[rows], np.float32)).to(place)
        batch = (parts[0], parts[1], parts[2], blur)
        found = run.evaluate(weights, texels, batch, raw=released).cpu().numpy()
        rgb[rows] = released_answer(found[:, :3], found[:, 3:]) if released else found
    rgb[(light[:, 2] <= 0) | (view[:, 2] < 0)] = 0
    return rgb
