"""NeuMIP while it is fitted: the schedule of its steps, which an engine takes.

Source: Kuznetsov et al., "NeuMIP: Multi-Resolution Neural Materials", ACM TOG 40(4), 2021,
sections 3 and 4. What we changed and what it bought: docs/neumip.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar, final

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import BTF
from btfkit.fitting.loop import State, Trainable
from btfkit.fitting.neumip.data import Batch
from btfkit.fitting.neumip.engines.base import MOMENTS, PARAMETERS, Engine, Step
from btfkit.fitting.neumip.engines.compiled import Compiled, OnCPU
from btfkit.fitting.neumip.recipe import Recipe
from btfkit.fitting.neumip.settings import INPUTS, Settings, Stepped
from btfkit.fitting.neumip.start import begin_from, initial_texels, initial_weights
from btfkit.fitting.prior.pairs import Guesses, guesses
from btfkit.fitting.schedule import pace
from btfkit.materials.neumip import material as evaluated
from btfkit.materials.neumip.arrays import aligned
from btfkit.materials.neumip.spec import NeuMIPSpec
from btfkit.native.neural import Loss, available
from btfkit.native.neural.layout import Array

if TYPE_CHECKING:
    from btfkit.fitting.processes import Processes

_SMOOTH_STEPS = 16
_SMOOTH_HALVES = 5
# Direction pairs for which a decay of 1 is right; docs/neumip.md has the measurements.
_DECAY_PAIRS = 60
# Halvings of the first batches where textures begin from a guess, and where they end.
_SMALLER, _SMALLEST = 4, 2**12


S = TypeVar("S", bound=Stepped)


class Marching(Recipe[S]):
    """What an engine takes the steps of: `neumip`, and `sbtf` on curved surfaces."""

    def _guessed(self, btf: BTF, train: NDArray[np.intp], levels: int) -> Guesses | None:
        share, seed = self.settings.guessed, self._generators.seed
        return guesses(btf, train, levels=levels, share=share, seed=seed)

    def _begin(self, rng: np.random.Generator) -> None:
        layout = self.layout
        offset, decoder = layout.split(np.zeros(layout.weights, np.float32))
        if layout.offset:
            initial_weights(layout.offset[1], offset, rng, self.settings.omega)
        initial_weights(layout.decoder, decoder, rng, self.settings.omega)
        flat = np.concatenate([offset, decoder])
        arrays = {"weights": flat, "texels": initial_texels(layout, rng)}
        if self._guesses:
            begin_from(self._guesses.guess, layout, arrays["texels"])
        for name in PARAMETERS:
            for moment in MOMENTS:
                room = aligned(layout.texels) if name == "texels" else np.zeros_like(flat)
                arrays[f"{name}.{moment}"] = room
        loss: Loss = self.settings.loss  # type: ignore[assignment]
        kind: type[OnCPU] = Compiled
        if not available():
            from btfkit.fitting.neumip.engines.plain import Plain as kind
        self.engine: Engine[Any] = kind(layout, arrays, self._source, loss)

    def join(self, processes: Processes) -> None:
        from btfkit.fitting.neumip.engines.together import Together, follow

        if processes.rank:
            follow(self.engine, processes)
        else:
            self.engine = Together(self.engine, processes)

    def part(self) -> bool:
        alone = self.engine.ended()
        if alone is not None:
            self.engine = alone
        return alone is not None

    def _current(self) -> tuple[Array, Array]:
        return self.engine.parameters()

    def _tensors(self) -> State:
        return self.engine.state()

    def _put(self, state: Mapping[str, Any]) -> None:
        self.engine.restore(state)

    def _answers(self, material: evaluated.NeuMIPMaterial, held: Batch) -> Array:
        return self.engine.answers(material, held)

    def step(self, progress: float) -> float:
        batch = self.engine.batch(self._steps, self._batch_size(progress))
        self._steps += 1
        self.queries += len(batch)
        return self.engine.take(batch, self.plan(progress, len(batch)))

    def _moved_to(self, device: str, matrix: str = "bf16") -> Trainable:
        """The same model on a torch device. matrix: as in `OnDevice`."""
        from btfkit.fitting.neumip.engines.device import OnDevice

        self.engine = OnDevice(
            self.layout, self.engine.state(), self._source, device,
            loss=self.settings.loss, matrix=matrix,  # type: ignore[arg-type]
        )  # fmt: skip
        return self

    def plan(self, progress: float, count: int) -> Step:
        """What the step at `progress` does with the gradient of `count` queries."""
        s = self.settings
        factor = self._rate * pace(progress, warm_up=0.02, head_start=1e-3, least=0.005)
        rates = (s.rate * factor, s.texture_rate * factor)
        smooth = s.smooth if self._steps % _SMOOTH_STEPS == 0 else 0.0
        return Step(
            self._steps,
            rates,
            (0.9, s.beta2),
            # A batch that touches few texels leaves the others, moments and all, as they are.
            dense=6 * count > self.layout.texels,
            # Few directions say little about those between: small weights bend little.
            kept=1 - rates[0] * s.decay * min(1.0, _DECAY_PAIRS / max(self._pairs, 1)),
            blur=smooth * 2 ** (-_SMOOTH_HALVES * progress),
        )

    def _batch_size(self, progress: float) -> int:
        if self.settings.batch:
            return self.settings.batch
        h, w = self.spec.size
        # 2^13 at 128 x 128, 2^16 at 512 x 512; larger towards the end, where noise costs most.
        size = 2**13 * (h * w / 2**14) ** 0.75
        if self._guesses:
            # Textures begin near where they end, and the decoder learns by steps, not by queries.
            smaller = size * 2.0 ** -max(_SMALLER * (1 - 2 * progress), 0)
            size = max(smaller, min(size, _SMALLEST))
        return int(np.clip(2 ** round(math.log2(size)), 2**10, 2**17)) << int(progress > 0.7)


@final
class NeuMIP(Marching[Settings]):
    """NeuMIP with what docs/neumip.md found to be better."""

    model: ClassVar[str] = "neumip"
    material_type: ClassVar[type[evaluated.NeuMIPMaterial]] = evaluated.NeuMIP
    settings_type = Settings

    def _spec(self, size: tuple[int, int], levels: int) -> NeuMIPSpec:
        return spec_of(self.settings, size, levels, len(self._header.channels))

    def on_device(self, device: str) -> Trainable:
        return self._moved_to(device, self.settings.matrix)


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
        hidden=(s.width,) * s.layers,
        offset_hidden=(s.offset_width,) * 3,
        activation=s.activation,  # type: ignore[arg-type]
        offset_activation=s.offset_activation,  # type: ignore[arg-type]
        directions=INPUTS[s.inputs],
        output=s.output,  # type: ignore[arg-type]
        channels=channels,
        precision=s.precision,  # type: ignore[arg-type]
        networks=s.networks,  # type: ignore[arg-type]
        finer=s.finer if levels > 1 else 0.0,
    )
