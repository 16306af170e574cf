"""The named parts of a fit, the time that each took, and how a budget is shared among them."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import final

Told = Callable[[str, "float | None"], None]
# What an evaluation may take of a budget, and what it needs to say anything, seconds.
_EVALUATING, _LEAST_EVALUATING_S = 0.1, 2.0
# What training keeps of a budget, whatever starting takes.
_LEAST_TRAINING = 0.25


@final
class Phases:
    """Where a fit stands: reading, starting, training, writing, evaluating.

    Args:
        budget_s: wall time from the end of reading to the end; None where steps decide.
        told: called with (name, seconds left for the whole or None) when a part begins.

    Attributes:
        seconds: wall time of every part so far.
    """

    def __init__(self, budget_s: float | None, told: Callable[[str, float | None], None] | None):
        self.seconds: dict[str, float] = {}
        self._budget_s, self._told = budget_s, told
        self._now, self._since = "", time.perf_counter()

    def begin(self, name: str) -> None:
        """The part before ends here; a part may go on after another."""
        self.end()
        self._now = name
        if self._told:
            self._told(name, self._left_s())

    def end(self) -> None:
        """The present part ends."""
        now = time.perf_counter()
        if self._now:
            self.seconds[self._now] = self.seconds.get(self._now, 0.0) + now - self._since
        self._now, self._since = "", now

    def reading(self, progress: Callable[[int, int], None] | None) -> Callable[[int, int], None]:
        """`progress` of what is read; once all is, starting begins."""

        def told(done: int, total: int) -> None:
            if progress:
                progress(done, total)
            if done >= total and self._now == "reading":
                self.begin("starting")

        return told

    @property
    def whole_s(self) -> float:
        """Seconds of all parts that have ended."""
        return sum(self.seconds.values())

    def training_s(self) -> float | None:
        """What training may take, once everything has been started."""
        left = self._left_s()
        if left is None or self._budget_s is None:
            return None
        rest = left - min(self.evaluating_s() or 0.0, self._budget_s / 2)
        return max(rest, _LEAST_TRAINING * self._budget_s)

    def late(self) -> bool:
        """Whether starting took so long that training had its least share, beyond the budget."""
        if self._budget_s is None:
            return False
        return self.seconds.get("starting", 0.0) > (1 - _LEAST_TRAINING) * self._budget_s

    def evaluating_s(self) -> float | None:
        """What an evaluation may take: a tenth of the budget, at least 2 s; None for no limit."""
        if self._budget_s is None:
            return None
        return max(_EVALUATING * self._budget_s, _LEAST_EVALUATING_S)

    def _left_s(self) -> float | None:
        if self._budget_s is None or self._now == "reading":
            return None
        spent = self.whole_s - self.seconds.get("reading", 0.0)
        return max(self._budget_s - spent - (time.perf_counter() - self._since), 0.0)
