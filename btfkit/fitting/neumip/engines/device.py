"""NeuMIP on a torch device: parameters, moments and batches are there, the schedule is not.

What takes the gradients is plain torch, or on CUDA the fused kernels where Triton is installed and
knows the layout. A state goes from here to the CPU's kernels and back.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import ClassVar, final

import numpy as np
import torch
from torch import Tensor

from btfkit.fitting.loop import Trainable
from btfkit.fitting.neumip.data import Batch
from btfkit.fitting.neumip.engines import eager, triton
from btfkit.fitting.neumip.engines.device_draw import DeviceSource
from btfkit.fitting.neumip.engines.triton import Fused, Matrix
from btfkit.fitting.neumip.trainable import NeuMIP
from btfkit.materials.base import Material
from btfkit.materials.neumip import material as evaluated
from btfkit.native.neural.blur import shares
from btfkit.native.neural.layout import Array, Layout
from btfkit.native.neural.plain import released as released_answer

_PARAMETERS = ("weights", "texels")
_BLOCK = 1 << 20


@final
class Eager:
    """A layout in plain torch, with the face of `triton.Fused`."""

    def __init__(self, layout: Layout) -> None:
        self._layout = layout

    def evaluate(
        self, weights: Tensor, texels: Tensor, batch: triton.Batch, *, raw: bool = False
    ) -> Tensor:
        """Reflectance (b, c) of a batch, or the decoder's raw numbers; no gradients."""
        with torch.no_grad():
            found = eager.forward(self._layout, weights, texels, *batch)
            if raw:
                return found
            return torch.expm1(eager.log_answer(self._layout, found).clamp(0, 20))

    def gradients(
        self,
        weights: Tensor,
        texels: Tensor,
        batch: triton.Batch,
        target: Tensor,
        weight: Tensor | None = None,
        *,
        loss: str = "square",
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Loss of a batch as `eager.loss_of`, its gradients by weights and by texels."""
        layout, leaves = self._layout, [p.detach().requires_grad_() for p in (weights, texels)]
        raw = eager.forward(layout, leaves[0], leaves[1], *batch)
        answer = eager.log_answer(layout, raw)
        total = eager.loss_of(layout, answer, target, weight, loss)
        by_weights, by_texels = torch.autograd.grad(total, leaves)
        return total.detach(), by_weights, by_texels


def engine(layout: Layout, device: torch.device, *, matrix: Matrix = "bf16") -> Eager | Fused:
    """What answers, and takes gradients, on a device: fused kernels on CUDA where they can."""
    fused = device.type == "cuda" and triton.available()
    if fused and not triton.uncovered(layout):
        return Fused(layout, device, matrix=matrix)
    return Eager(layout)


@final
class OnDevice(Trainable):
    """A NeuMIP trained on a device: the schedule and batches of the one it is made from.

    On CUDA nothing waits for a step: its loss is what the step before gave, so that the next batch
    is drawn meanwhile. Texture gradients are added up in any order there: equal seeds give equal
    models to rounding only.

    Args:
        inner: where settings, data, schedule and first parameters come from.
        device: "cuda", or "cpu" for the same path without a GPU.
    """

    model: ClassVar[str] = "neumip"

    def __init__(self, inner: NeuMIP, device: str) -> None:
        self._inner, self._device = inner, torch.device(device)
        self._matrix: Matrix = inner.settings.matrix  # type: ignore[assignment]
        self._engine: Eager | Fused = engine(inner.layout, self._device, matrix=self._matrix)
        self._source = DeviceSource(inner.source, self._device)
        self.masked = inner.masked
        self._tensors = {
            name: value.to(self._device)
            for name, value in inner.state().items()
            if name.split(".")[0] in _PARAMETERS
        }
        self._last: Tensor | None = None

    def step(self, progress: float) -> float:
        inner, tensors, s = self._inner, self._tensors, self._inner.settings
        step = inner.next_step(progress, self._source.batch)
        self.queries, batch = inner.queries, step.batch
        loss, *found = self._engine.gradients(
            tensors["weights"], tensors["texels"], batch.queries, batch.target, batch.weight,
            loss=s.loss,
        )  # fmt: skip
        for name, rate, gradient in zip(_PARAMETERS, step.rates, found, strict=True):
            slots = (tensors[name], tensors[f"{name}.first"], tensors[f"{name}.second"])
            adam(slots, gradient, rate, step.number, (0.9, s.beta2), dense=step.dense)
        tensors["weights"] *= step.kept
        if step.blur:
            smooth(inner.layout, tensors["texels"], step.blur)
        # A depth that is no number is looked up at a border: look at what depths come from.
        good = torch.isfinite(tensors["weights"]).all()
        if inner.layout.heights:
            good &= torch.isfinite(inner.layout.surface(tensors["texels"])).all()
        return self._told(torch.where(good, loss, math.nan))

    def _told(self, loss: Tensor) -> float:
        if self._device.type != "cuda":
            return float(loss)
        before, self._last = self._last, loss
        return float(loss if before is None else before)

    def material(self) -> Material:
        self._inner.restore(self.state())
        return self._inner.material()

    def score(self) -> float:
        self._inner.restore(self.state())
        return self._inner.scored(partial(_answers, device=str(self._device), matrix=self._matrix))

    def state(self) -> dict[str, Tensor]:
        copied = {name: tensor.to("cpu", copy=True) for name, tensor in self._tensors.items()}
        return self._inner.state() | copied

    def restore(self, state: Mapping[str, Tensor]) -> None:
        self._inner.restore(state)
        self.queries, self._last = self._inner.queries, None
        for name, tensor in self._tensors.items():
            tensor.copy_(state[name])

    def slow_down(self) -> None:
        self._inner.slow_down()


def adam(
    slots: tuple[Tensor, Tensor, Tensor],
    gradient: Tensor,
    rate: float,
    step: int,
    betas: tuple[float, float],
    *,
    dense: bool,
) -> None:
    """`adam.adam_plain` in torch, in place: parameters and both moments."""
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
    """Blur the finest textures in place by `sigma` texels, as `NeuMIP` does."""
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
    material: evaluated.NeuMIP,
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
    run = engine(material.layout, place, matrix=matrix)
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


def _answers(material: evaluated.NeuMIP, held: Batch, *, device: str, matrix: Matrix) -> Array:
    return evaluate_on_device(
        material, held.uv, held.light, held.view, held.footprint, device=device, matrix=matrix
    )
