"""Nuisance gains: a number for each pair and channel that exposure, lamp or compression left.

A measured texture is taken as gain x reflectance. Gains have mean 1 and no smooth part: what
changes smoothly with light and view is reflectance for all that one can tell, and stays there.
Used where models are fitted, where errors are counted, and for rigs without a lamp monitor.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
# Blocks a side in which the two halves of a texture alternate.
_BLOCKS = 8
# Pairs for each term of the smooth part: fewer terms where there are fewer pairs.
_PAIRS_A_TERM = 6
# A pair whose answers sum to less than this share of the median's says nothing of its gain.
_DARK = 1e-3
# No lamp flickers by more; what looks like it is a wrong answer.
_LEAST, _MOST = 0.25, 4.0


@final
@dataclass(frozen=True, eq=False)
class Gains:
    """Gains of n pairs in c channels.

    Attributes:
        values: (n, c), mean 1 over the pairs of a channel; 1 where nothing is known.
        error: (n, c) standard error of each before it was drawn towards 1; infinite where unknown.
        smooth: (n, c) what was found to change smoothly with light and view, and is not in
            `values`: nothing tells it from reflectance.
        deviation: (c,) of the gains, without what their errors add.
    """

    values: Floats
    error: Floats
    smooth: Floats
    deviation: Floats


def ratios(answer: NDArray[np.floating], measured: NDArray[np.floating]) -> tuple[Floats, Floats]:
    """How much brighter each pair was measured than it is answered.

    A ratio of sums, which noise in either does not draw towards 0; each texel counts by
    1 / (1 + answer), as in errors of log(1 + x).

    Args:
        answer, measured: (n, t, c) of texels at random; NaN where not measured.

    Returns:
        (n, c) ratios and their standard errors; NaN and infinity where nothing can be said.
    """
    truth = np.asarray(measured, np.float64)
    counted = np.isfinite(truth)
    given = np.where(counted, answer, 0.0)
    weight = counted / (1 + np.maximum(given, 0))
    number = counted.sum(axis=1)
    below = (weight * given).sum(axis=1)
    above = (weight * np.where(counted, truth, 0.0)).sum(axis=1)
    bright = below / np.maximum(number, 1)
    known = (number > 1) & (bright > _DARK * np.median(bright, axis=0)) & (bright > 0)
    ratio = np.divide(above, below, out=np.full_like(below, np.nan), where=known)
    known &= (ratio > _LEAST) & (ratio < _MOST)
    ratio = np.where(known, ratio, np.nan)
    rest = weight * (np.where(counted, truth, 0.0) - np.nan_to_num(ratio)[:, None] * given)
    spread = np.square(rest).sum(axis=1) / np.maximum(number - 1, 1)
    error = np.sqrt(number * spread) / np.where(known, below, 1.0)
    return ratio, np.where(known, error, np.inf)


def estimated(
    ratio: Floats, error: Floats, light: NDArray[np.floating], view: NDArray[np.floating]
) -> Gains:
    """Gains from ratios of measured to answered.

    The smooth part goes first; the rest is drawn towards 1 as far as errors exceed what gains
    vary by (empirical Bayes), and brought to mean 1.

    Args:
        ratio, error: (n, c) as `ratios` gives them.
        light, view: (n, 3) unit vectors.
    """
    known = np.isfinite(ratio)
    logs = np.log(np.where(known, ratio, 1.0))
    certain = np.where(known, error / np.where(known, ratio, 1.0), np.inf)
    smooth = np.zeros_like(logs)
    terms = smooth_terms(light, view)
    for k in range(logs.shape[1]):
        smooth[:, k] = _fitted(terms, logs[:, k], known[:, k])
    rest = np.where(known, logs - smooth, 0.0)
    deviation = np.array([_spread(rest[known[:, k], k], certain[known[:, k], k])
                          for k in range(logs.shape[1])])  # fmt: skip
    kept = deviation**2 / np.maximum(deviation**2 + np.square(certain), 1e-30)
    values = np.exp(np.where(known, kept * rest, 0.0))
    values /= values.mean(axis=0)
    return Gains(values, error, np.exp(smooth), deviation)


def smooth_terms(light: NDArray[np.floating], view: NDArray[np.floating]) -> Floats:
    """(n, k) smooth functions of light and view: of as high a degree, up to 2, as n allows."""
    n = len(light)
    both = np.concatenate([light[:, :2], view[:, :2]], axis=1).astype(np.float64)
    up = np.stack([light[:, 2], view[:, 2]], axis=1).astype(np.float64)
    squares = [both[:, i] * both[:, j] for i in range(4) for j in range(i, 4)]
    stages = [np.ones((n, 1)), np.concatenate([both, up], axis=1), np.stack(squares, axis=1)]
    terms = stages[0]
    for stage in stages[1:]:
        wider = _independent(np.concatenate([terms, stage], axis=1))
        if wider.shape[1] * _PAIRS_A_TERM > n:
            break
        terms = wider
    return terms


def halves(h: int, w: int) -> NDArray[np.bool_]:
    """(h, w) True in one half of a texture, in blocks that alternate like a chess board."""
    rows, cols = (np.arange(side) // max(1, side // _BLOCKS) for side in (h, w))
    return np.asarray((rows[:, None] + cols) % 2 == 0)


def crossed(answer: NDArray[np.floating], truth: NDArray[np.floating]) -> NDArray[np.float32]:
    """An answer times the gain of its pair: each half of the texels with that of the other half.

    So an error that is counted against `truth` never saw the texels it is counted on.

    Args:
        answer, truth: (h, w, c); NaN in `truth` where not measured.

    Returns:
        (h, w, c); unchanged where the other half says nothing.
    """
    h, w, c = truth.shape
    one = halves(h, w)
    out = np.array(answer, np.float32)
    for here in (one, ~one):
        there = ~here
        if here.any() and there.any():
            ratio, _ = ratios(answer[there].reshape(1, -1, c), truth[there].reshape(1, -1, c))
            out[here] *= np.where(np.isfinite(ratio[0]), ratio[0], 1.0).astype(np.float32)
    return out


def _independent(terms: Floats) -> Floats:
    """Columns that the ones before them do not say already."""
    kept: list[int] = []
    basis = np.zeros((len(terms), 0))
    for k in range(terms.shape[1]):
        rest = terms[:, k] - basis @ (basis.T @ terms[:, k])
        length = np.linalg.norm(rest)
        if length > 1e-3 * np.linalg.norm(terms[:, k]) and length > 0:
            kept.append(k)
            basis = np.column_stack([basis, rest / length])
    return terms[:, kept]


def _fitted(terms: Floats, logs: Floats, known: NDArray[np.bool_]) -> Floats:
    """(n,) least squares of `logs` by `terms`; twice, the second time without outliers."""
    fit = np.zeros(len(logs))
    used = known.copy()
    for _ in range(2):
        if used.sum() < 2 * terms.shape[1]:
            break
        fit = terms @ np.linalg.lstsq(terms[used], logs[used], rcond=None)[0]
        rest = np.abs(logs - fit)
        used = known & (rest <= 5 * max(np.median(rest[known]), 1e-12))
    return fit


def _spread(rest: Floats, error: Floats) -> float:
    """Standard deviation of gains, robust, less what their errors explain."""
    if len(rest) < 2:
        return 0.0
    total = 1.4826 * float(np.median(np.abs(rest - np.median(rest))))
    return float(np.sqrt(max(total**2 - float(np.median(np.square(error))), 0.0)))
