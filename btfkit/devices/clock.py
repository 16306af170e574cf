"""Time as a rig sees it: the wall's, or a twin's, which passes only when somebody waits."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from typing import final


class Clock(ABC):
    """Seconds that pass."""

    @abstractmethod
    def now(self) -> float:
        """Seconds since some beginning."""

    @abstractmethod
    def wait(self, seconds: float) -> None:
        """Return so much later."""


@final
class WallClock(Clock):
    """The time of this machine."""

    def now(self) -> float:
        return time.monotonic()

    def wait(self, seconds: float) -> None:
        time.sleep(max(seconds, 0.0))
