"""A model that is trained by steps and the gains of its data, found in turns."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.fitting.gains import Found
from btfkit.fitting.loop import State, Trainable
from btfkit.materials.base import Material
from btfkit.relief.relief import Relief

# Shares of a budget at which gains are found. Not before: what a young model misses of a pair would
# be taken for its gain, and never learnt.
_DUE = (0.75, 0.9)


@final
class Gained(Trainable):
    """A trainable that learns from textures divided by gains, found between its steps."""

    def __init__(self, inner: Trainable, found: Found) -> None:
        self.model = inner.model  # type: ignore[misc]
        self.inner, self.found = inner, found
        self.masked, self._done = inner.masked, 0

    def step(self, progress: float) -> float:
        if self._done < len(_DUE) and progress >= _DUE[self._done]:
            self._done += 1
            self.found.update(self.inner.material())
        loss = self.inner.step(progress)
        self.queries = self.inner.queries
        return loss

    def material(self) -> Material:
        return self.inner.material()

    def score(self) -> float:
        return self.inner.score()

    def state(self) -> State:
        found = {f"inner.{name}": value for name, value in self.inner.state().items()}
        found["gains"] = self.found.values.copy()
        found["gains.done"] = np.array([self._done])
        return found

    def restore(self, state: Mapping[str, Any]) -> None:
        prefix = "inner."
        self.inner.restore(
            {n.removeprefix(prefix): v for n, v in state.items() if n.startswith(prefix)}
        )
        self.queries = self.inner.queries
        self.found.values = state["gains"]
        self._done = int(state["gains.done"][0])

    def training_arrays(self) -> dict[str, NDArray[Any]]:
        return self.inner.training_arrays() | self.found.arrays()

    def settled(self, progress: float) -> bool:
        # Errors on held-out pairs know nothing of gains: all turns come first.
        return progress >= _DUE[-1] and self.inner.settled(progress)

    def untrained(self) -> tuple[str, ...]:
        return self.inner.untrained()

    def know(self, relief: Relief) -> None:
        self.inner.know(relief)

    def stated(self) -> dict[str, Any]:
        return self.inner.stated() | self.found.stated()

    def slow_down(self) -> None:
        self.inner.slow_down()
