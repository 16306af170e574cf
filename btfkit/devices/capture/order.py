"""In which order poses are taken: slow axes seldom, every axis from below."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from btfkit.devices.base import Axis
from btfkit.devices.poses import Floats
from btfkit.devices.usb import APPROACH_MM, APPROACH_RAD

_SAME = 1e-6


def ordered(places: Floats, axes: Sequence[Axis]) -> NDArray[np.intp]:
    """The order of least travel among those that sort by one axis after another.

    Sorted upwards, an axis comes from below and overshoots only when one before it has moved on.

    Args:
        places: (n, a) of each pose. axes: a of them.

    Returns:
        (n,) rows of `places`.
    """
    keys = np.round(places / _SAME).astype(np.int64)
    best: NDArray[np.intp] = np.arange(len(places))
    least = travel_s(places, axes).sum()
    for rank in itertools.permutations(range(len(axes))):
        order = np.lexsort(tuple(keys[:, axis] for axis in reversed(rank)))
        time = travel_s(places[order], axes).sum()
        if time < least - 1e-9:
            best, least = order, time
    return best


def travel_s(places: Floats, axes: Sequence[Axis]) -> Floats:
    """(n - 1,) seconds from each pose to the next, all axes at once, as the stage moves.

    Args:
        places: (n, a). axes: a of them.
    """
    steps = np.diff(places, axis=0)
    longest = np.zeros(len(steps))
    second = np.zeros(len(steps))
    for column, axis in enumerate(axes):
        margin = APPROACH_MM if axis.kind == "linear" else APPROACH_RAD
        step = steps[:, column]
        down = step < -axis.resolution
        longest = np.maximum(longest, _rest_to_rest(np.where(down, step - margin, step), axis))
        second = np.maximum(
            second, np.where(down, _rest_to_rest(np.full_like(step, margin), axis), 0)
        )
    return longest + second


def _rest_to_rest(step: Floats, axis: Axis) -> Floats:
    """As `Axis.travel_s`, of many ways."""
    way = np.abs(step)
    ramp = axis.velocity**2 / axis.acceleration
    return np.where(
        way < ramp,
        2 * np.sqrt(way / axis.acceleration),
        way / axis.velocity + axis.velocity / axis.acceleration,
    )
