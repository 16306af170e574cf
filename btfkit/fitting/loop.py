"""The one training loop: budget, best state, resumption, divergence, interruption."""

from __future__ import annotations

import json
import math
import time
import warnings
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, final

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from btfkit.errors import FitError, FormatError
from btfkit.files import whole
from btfkit.materials.base import Material
from btfkit.relief.relief import Relief

if TYPE_CHECKING:
    # It takes two seconds to load, and what is trained by compiled kernels does without it.
    import torch
    from torch import Tensor

    from btfkit.fitting.processes import Processes

# What a trainable's steps depend on, by name: arrays, or torch's tensors on the CPU.
State = dict[str, Any]
# Held-out looks at the model: enough for a curve, and a small share of the time. Where time is
# what is shared, they become rarer, so that they take no more than this of it.
_LOOKS, _LOOKING = 12, 0.1
_SAVE_EVERY_S = 60.0
_ROLLBACKS = 3
# A loss this many times the recent median, and above what losses were at first, is a divergence,
# not a hard batch: a few texels at a border may be all that is left of the error.
_DIVERGED = 50.0
# So many losses tell what is usual.
_TOLD = 17


class Trainable(ABC):
    """A model while it is fitted. The loop owns time, the trainable everything else.

    A trainable is deterministic: its state and the generators it was given decide all steps.

    Attributes:
        model: the name in `MODELS`.
        queries: (light, view, texel) samples seen so far.
        masked: texels of the data that are not measured.
    """

    model: ClassVar[str]
    queries: int = 0
    masked: int = 0
    _steps: int = 0
    _rate: float = 1.0

    @abstractmethod
    def step(self, progress: float) -> float:
        """One optimiser step at `progress` in 0..1 of the budget; returns its loss."""

    @abstractmethod
    def material(self) -> Material:
        """The model as it stands, ready to answer."""

    @abstractmethod
    def score(self) -> float:
        """Error on a fixed, small part of the held-out set; lower is better; NaN without one."""

    @abstractmethod
    def state(self) -> State:
        """Everything that later steps depend on, copied: weights, moments, counters."""

    @abstractmethod
    def restore(self, state: Mapping[str, Any]) -> None:
        """Take back what `state` gave."""

    def training_arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays to save beside the material, for later fitting and propagation."""
        return {}

    def settled(self, progress: float) -> bool:
        """Whether the model is whole at `progress`, so that its score counts for the best."""
        del progress
        return True

    def untrained(self) -> tuple[str, ...]:
        """Parts that answer as if never trained, or hardly, one sentence each; none by default."""
        return ()

    def know(self, relief: Relief) -> None:
        """Take what the relief behind the data tells; most models learn it from the data."""
        del relief

    def stated(self) -> dict[str, Any]:
        """Errors that only the training can tell, JSON types, by the report's keys."""
        return {}

    def on_device(self, device: str) -> Trainable | None:
        """The same model trained on a torch device, or None where it knows the CPU alone."""
        del device
        return None

    def join(self, processes: Processes) -> None:
        """Take every step together with other processes.

        In the first one this returns at once, in the others when the first has `part`ed.

        Raises:
            FitError: the model is trained by one process alone.
        """
        del processes
        raise FitError(f"{self.model} is fitted by one process", remedy="start it without torchrun")

    def part(self) -> bool:
        """Let the others go; whether there were any."""
        return False

    def slow_down(self) -> None:
        """Halve the learning rates, after a divergence."""
        self._rate *= 0.5

    def _counters(self, *more: int) -> NDArray[np.float64]:
        """Steps, rate, queries and a model's own counters, as a state holds them."""
        numbers = [self._steps, self._rate, self.queries, *more]
        return np.array(numbers, np.float64)

    def _count_from(self, counters: Any) -> list[int]:
        """Take back what `_counters` gave; returns the model's own."""
        steps, self._rate, queries, *more = counters.tolist()
        self._steps, self.queries = int(steps), int(queries)
        return [int(number) for number in more]


@final
@dataclass
class Run:
    """Where a run stands.

    Attributes:
        budget_s: wall time of the training alone, or None.
        steps: steps to take, or None.
        budget_cpu_s: CPU seconds of all threads, or None; exactly one of the three is set.
        done: steps taken. elapsed_s, cpu_s: seconds of training so far.
        curve: (elapsed seconds, step, score) at every look.
        interrupted: whether the user ended it.
    """

    budget_s: float | None
    steps: int | None
    done: int = 0
    elapsed_s: float = 0.0
    cpu_s: float = 0.0
    curve: list[tuple[float, int, float]] = field(default_factory=list)
    best_score: float = math.inf
    rollbacks: int = 0
    interrupted: bool = False
    budget_cpu_s: float | None = None

    def progress(self, since_s: float = 0.0) -> float:
        """Share of the budget that is spent, 0..1."""
        if self.steps is not None:
            return min(self.done / self.steps, 1.0) if self.steps else 1.0
        if self.budget_cpu_s is not None:
            return min(self.cpu_s / self.budget_cpu_s, 1.0)
        return min((self.elapsed_s + since_s) / (self.budget_s or 1.0), 1.0)


