"""The lamp of the twin: it warms up, drifts, and is watched by a monitor."""

from __future__ import annotations

import math
from typing import final

import numpy as np

from btfkit.devices.twin.imperfections import Imperfections

NONE, LAMP, PANEL = 0, 1, 2
_WARM_UP, _WARM_UP_S = 0.08, 240.0
_NOISE = 2e-4
# Amplitude and period, seconds, of what the power wanders by.
_DRIFT = ((3e-3, 9000.0), (2e-3, 4100.0), (7e-4, 700.0), (3e-4, 130.0))


@final
class Lamp:
    """A lamp and a flat-field panel; one at a time is lit.

    Attributes:
        source: `NONE`, `LAMP` or `PANEL`.
    """

    def __init__(self, imperfections: Imperfections, rng: np.random.Generator) -> None:
        self._warm_up = imperfections.of("warm-up", _WARM_UP)
        self._drift = imperfections.of("lamp-drift", 1.0)
        self._noise = imperfections.of("monitor", _NOISE)
        self._phases = rng.uniform(0, 2 * math.pi, len(_DRIFT))
        self._rng = rng
        self._since_s = 0.0
        self._dead = False
        self.source = NONE

    def switch(self, source: int, time_s: float) -> None:
        """Light one source alone; lighting again what burns changes nothing."""
        if source != self.source or self._dead:
            self._since_s = time_s
        self.source, self._dead = source, False

    def fail(self) -> None:
        """Go out, until somebody switches again."""
        self._dead = True

    def power(self, time_s: float) -> float:
        """Of what is lit, relative to nominal; 0 when dark."""
        if self.source == NONE or self._dead:
            return 0.0
        warm = 1 + self._warm_up * math.exp(-(time_s - self._since_s) / _WARM_UP_S)
        waves = (
            a * math.sin(2 * math.pi * time_s / period + phase)
            for (a, period), phase in zip(_DRIFT, self._phases, strict=True)
        )
        return warm * (1 + self._drift * sum(waves))

    def monitor(self, time_s: float) -> float:
        """What its photodiode reads."""
        return self.power(time_s) * (1 + self._noise * float(self._rng.standard_normal()))
