"""NeuMIP while it is fitted, through the kernels, or through torch where they were not built.

Source: Kuznetsov et al., "NeuMIP: Multi-Resolution Neural Materials", ACM TOG 40(4), 2021,
sections 3 and 4. What we changed and what it bought: docs/neumip.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sized
from dataclasses import dataclass
from typing import ClassVar, Generic, TypeVar, final

import numpy as np
import torch

from btfkit.fitting.adam import adam_plain
from btfkit.fitting.loop import Trainable
from btfkit.fitting.neumip.data import Batch
from btfkit.fitting.neumip.recipe import Recipe, torch_loss
from btfkit.fitting.neumip.settings import INPUTS, Settings
from btfkit.fitting.neumip.start import initial_texels, initial_weights
from btfkit.materials.base import Material
from btfkit.materials.neumip import material as evaluated
from btfkit.materials.neumip.arrays import aligned
from btfkit.materials.neumip.spec import NeuMIPSpec
from btfkit.native.neural import Kernel, available
from btfkit.native.neural.blur import blur
from btfkit.native.neural.layout import Array

_SMOOTH_STEPS = 16
_SMOOTH_HALVES = 5
B = TypeVar("B", bound=Sized)


@final
@dataclass(frozen=True, eq=False)
class Step(Generic[B]):
    """A batch, and what is done with its gradient.

    Attributes:
        number: of the step, from 1. rates: of Adam, for the weights and for the texels.
        dense: whether texels without a gradient move, too.
        kept: factor on the weights afterwards. blur: of the finest textures afterwards, texels.
    """

    batch: B
    number: int
    rates: tuple[float, float]
    dense: bool
    kept: float
    blur: float


@final
class NeuMIP(Recipe):
    """NeuMIP through the kernels, or through torch where they were not built."""

    model: ClassVar[str] = "neumip"
    material_type: ClassVar[type[Material]] = evaluated.NeuMIP

    def _spec(self, size: tuple[int, int], levels: int) -> NeuMIPSpec:
        return spec_of(self.settings, size, levels, len(self._header.channels))

    def _initial(self, rng: np.random.Generator) -> dict[str, Array]:
        layout = self.layout
        offset, decoder = layout.split(np.zeros(layout.weights, np.float32))
        if layout.offset:
            initial_weights(layout.offset[1], offset, rng, self.settings.omega)
        initial_weights(layout.decoder, decoder, rng, self.settings.omega)
        flat = np.concatenate([offset, decoder])
        texels = initial_texels(layout, rng)
        found = {"weights": flat, "texels": texels}
        for name in ("weights", "texels"):
            for moment in ("first", "second"):
                room = aligned(layout.texels) if name == "texels" else np.zeros_like(flat)
                found[f"{name}.{moment}"] = room
        self._kernel = Kernel(layout) if available() else None
        return found

    def _current(self) -> tuple[Array, Array]:
        return self._arrays["weights"], self._arrays["texels"]

    def next_step(self, progress: float, draw: Callable[[int, int], B]) -> Step[B]:
        """What the step at `progress` is, its batch drawn as by `source`; it counts as taken."""
        s = self.settings
        batch = draw(self._steps, self._batch_size(progress))
        self._steps += 1
        self.queries += len(batch)
        factor = self._rate * min(1.0, (progress + 1e-3) / 0.02)
        factor *= 0.005 + 0.995 * (0.5 + 0.5 * math.cos(math.pi * progress))
        rates = (s.rate * factor, s.texture_rate * factor)
        smooth = s.smooth if self._steps % _SMOOTH_STEPS == 0 else 0.0
        return Step(
            batch,
            self._steps,
            rates,
            # A batch that touches few texels leaves the others, moments and all, as they are.
            dense=6 * len(batch) > self.layout.texels,
            # Few directions say little about those between: small weights bend little.
            kept=1 - rates[0] * self._decay,
            blur=smooth * 2 ** (-_SMOOTH_HALVES * progress),
        )

    def step(self, progress: float) -> float:
        s, arrays = self.settings, self._arrays
        step = self.next_step(progress, self.source.batch)
        gradient = self._kernel_gradient if self._kernel else self._torch_gradient
        loss = gradient(step.batch)
        parameters = [
            (arrays[n], arrays[f"{n}.first"], arrays[f"{n}.second"]) for n in ("weights", "texels")
        ]
        if self._kernel:
            self._kernel.adam(
                parameters[0], parameters[1], lr=step.rates, step=step.number,
                betas=(0.9, s.beta2), dense=step.dense,
            )  # fmt: skip
        else:
            for slots, rate, grown in zip(parameters, step.rates, self._gradients, strict=True):
                adam_plain(slots, grown, rate, step.number, (0.9, s.beta2), dense=step.dense)
        arrays["weights"] *= np.float32(step.kept)
        if step.blur:
            self._smooth(step.blur)
        # A depth that is no number is looked up at a border, with a finite loss: look at what
        # depths come from.
        good = np.isfinite(arrays["weights"]).all()
        if self.layout.heights:
            good &= np.isfinite(self.layout.surface(arrays["texels"])).all()
        return loss if good else math.nan

    def on_device(self, device: str) -> Trainable:
        from btfkit.fitting.neumip.engines.device import OnDevice

        return OnDevice(self, device)

    def _batch_size(self, progress: float) -> int:
        if self.settings.batch:
            return self.settings.batch
        h, w = self.spec.size
        # 2^13 at 128 x 128, 2^16 at 512 x 512; larger towards the end, where noise costs most.
        size = 2**13 * (h * w / 2**14) ** 0.75
        return int(np.clip(2 ** round(math.log2(size)), 2**10, 2**17)) << int(progress > 0.7)

    def _kernel_gradient(self, batch: Batch) -> float:
        assert self._kernel is not None
        loss, _ = self._kernel.train(
            *self._current(), batch.uv, batch.light, batch.view, batch.footprint,
            batch.target, batch.weight, loss=self.settings.loss,  # type: ignore[arg-type]
        )  # fmt: skip
        return loss

    def bare_gradient(self, count: int) -> Callable[[], object]:
        """A call that takes the gradient of one and the same batch again: the kernel alone."""
        batch = self._source.batch(0, count)
        return lambda: self._kernel_gradient(batch)

    def _torch_gradient(self, batch: Batch) -> float:
        weights, texels = (torch.from_numpy(a).requires_grad_() for a in self._current())
        loss = torch_loss(self.layout, weights, texels, batch, self.settings.loss)
        found = torch.autograd.grad(loss, (weights, texels))
        self._gradients = tuple(part.numpy() for part in found)
        return float(loss.detach())

    def _smooth(self, sigma: float) -> None:
        """Blur the finest textures: a relief is found from its large forms to its small ones."""
        for texture in self.layout.finest(self._arrays["texels"]):
            blur(texture, sigma**2, wrap=self.layout.wrap)


def spec_of(s: Settings, size: tuple[int, int], levels: int, channels: int = 3) -> NeuMIPSpec:
    """The model that settings ask for."""
    return NeuMIPSpec(
        size,
        levels,
        features=s.features,
        coarse=s.coarse,
        light=s.light if s.offset else 0,
        offset=s.offset,
        frames=min(s.frames, s.features // 3),
        heights=bool(s.offset) and s.depth == "heights",
        hidden=(s.width,) * 3,
        offset_hidden=(s.offset_width,) * 3,
        activation=s.activation,  # type: ignore[arg-type]
        offset_activation=s.offset_activation,  # type: ignore[arg-type]
        directions=INPUTS[s.inputs],
        output=s.output,  # type: ignore[arg-type]
        channels=channels,
        precision=s.precision,  # type: ignore[arg-type]
        networks=s.networks,  # type: ignore[arg-type]
    )