def train(
    trainable: Trainable,
    run: Run,
    *,
    generators: Generators,
    state_file: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
    best: Mapping[str, Any] | None = None,
    look: Callable[[Run], None] | None = None,
) -> None:
    """Train until the budget is spent; the trainable ends in its best state.

    Args:
        trainable: what is trained.
        run: fresh, or read by `load_state` to go on; updated in place.
        generators: all randomness of the run.
        state_file: where a resumable state is kept while the run lasts.
        progress: called with (per mille of the budget, 1000).
        best: the best state so far, of a run that goes on.
        look: called after every step; its time is not the run's.

    Raises:
        FitError: the loss diverges and rolling back does not help.
    """
    keeper = _Keeper(trainable, run, generators, state_file, best)
    try:
        while (share := run.progress()) < 1.0:
            start, cpu = time.perf_counter(), time.process_time()
            loss = trainable.step(share)
            run.done += 1
            keeper.after_step(loss)
            if look:
                look(run)
            # Looks and states are a part of what one waits for.
            run.elapsed_s += time.perf_counter() - start
            run.cpu_s += time.process_time() - cpu
            if progress:
                progress(int(1000 * run.progress()), 1000)
    except KeyboardInterrupt:
        run.interrupted = True
        keeper.save()
    keeper.finish()


@final
@dataclass
class Generators:
    """All randomness of a run: one torch and one numpy generator from one seed."""

    seed: int
    numpy: np.random.Generator = field(init=False)

    def __post_init__(self) -> None:
        self.numpy = np.random.default_rng(self.seed)

    @cached_property
    def torch(self) -> torch.Generator:
        """Made when it is asked for."""
        import torch

        return torch.Generator().manual_seed(self.seed)

    def asked(self) -> bool:
        """Whether torch's generator was made."""
        return "torch" in self.__dict__


class _Keeper:
    """Watches a run: looks at the held-out error, keeps the best, rolls back, saves."""

    def __init__(
        self,
        trainable: Trainable,
        run: Run,
        generators: Generators,
        state_file: Path | None,
        best: Mapping[str, Any] | None,
    ) -> None:
        self._trainable, self._run, self._generators = trainable, run, generators
        self._file = state_file
        self._losses: deque[float] = deque(maxlen=64)
        self._at_first: float | None = None
        self._snapshot = trainable.state()
        self._best = best
        self._next_look = (math.floor(run.progress() * _LOOKS) + 1) / _LOOKS
        self._saved_at = time.monotonic()

    def after_step(self, loss: float) -> None:
        recent = float(np.median(self._losses)) if len(self._losses) >= _TOLD else math.inf
        if self._at_first is None and len(self._losses) >= _TOLD:
            self._at_first = recent
        limit = max(_DIVERGED * max(recent, 1e-6), self._at_first or 0.0)
        if not math.isfinite(loss) or loss > limit:
            self._roll_back(loss)
            return
        self._losses.append(loss)
        if self._run.progress() >= self._next_look:
            start = time.perf_counter()
            self._look()
            budget = self._run.budget_s
            # By steps, equal runs look equally often.
            costly = (time.perf_counter() - start) / budget / _LOOKING if budget else 0.0
            self._next_look += max(1 / _LOOKS, costly)
        if self._file and time.monotonic() - self._saved_at > _SAVE_EVERY_S:
            self.save()

    def save(self) -> None:
        """Write the resumable state, if this run keeps one."""
        self._saved_at = time.monotonic()
        if not self._file:
            return
        try:
            save_state(self._file, self._trainable, self._run, self._generators, self._best)
        except (OSError, SafetensorError) as error:
            # What has been trained must not be lost for want of a way to go on with it.
            warnings.warn(
                f"{self._file} cannot be written ({error}): no --resume from here", stacklevel=2
            )

    def finish(self) -> None:
        """Leave the trainable in its best state."""
        self._look()
        if self._best is not None:
            self._trainable.restore(self._best)

    def _look(self) -> None:
        score = self._trainable.score()
        run = self._run
        if not run.curve or run.curve[-1][1] != run.done:
            run.curve.append((run.elapsed_s, run.done, score))
        self._snapshot = self._trainable.state()
        if self._trainable.settled(run.progress()) and score < run.best_score:
            run.best_score = score
            self._best = self._snapshot

    def _roll_back(self, loss: float) -> None:
        run = self._run
        run.rollbacks += 1
        if run.rollbacks > _ROLLBACKS:
            raise FitError(
                f"{self._trainable.model} diverges: loss {loss:.3g} at step {run.done}, after "
                f"{_ROLLBACKS} rollbacks at half the rate each",
                remedy="look for outliers in the data, or set a lower rate",
            )
        self._trainable.restore(self._snapshot)
        self._trainable.slow_down()
        self._losses.clear()


