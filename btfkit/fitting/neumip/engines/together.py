"""An engine in each of several processes: gradients are means over them, steps are the same."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Mapping, Sequence, Sized
from dataclasses import astuple, dataclass
from typing import Any, final

import torch
from torch import Tensor

from btfkit.fitting.neumip.data import Batch
from btfkit.fitting.neumip.engines.base import Engine, Step
from btfkit.fitting.processes import Processes, uninterrupted
from btfkit.materials.neumip.material import NeuMIPMaterial
from btfkit.native.neural.layout import Array

# What the first process is about to do; numbers follow in the same message.
_END, _STEP, _RESTORE = 0.0, 1.0, 2.0
_NUMBERS = 12


@final
@dataclass(frozen=True)
class Part:
    """What one process draws of a batch; its length is that of the whole."""

    own: Sized
    size: int

    def __len__(self) -> int:
        return self.size


@final
class Together(Engine[Part]):
    """The first process' engine: every step is told to the others, which take it too.

    Args:
        engine: this process' own. processes: all of them.
    """

    def __init__(self, engine: Engine[Any], processes: Processes) -> None:
        self._engine, self._all, self.device = engine, processes, engine.device
        # They may have begun from other numbers.
        self.restore(engine.state())

    def batch(self, number: int, count: int) -> Part:
        share = -(-count // self._all.size)
        self._drawn = number, share
        return Part(self._engine.batch(number, share), share * self._all.size)

    def take(self, batch: Part, step: Step) -> float:
        number, count = self._drawn
        with uninterrupted():
            self._tell(_STEP, number, count, *_flat(step))
            return _shared_step(self._engine, self._all, batch.own, step)

    def pull(self, batch: Part) -> tuple[Tensor, Tensor, Tensor]:
        return self._engine.pull(batch.own)

    def push(self, loss: Tensor, gradients: Sequence[Tensor], step: Step) -> float:
        return self._engine.push(loss, gradients, step)

    def parameters(self) -> tuple[Array, Array]:
        return self._engine.parameters()

    def change(self, edit: Callable[[Array, Array], None]) -> None:
        self._engine.change(edit)
        self.restore(self.state())

    def state(self) -> dict[str, Array]:
        return self._engine.state()

    def restore(self, state: Mapping[str, Array]) -> None:
        with uninterrupted():
            self._tell(_RESTORE)
            # A state may hold more than its engine's.
            for name in sorted(self._engine.state()):
                self._all.tell(torch.tensor(state[name], device=self._all.place))
            self._engine.restore(state)

    def answers(self, material: NeuMIPMaterial, held: Batch) -> Array:
        return self._engine.answers(material, held)

    def ended(self) -> Engine[Any]:
        """Let the others go; what goes on alone."""
        with uninterrupted():
            self._tell(_END)
        self._all.close()
        return self._engine

    def _tell(self, *numbers: float) -> None:
        message = torch.zeros(_NUMBERS, dtype=torch.float64)
        message[: len(numbers)] = torch.tensor(numbers, dtype=torch.float64)
        self._all.tell(message.to(self._all.place))


def follow(engine: Engine[Any], processes: Processes) -> None:
    """Take every step that the first process tells of, until it tells the end."""
    if threading.current_thread() is threading.main_thread():
        # Ctrl-C reaches all processes; the first one decides what it means.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    empty = torch.zeros(_NUMBERS, dtype=torch.float64, device=processes.place)
    while (message := processes.tell(empty.clone()).tolist())[0] != _END:
        if message[0] == _RESTORE:
            state = engine.state()
            place = processes.place
            told = {n: processes.tell(torch.tensor(state[n], device=place)) for n in sorted(state)}
            engine.restore({name: tensor.cpu().numpy() for name, tensor in told.items()})
        else:
            number, count = int(message[1]), int(message[2])
            batch = engine.batch(number, count)
            _shared_step(engine, processes, batch, _step(message[3:]))
    processes.close()


def _shared_step(engine: Engine[Any], processes: Processes, batch: Sized, step: Step) -> float:
    loss, weights, texels = processes.mean([part.contiguous() for part in engine.pull(batch)])
    return engine.push(loss, (weights, texels), step)


def _flat(step: Step) -> tuple[float, ...]:
    number, rates, betas, *rest = astuple(step)
    return (number, *rates, *betas, *map(float, rest))


def _step(flat: Sequence[float]) -> Step:
    number, first, second, b1, b2, dense, kept, blur = flat[:8]
    return Step(int(number), (first, second), (b1, b2), bool(dense), kept, blur)
