"""How long to expose: a quick look or two, then a bracket that just does not saturate."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit.devices.capture.plan import Bracket

# The brightest pixels of the shortest exposure stand here between black and saturation.
_AIM = 0.7
_TOO_BRIGHT, _TOO_DARK = 0.95, 0.02
_LOOKS, _STEP = 6, 12.0
# Exposures lie on a grid of thirds of a stop, so that darks of the same times can be taken.
_THIRDS = 3
# All but this share of the pixels may not saturate.
_BRIGHT_SHARE = 1e-3


def on_grid(seconds: float) -> float:
    """The next shorter third of a stop."""
    return float(2 ** (math.floor(_THIRDS * math.log2(seconds) + 1e-9) / _THIRDS))


def metered(
    look: Callable[[float], NDArray[np.uint16]],
    guess_s: float,
    bracket: Bracket,
    *,
    sensor: Mapping[str, Any],
    window: NDArray[np.bool_] | None,
) -> tuple[float, ...]:
    """Exposure times, shortest first.

    Args:
        look: takes a frame of so many seconds.
        guess_s: where to begin.
        bracket: how many, in what ratio, and none longer than what.
        sensor: black, white and limits of the camera.
        window: (h, w) pixels that count; None looks at the very brightest of the frame.

    Returns:
        At most `bracket.count` different times; fewer where the longest would be too long.
    """
    low, high = (float(limit) for limit in sensor["exposure_s"])
    longest = min(bracket.longest_s, high)
    span = float(sensor["white"]) - float(sensor["black"])
    time_s = min(max(on_grid(guess_s), low), longest)
    for _ in range(_LOOKS):
        level = (_brightest(look(time_s), window) - float(sensor["black"])) / span
        if level > _TOO_BRIGHT and time_s > low:
            time_s = max(on_grid(time_s / _STEP), low)
        elif level < _TOO_DARK and time_s < longest:
            time_s = min(on_grid(time_s * _STEP), longest)
        else:
            break
    first = min(max(time_s * _AIM / max(level, 1e-3), low), longest)
    times = [
        min(max(on_grid(first), low) * bracket.ratio**k, longest) for k in range(bracket.count)
    ]
    return tuple(dict.fromkeys(times))


def _brightest(image: NDArray[np.uint16], window: NDArray[np.bool_] | None) -> float:
    if window is None or not window.any():
        return float(image.max())
    return float(np.quantile(image[window], 1 - _BRIGHT_SHARE))
