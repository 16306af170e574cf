"""The lamp during a run: lit when it should be, steady, and alive."""

from __future__ import annotations

from typing import final

import numpy as np

from btfkit.devices.base import Exposure, Rig
from btfkit.errors import DeviceError

# A lit lamp reads about 1; what is far from that has gone out, or never was this lamp.
_DIM, _GLARING, _DARK = 0.5, 2.0, 0.05
_STEP_S, _CHANGE, _READINGS = 30.0, 1e-3, 8


class LampError(DeviceError):
    """The lamp does not burn as it should; lighting it again may help."""


@final
class Lighting:
    """Which source burns.

    Args:
        rig: open. longest_s: that a source is waited for to become steady; 0 for not at all.
    """

    def __init__(self, rig: Rig, longest_s: float) -> None:
        self._rig, self._longest_s = rig, longest_s
        self._source: str | None = None
        self._known = self._warm = False

    def use(self, source: str | None) -> None:
        """Light a source alone, and wait until it is steady.

        Raises:
            LampError: it does not become so.
        """
        if source != self._source or not self._known:
            self._rig.light.switch(source)
            self._source, self._known, self._warm = source, True, False
        if source is not None and not self._warm:
            self._warm_up()
            self._warm = True

    def relight(self) -> None:
        """Put everything out: a rig may take a lamp that it believes lit for lit."""
        self._rig.light.switch(None)
        self._source, self._known, self._warm = None, True, False

    def check(self, source: str | None, exposure: Exposure) -> None:
        """Refuse a frame under another light than it should have.

        Raises:
            LampError: the monitor says so.
        """
        if source is None and exposure.lamp > _DARK:
            raise LampError(f"the lamp reads {exposure.lamp:.3g} in a dark frame")
        if source is not None and not _DIM < exposure.lamp < _GLARING:
            raise LampError(f"the {source} reads {exposure.lamp:.3g} of its nominal power")

    def _warm_up(self) -> None:
        if self._longest_s <= 0:
            return
        before, waited = self._power(), 0.0
        while waited < self._longest_s:
            self._rig.wait(_STEP_S)
            waited += _STEP_S
            now = self._power()
            if now > _DIM and abs(now / before - 1) < _CHANGE:
                return
            before = max(now, 1e-9)
        raise LampError(f"the lamp has not settled in {waited:g} s: its monitor reads {before:.4g}")

    def _power(self) -> float:
        return float(np.mean([self._rig.light.reading() for _ in range(_READINGS)]))