def save_state(
    path: Path,
    trainable: Trainable,
    run: Run,
    generators: Generators,
    best: Mapping[str, Any] | None,
) -> None:
    """Write what a later run needs to go on with the very same trajectory."""
    record = {
        "model": trainable.model,
        "queries": trainable.queries,
        "run": {name: getattr(run, name) for name in _RUN_FIELDS},
        "numpy": generators.numpy.bit_generator.state,
    }
    tensors = {f"now.{name}": value for name, value in trainable.state().items()}
    tensors |= {f"best.{name}": value for name, value in (best or {}).items()}
    if generators.asked():
        tensors["torch_generator"] = generators.torch.get_state()
    arrays = {
        name: np.array(value if isinstance(value, np.ndarray) else value.numpy(), order="C")
        for name, value in tensors.items()
    }
    with whole(path, force=True) as partial:
        save_file(arrays, partial, {"btfkit_state": json.dumps(record)})


_RUN_FIELDS = (
    "budget_s", "steps", "done", "elapsed_s", "cpu_s", "curve", "best_score", "rollbacks",
)  # fmt: skip


def load_state(path: Path, trainable: Trainable, run: Run, generators: Generators) -> State | None:
    """Take up a run where `save_state` left it; returns the best state so far.

    Raises:
        FormatError: the file is damaged or of another model.
    """
    try:
        with safe_open(path, framework="np") as file:
            record = json.loads(file.metadata()["btfkit_state"])
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        raise FormatError(
            path, f"not a readable state ({error})", remedy="start without --resume"
        ) from error
    if record["model"] != trainable.model:
        raise FormatError(path, f"a state of {record['model']}, not of {trainable.model}")
    wanted = (run.budget_s, run.steps)
    for name, value in record["run"].items():
        setattr(run, name, [tuple(p) for p in value] if name == "curve" else value)
    run.budget_s, run.steps = wanted
    trainable.queries = record["queries"]
    generators.numpy.bit_generator.state = record["numpy"]
    if "torch_generator" in arrays:
        generators.torch.set_state(_tensor(arrays.pop("torch_generator")))
    own = trainable.state()
    now, best = (_as_in(own, arrays, prefix) for prefix in ("now.", "best."))
    trainable.restore(now)
    return best or None


def _as_in(own: State, arrays: Mapping[str, NDArray[Any]], prefix: str) -> State:
    """The arrays below a prefix, of the kinds that a state holds them in."""
    if all(isinstance(value, np.ndarray) for value in own.values()):
        torchless = set(arrays)
    else:
        # Moments that no step has made yet are torch's, too.
        torchless = {prefix + name for name, value in own.items() if isinstance(value, np.ndarray)}
    return {
        name.removeprefix(prefix): array if name in torchless else _tensor(array)
        for name, array in arrays.items()
        if name.startswith(prefix)
    }


def _tensor(array: NDArray[Any]) -> Tensor:
    import torch

    return torch.from_numpy(array)


def tensors_of(modules: Mapping[str, torch.nn.Module], optimisers: Mapping[str, Any]) -> State:
    """Copies of all weights and moments, by flat names: the heart of most `state`s."""
    import torch

    found: dict[str, Any] = {}
    for name, module in modules.items():
        for key, value in module.state_dict().items():
            found[f"{name}.{key}"] = value
    for name, optimiser in optimisers.items():
        for index, slots in optimiser.state_dict()["state"].items():
            for key, value in slots.items():
                found[f"{name}.{index}.{key}"] = torch.as_tensor(value)
        rates = [group["lr"] for group in optimiser.param_groups]
        found[f"{name}.rates"] = torch.tensor(rates, dtype=torch.float64)
    return {name: value.detach().clone() for name, value in found.items()}


def restore_tensors(
    state: Mapping[str, Tensor],
    modules: Mapping[str, torch.nn.Module],
    optimisers: Mapping[str, Any],
) -> None:
    """Give back to modules and optimisers what `tensors_of` took from them."""
    for name, module in modules.items():
        prefix = f"{name}."
        own = {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}
        module.load_state_dict(own)
    for name, optimiser in optimisers.items():
        packed = optimiser.state_dict()
        slots: dict[int, dict[str, Tensor]] = {}
        for key, value in state.items():
            if key.startswith(f"{name}.") and key != f"{name}.rates":
                index, slot = key.removeprefix(f"{name}.").split(".", 1)
                slots.setdefault(int(index), {})[slot] = value.clone()
        packed["state"] = slots
        for group, rate in zip(packed["param_groups"], state[f"{name}.rates"], strict=True):
            group["lr"] = float(rate)
        optimiser.load_state_dict(packed)
