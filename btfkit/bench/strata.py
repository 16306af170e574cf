"""Pairs held out at every distance from those that are trained on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from btfkit.heldout import Index

# Lower ends of the strata, degrees.
EDGES = (0.0, 10.0, 20.0, 30.0, 45.0)
# Holes that are dug among the training pairs, degrees, while the share of held-out pairs lasts.
_RADII = (50.0, 35.0, 22.0, 22.0)
# What holes may take of that share; the rest are single pairs at random.
_HOLES = 0.75
_TRIES = 64
_ROWS = 256


def split(
    light: NDArray[np.floating], view: NDArray[np.floating], *, holdout: float, seed: int
) -> tuple[Index, Index]:
    """What is trained on and what is held out: single pairs, and all around some pairs.

    Args:
        light, view: (n, 3) unit vectors.
        holdout: share that is held out, at least one pair.

    Returns:
        indices, each ascending.
    """
    n = len(light)
    rng = np.random.default_rng([seed, 0x57A7])
    share = min(max(round(holdout * n), 1), n - 1)
    out = np.zeros(n, bool)
    for radius in _RADII:
        room = _HOLES * share - out.sum()
        for centre in rng.permutation(n)[:_TRIES]:
            hole = angles(light, view, light[[centre]], view[[centre]]) <= radius
            # A hole that meets another would make one of neither's size.
            if 1 < hole.sum() <= room and not (hole & out).any():
                out |= hole
                break
    rest = rng.permutation(np.flatnonzero(~out))[: max(share - int(out.sum()), 0)]
    out[rest] = True
    return np.flatnonzero(~out), np.flatnonzero(out)


def angles(
    light: NDArray[np.floating],
    view: NDArray[np.floating],
    known_light: NDArray[np.floating],
    known_view: NDArray[np.floating],
) -> NDArray[np.float64]:
    """(n,) degrees to the nearest known pair: the larger of its light's and its view's."""
    found = np.empty(len(light))
    for start in range(0, len(light), _ROWS):
        at = slice(start, start + _ROWS)
        both = np.minimum(light[at] @ known_light.T, view[at] @ known_view.T)
        found[at] = np.degrees(np.arccos(np.clip(both.max(axis=1), -1, 1)))
    return found


def stratum(angle: NDArray[np.floating]) -> NDArray[np.intp]:
    """(n,) number of the stratum that each angle lies in."""
    return np.searchsorted(np.array(EDGES), np.asarray(angle) + 1e-3, side="right") - 1


def named(number: int) -> str:
    """A stratum in words."""
    if number + 1 == len(EDGES):
        return f"over {EDGES[number]:g}°"
    return f"{EDGES[number]:g}–{EDGES[number + 1]:g}°"


def shown(angle: NDArray[np.floating], *, each: int, seed: int) -> Index:
    """(k,) pairs of every stratum, at random, at most `each` of one."""
    order = np.random.default_rng([seed, 0x5409]).permutation(len(angle))
    number = stratum(angle)
    chosen = [order[number[order] == which][:each] for which in range(len(EDGES))]
    return np.sort(np.concatenate(chosen))
