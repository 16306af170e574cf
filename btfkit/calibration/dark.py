"""What a sensor reads without light: black level, dark current, read noise, hot pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from btfkit.calibration.noise import QUANTISATION, Fitted, solved
from btfkit.errors import CalibrationError

Floats = NDArray[np.floating]
# Dark current doubles every few kelvin; without a range of temperatures this is assumed.
DOUBLING_K = 6.5
_CLIP_SD = 6.0


@final
@dataclass(frozen=True, eq=False)
class Dark:
    """The dark model: black + current * 2^((T - T0) / doubling) * exposure, counts.

    Attributes:
        black: (h, w) counts; what differs between pixels, as far as it is not noise.
        current: counts a second at `temperature_c`, mean over the sensor.
        temperature_c: T0, or None where no frame says it. doubling_k: kelvin.
        read: deviation of a count, without rounding and without what differs between pixels, or
            None where no two frames of one exposure are there.
        hot: (h, w) pixels that stand out by more than six deviations.
        clipped: share of counts at 0, which noise would take below.
        fitted: errors, condition, and what could not be told.
    """

    black: Floats
    current: float
    temperature_c: float | None
    doubling_k: float
    read: float | None
    hot: NDArray[np.bool_]
    clipped: float
    fitted: Fitted

    def rate(self, temperature_c: float | None = None) -> float:
        """Dark counts a second at a temperature; at T0 where it is None."""
        if temperature_c is None or self.temperature_c is None:
            return self.current
        return float(self.current * 2 ** ((temperature_c - self.temperature_c) / self.doubling_k))

    def record(self) -> dict[str, Any]:
        """The numbers, maps as their means and counts."""
        return {
            "black": float(np.mean(self.black)), "black_sd": float(np.std(self.black)),
            "current_counts_per_s": self.current, "temperature_c": self.temperature_c,
            "doubling_k": self.doubling_k, "read_counts": self.read,
            "hot_pixels": int(self.hot.sum()), "clipped": self.clipped, **self.fitted.record(),
        }  # fmt: skip


def fit_dark(
    frames: Sequence[NDArray[Any]], exposure_s: ArrayLike, temperature_c: ArrayLike | None = None
) -> Dark:
    """Black level, dark current and read noise from frames without light.

    Args:
        frames: k frames (h, w), counts.
        exposure_s: (k,) seconds.
        temperature_c: (k,) of the sensor; None or NaN where it is not known.

    Raises:
        CalibrationError: no frame, frames of different size, or not dark.
    """
    counts, exposure = _same_size(frames, exposure_s)
    level = np.array([_clipped_mean(frame) for frame in counts])
    warm = np.full(len(counts), np.nan) if temperature_c is None else np.asarray(temperature_c)
    reference = float(np.nanmedian(warm)) if np.isfinite(warm).any() else None
    black, current, doubling, fitted = _levels(level, exposure, warm, reference)
    rate = np.full(len(counts), current)
    if reference is not None:
        rate = current * 2 ** (
            (np.where(np.isfinite(warm), warm, reference) - reference) / doubling
        )
    mean, square = np.zeros(counts[0].shape), np.zeros(counts[0].shape)
    for frame, dark, t in zip(counts, rate, exposure, strict=True):
        value = frame - black - dark * t
        mean += value / len(counts)
        square += value**2 / len(counts)
    scatter = square - mean**2
    # Hot pixels scatter more; the variance of few rounded frames has no useful median.
    quiet = scatter <= np.quantile(scatter, 0.998)
    noise = float(scatter[quiet].mean()) / max(len(counts) - 1, 1)
    mean += black
    # A pixel is hot against its neighbours, whatever gradient the whole has.
    spread = _deviation(mean)
    hot = np.abs(mean - np.median(mean)) > _CLIP_SD * spread
    mean[hot] = black
    mean = _shrunk(mean, noise)
    clipped = float(np.mean([np.mean(frame <= 0) for frame in counts]))
    return Dark(
        mean, current, reference, doubling, _read_noise(counts, exposure, hot), hot, clipped, fitted
    )


def _shrunk(black: Floats, noise: float) -> Floats:
    """A mean of few frames drawn towards its own mean, as far as it is noise.

    Args:
        black: (h, w) mean of frames. noise: variance of that mean, counts^2.
    """
    told = max(float(black.var()) - noise, 0.0)
    level = float(black.mean())
    return level + (black - level) * (told / max(told + noise, 1e-300))


def _levels(
    level: Floats, exposure: Floats, warm: Floats, reference: float | None
) -> tuple[float, float, float, Fitted]:
    """Black, current, doubling and how well they are known, of the levels of k frames."""
    held: dict[str, str] = {}
    doubling, current, black = DOUBLING_K, 0.0, float(np.median(level))
    values, sd, condition, residual = {"black": black}, {"black": _deviation(level)}, 1.0, 0.0
    if np.ptp(exposure) < 0.5 * exposure.max():
        held["current"] = "0: all darks have about the same exposure, which is in the black level"
        held["doubling_k"] = f"{DOUBLING_K}: without a current there is nothing to tell"
        return black, current, doubling, Fitted(values, sd, condition, residual, held)
    known = np.isfinite(warm)
    told = bool(known.all()) and float(np.ptp(warm)) >= 3.0
    if not told:
        held["doubling_k"] = f"{DOUBLING_K}: the darks span less than 3 kelvin, or say none"
    # Doubling is the one parameter that is not linear: the best of a grid, closer twice.
    span = (3.0, 15.0) if told else (DOUBLING_K, DOUBLING_K)
    shift = np.zeros(len(level)) if reference is None else np.where(known, warm - reference, 0)
    for _ in range(3 if told else 1):
        grid = np.linspace(*span, 25 if told else 1)
        designs = [np.stack([np.ones_like(level), exposure * 2 ** (shift / d)], 1) for d in grid]
        solutions = [solved(design, level, np.ones_like(level)) for design in designs]
        errors = [
            np.square((design @ s[0] - level)[s[3]]).sum() - 1e9 * s[3].sum()
            for design, s in zip(designs, solutions, strict=True)
        ]
        best = int(np.argmin(errors))
        step = (span[1] - span[0]) / 24
        doubling, span = float(grid[best]), (grid[best] - step, grid[best] + step)
    (black, current), covariance, condition, keep = solutions[best]
    residual = float(np.abs(designs[best] @ [black, current] - level)[keep].max())
    scatter = np.sqrt(np.diag(covariance)) * max(residual, 1e-12)
    values = {"black": float(black), "current": float(current), "doubling_k": doubling}
    sd = {"black": float(scatter[0]), "current": float(scatter[1])}
    return float(black), float(current), doubling, Fitted(values, sd, condition, residual, held)


def _read_noise(counts: list[Any], exposure: Floats, hot: NDArray[np.bool_]) -> float | None:
    """Deviation of one pixel between equal frames, rounding taken out; None without two."""
    found = []
    for first, second in _pairs(exposure):
        a, b = (counts[i].astype(float)[~hot] for i in (first, second))
        near = np.abs(a - np.median(a)) < _CLIP_SD * (_deviation(a) + 0.5)
        near &= np.abs(b - np.median(b)) < _CLIP_SD * (_deviation(b) + 0.5)
        a, b = a[near], b[near]
        # What both frames share differs between pixels; the rest is noise.
        shared = max(float(np.mean((a - a.mean()) * (b - b.mean()))), 0.0)
        total = [unrounded_variance(float(x.mean()), float(x.var())) for x in (a, b)]
        found.append((exposure[first], max(float(np.mean(total)) - shared, 0.0)))
    if not found:
        return None
    # The shortest darks hold least shot noise of the dark current.
    shortest = min(t for t, _ in found)
    return float(np.sqrt(np.median([v for t, v in found if t <= 1.01 * shortest])))


def unrounded_variance(mean: float, variance: float) -> float:
    """Variance of a normal value before it was rounded to whole numbers.

    Where noise spans several counts, rounding adds 1/12. Below half a count what it adds depends
    on where between two whole numbers the mean lies.

    Args:
        mean, variance: of the rounded values.
    """
    if variance <= 0:
        return 0.0
    plain = variance - QUANTISATION
    if plain > 0.5:
        return plain
    from scipy.special import ndtr

    steps = np.arange(-8, 9)
    low, high = 1e-3, 1.0
    for _ in range(40):
        sd = 0.5 * (low + high)
        # The phase that shows this mean at this deviation; few rounds bring it there.
        phase = mean - np.rint(mean)
        centre = phase
        for _ in range(8):
            share = np.diff(ndtr((np.append(steps, 9) - 0.5 - centre) / sd))
            centre += np.clip(phase - float(share @ steps), -0.3, 0.3)
            centre = float(np.clip(centre, -0.5, 0.5))
        share = np.diff(ndtr((np.append(steps, 9) - 0.5 - centre) / sd))
        shown = float(share @ steps**2 - (share @ steps) ** 2)
        low, high = (sd, high) if shown < variance else (low, sd)
    return float(0.25 * (low + high) ** 2)


def _pairs(exposure: Floats) -> list[tuple[int, int]]:
    """Neighbours in a list that have equal exposure."""
    found = []
    for value in np.unique(exposure):
        same = np.flatnonzero(np.isclose(exposure, value, rtol=1e-6))
        found += [(int(a), int(b)) for a, b in zip(same[:-1:2], same[1::2], strict=True)]
    return found


def _same_size(frames: Sequence[Any], exposure_s: ArrayLike) -> tuple[list[Any], Floats]:
    counts, exposure = [np.asarray(frame) for frame in frames], np.asarray(exposure_s, float)
    if not counts or exposure.shape != (len(counts),):
        raise CalibrationError(
            f"{len(counts)} dark frames and {exposure.size} exposure times",
            remedy="capture frames with the lens capped at each exposure",
        )
    for i, frame in enumerate(counts):
        if frame.shape != counts[0].shape or frame.ndim != 2:
            raise CalibrationError(
                f"dark frame {i} has shape {frame.shape}, the first {counts[0].shape}",
                remedy="leave it out or capture it again",
            )
    return counts, exposure


def _clipped_mean(values: Floats) -> float:
    """Mean without what lies beyond six deviations of the median."""
    flat = np.asarray(values, float).ravel()
    near = np.abs(flat - np.median(flat)) <= _CLIP_SD * (_deviation(flat) + 0.5)
    return float(flat[near].mean())


def _deviation(values: Floats) -> float:
    """Robust deviation: the middle two thirds of values span two of them."""
    low, high = np.quantile(values, [0.1587, 0.8413])
    return float(high - low) / 2
