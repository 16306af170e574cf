"""The photon transfer curve: gain and read noise from how flat frames scatter.

The variance of a count is read^2 + 1/12 + signal / gain: a line over the signal, whose slope is
the gain. Differences of two frames of the same scene hold noise alone: neither the scene nor the
pixels' sensitivity is in them.

Source: Janesick, "Photon Transfer", 2007, chapter 5; EMVA standard 1288, release 4, section 6.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from btfkit.calibration.noise import QUANTISATION, Fitted, solved
from btfkit.errors import CalibrationError

Floats = NDArray[np.floating]
_BINS = 16
_FEWEST = 200
# A normal value cut off at 4 deviations loses this share of its variance.
_CLIP_SD, _CLIP_SHARE = 4.0, 0.9989


@final
@dataclass(frozen=True, eq=False)
class Transfer:
    """The fitted curve.

    Attributes:
        gain: electrons a count. read: deviation in the dark without rounding, counts.
        signal, variance: (b,) points of the curve, counts and counts^2.
        used: (b,) points that lie within five deviations of the line.
        fitted: errors, condition, largest deviation of a used point from the line, relative.
    """

    gain: float
    read: float
    signal: Floats
    variance: Floats
    used: NDArray[np.bool_]
    fitted: Fitted

    def record(self) -> dict[str, Any]:
        """The numbers and the points of the curve."""
        return {
            "gain_e_per_count": self.gain, "read_counts": self.read,
            "signal": self.signal.tolist(), "variance": self.variance.tolist(),
            "used": self.used.tolist(), **self.fitted.record(),
        }  # fmt: skip


def photon_transfer(
    pairs: Sequence[tuple[Any, Any]], black: Any, white: float, *, read: float | None = None
) -> Transfer:
    """Gain and read noise from pairs of frames of one scene at one exposure.

    Args:
        pairs: of frames (h, w), counts; scenes and exposures differ between pairs.
        black: level without light at that exposure, counts; a number or (h, w).
        white: counts of saturation.
        read: deviation in the dark where dark frames told it, counts; else it is fitted.

    Raises:
        CalibrationError: no pair, a pair of two sizes, or no variance to see.
    """
    signal, variance, count = _curve(pairs, black, white)
    if not len(signal):
        raise CalibrationError(
            f"none of {len(pairs)} pairs of flat frames has {_FEWEST} pixels between the noise and "
            "saturation",
            remedy="capture two flat frames at each of several exposures below saturation",
        )
    if np.ptp(signal) < 0.2 * signal.max() and read is None:
        raise CalibrationError(
            f"the flat frames span {signal.min():.0f} to {signal.max():.0f} counts above black: "
            "gain and read noise cannot be told apart",
            remedy="add dark frames, or flat frames at other exposures",
        )
    if not variance.max() > 2 * QUANTISATION:
        raise CalibrationError(
            f"flat frames of one exposure do not differ (variance {variance.max():.2g} counts^2)",
            remedy="give frames as the sensor read them, not copies or averages",
        )
    return _line(signal, variance, count, read)


def lacks_photon_noise(
    pairs: Sequence[tuple[Any, Any]], black: Any, white: float, *, read: float | None = None
) -> bool:
    """Whether bright pixels scatter no more than dark ones, as no real sensor's do.

    Args:
        pairs, black, white, read: as in `photon_transfer`, which refuses such frames.
    """
    signal, variance, count = _curve(pairs, black, white)
    if not len(signal):
        return False
    if not variance.max() > 2 * QUANTISATION:
        return True
    answer, *_ = _solution(signal, variance, count, read)
    return not answer[0] > 0


def _curve(
    pairs: Sequence[tuple[Any, Any]], black: Any, white: float
) -> tuple[Floats, Floats, Floats]:
    """Signal, variance and count (b,) of all pairs."""
    points = [p for i, pair in enumerate(pairs) for p in _points(i, *pair, black, white)]
    signal, variance, count = np.array(points).reshape(-1, 3).T
    return signal, variance, count


def _solution(
    signal: Floats, variance: Floats, count: Floats, read: float | None
) -> tuple[Floats, Floats, float, NDArray[np.bool_], Floats]:
    """Slope and, where `read` is None, the variance in the dark; covariance, condition, points
    used, and the variances (b,) that the line expects.
    """
    floor = 0.0 if read is None else read**2
    target = variance - QUANTISATION - floor
    design = signal[:, None] if read is not None else np.stack([signal, np.ones_like(signal)], 1)
    # Most points lie on the line: a pair that moved must not decide where it is.
    answer: Floats = np.zeros(design.shape[1])
    answer[0] = np.median(target / np.maximum(signal, 1e-9))
    for _ in range(4):
        expected = np.maximum(design @ answer, 0) + QUANTISATION + floor
        # A variance of n values scatters by sqrt(2 / n) of itself.
        weight = count / (2 * expected**2)
        answer, covariance, condition, used = solved(design, target, weight, start=answer)
    expected = np.maximum(design @ answer, 0) + QUANTISATION + floor
    return answer, covariance, condition, used, expected


def _line(signal: Floats, variance: Floats, count: Floats, read: float | None) -> Transfer:
    """The straight line through the points, weighted by what each can scatter."""
    answer, covariance, condition, used, expected = _solution(signal, variance, count, read)
    slope = float(answer[0])
    if not slope > 0:
        raise CalibrationError(
            "the noise of the flat frames does not grow with their signal",
            remedy="give linear counts as the sensor read them",
        )
    sd = np.sqrt(np.diag(covariance))
    held = {}
    if read is None:
        low = float(answer[1])
        if low < 0:
            held["read_counts"] = f"0: the line meets the dark at {low:.3g} counts^2"
        read = float(np.sqrt(max(low, 0.0)))
        read_sd = float(sd[1]) / max(2 * read, 1e-9)
    else:
        held["read_counts"], read_sd = f"{read:.4g}: from the dark frames", 0.0
    residual = float(np.abs(variance / expected - 1)[used].max())
    fitted = Fitted(
        {"gain_e_per_count": 1 / slope, "read_counts": read},
        {"gain_e_per_count": float(sd[0]) / slope**2, "read_counts": read_sd},
        condition, residual, held,
    )  # fmt: skip
    return Transfer(1 / slope, read, signal, variance, used, fitted)


def _points(
    index: int, first: Any, second: Any, black: Any, white: float
) -> list[tuple[float, float, int]]:
    """(signal, variance, count) of pixels of like brightness in one pair."""
    if np.shape(first) != np.shape(second):
        raise CalibrationError(
            f"flat pair {index} has frames of {np.shape(first)} and {np.shape(second)}",
            remedy="pair frames of one sensor and window",
        )
    a, b = (np.asarray(frame, float) for frame in (first, second))
    below = np.maximum(a, b) < white
    a, b = ((x - black)[below] for x in (a, b))
    if a.size < _FEWEST:
        return []
    # The lamp moves between the frames of a pair.
    ratio = a.sum() / b.sum() if b.sum() > 0 else 1.0
    mean, difference = 0.5 * (a + b), a - b * (ratio if 0.8 < ratio < 1.25 else 1.0)
    found = []
    order = np.argsort(mean)
    for part in np.array_split(order, min(_BINS, max(a.size // _FEWEST, 1))):
        level = float(mean[part].mean())
        spread = float(np.std(difference[part]))
        # Nearer to saturation than this the upper half of the noise is cut off.
        if level + 4 * spread > white - np.max(black):
            continue
        d = difference[part]
        for _ in range(3):
            d = d[np.abs(d - d.mean()) <= _CLIP_SD * max(float(d.std()), 1e-12)]
        found.append((level, float(d.var()) / 2 / _CLIP_SHARE, len(d)))
    return found


def exposure_pairs(exposure_s: ArrayLike, groups: Sequence[Any]) -> list[tuple[int, int]]:
    """Indices of frames that can be pairs: equal exposure and group, each frame once."""
    waiting: dict[Any, int] = {}
    found = []
    for i, key in enumerate(zip(np.asarray(exposure_s, float).tolist(), groups, strict=True)):
        if key in waiting:
            found.append((waiting.pop(key), i))
        else:
            waiting[key] = i
    return found
