"""The cut of least error between two looks at the same place.

In a band of overlap every texel can be taken from one end of the sample or from the other. A cut
is one position a column: above it the far end is taken, from it on the near end. Its cost counts
the mismatch of the two looks on both sides of every border between them.

Sources: Efros and Freeman, "Image quilting for texture synthesis and transfer", 2001, for the
cut of least error; Kwatra et al., "Graphcut textures", 2003, for the cost of a border.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]
Cut = NDArray[np.intp]
# A texel that is not measured is worth any detour.
_UNMEASURED = 1e3


def open_cut(mismatch: Floats, near: Floats, far: Floats) -> Cut:
    """The cheapest cut across a band, its two ends free.

    Args:
        mismatch: (o, q) how unlike the two looks are; o at least 2.
        near, far: (o, q) 1 where that look is not measured.

    Returns:
        (q,) positions in 1..o-1: rows below the position take the far look, the rest the near.
    """
    edge, turn = _costs(mismatch, near, far)
    steps = _swept(edge[:, :1].T, edge, turn)
    return _traced(steps[:, 0], turn, int(np.argmin(steps[-1, 0])))


def closed_cut(mismatch: Floats, near: Floats, far: Floats) -> Cut:
    """The cheapest cut around a band whose last column is followed by its first.

    Args, returns: as `open_cut`. Exact: the best of all starts.
    """
    edge, turn = _costs(mismatch, near, far)
    count = len(edge)
    starts = np.full((count, count), np.inf)
    np.fill_diagonal(starts, edge[:, 0])
    last = turn[:, -1]
    whole = _last(starts, edge, turn) + np.abs(last - last[:, None])
    start = int(np.argmin(whole.min(axis=1)))
    steps = _swept(starts[start : start + 1], edge, turn)[:, 0]
    return _traced(steps, turn, int(np.argmin(steps[-1] + np.abs(last - last[start]))))


def cut_cost(cut: Cut, mismatch: Floats, near: Floats, far: Floats, *, closed: bool) -> float:
    """What a cut costs: what the two functions above make least."""
    edge, turn = _costs(mismatch, near, far)
    at = cut - 1
    columns = np.arange(len(at))
    steps = np.abs(turn[np.roll(at, -1), columns] - turn[at, columns])
    return float(edge[at, columns].sum() + (steps if closed else steps[:-1]).sum())


def _costs(mismatch: Floats, near: Floats, far: Floats) -> tuple[Floats, Floats]:
    """(o-1, q) costs of positions 1..o-1, and sums whose differences are the costs of turns."""
    m = np.asarray(mismatch, np.float64)
    edge = m[:-1] + m[1:]
    above = np.cumsum(far, axis=0)[:-1]
    below = np.cumsum(np.asarray(near, np.float64)[::-1], axis=0)[::-1][1:]
    turn = np.cumsum(m + np.roll(m, -1, axis=1), axis=0)[:-1]
    return edge + _UNMEASURED * (above + below), turn


def _step(cost: Floats, turn: Floats, edge: Floats) -> Floats:
    """Costs (s, o-1) one column on: |difference of turns| is the way up or the way down."""
    down = np.minimum.accumulate(cost - turn, axis=1) + turn
    up = np.minimum.accumulate((cost + turn)[:, ::-1], axis=1)[:, ::-1] - turn
    return np.minimum(down, up) + edge


def _last(start: Floats, edge: Floats, turn: Floats) -> Floats:
    cost = start
    for column in range(1, edge.shape[1]):
        cost = _step(cost, turn[:, column - 1], edge[:, column])
    return cost


def _swept(start: Floats, edge: Floats, turn: Floats) -> Floats:
    """(q, s, o-1) costs of the best ways to every position of every column."""
    steps = np.empty((edge.shape[1], *start.shape))
    steps[0] = start
    for column in range(1, len(steps)):
        steps[column] = _step(steps[column - 1], turn[:, column - 1], edge[:, column])
    return steps


def _traced(steps: Floats, turn: Floats, last: int) -> Cut:
    """The way that led to position `last` of the last column."""
    cut = np.empty(len(steps), np.intp)
    cut[-1] = last
    for column in range(len(steps) - 2, -1, -1):
        sums = turn[:, column]
        cut[column] = np.argmin(steps[column] + np.abs(sums - sums[cut[column + 1]]))
    return cut + 1
