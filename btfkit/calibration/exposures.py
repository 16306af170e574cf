"""Exposure times as the frames tell them: what a shutter says is rounded, and may be wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from btfkit.calibration.merge import checked
from btfkit.calibration.noise import NoiseModel
from btfkit.errors import CalibrationError

Floats = NDArray[np.floating]
_GROUPS = 32
_FEWEST = 256


@final
@dataclass(frozen=True, eq=False)
class Exposures:
    """Times that agree with each other.

    Attributes:
        nominal_s: (k,) as given. factor: (k,) what to multiply them by; 1 for the longest, whose
            time sets the scale. sd: (k,) relative deviation of each factor. overlap: (k,) pixels
            that two neighbours in time share, 0 for the longest.
    """

    nominal_s: Floats
    factor: Floats
    sd: Floats
    overlap: NDArray[np.intp]

    @property
    def seconds(self) -> Floats:
        """(k,) refined times."""
        return self.nominal_s * self.factor

    def record(self) -> dict[str, Any]:
        """As JSON's own types."""
        return {
            "nominal_s": self.nominal_s.tolist(), "factor": self.factor.tolist(),
            "sd": self.sd.tolist(), "overlap_pixels": self.overlap.tolist(),
        }  # fmt: skip


def refine_exposures(
    series: Sequence[Sequence[Any]],
    exposure_s: ArrayLike,
    noise: NoiseModel,
    *,
    lamp: Sequence[ArrayLike] | None = None,
) -> Exposures:
    """Exposure factors from what neighbouring exposures both measure well.

    Args:
        series: of any number of scenes, each k frames (h, w) in the order of `exposure_s`.
        exposure_s: (k,) nominal seconds.
        noise: of the sensor.
        lamp: of each series the brightness (k,) of the lamp, relative; None where it is steady.

    Raises:
        CalibrationError: two neighbouring exposures share too few pixels, naming them.
    """
    nominal = np.asarray(exposure_s, float)
    order = np.argsort(-nominal)
    log, variance = np.zeros(len(nominal)), np.zeros(len(nominal))
    overlap = np.zeros(len(nominal), np.intp)
    for longer, shorter in pairwise(order):
        ratios, count = [], 0
        for i, frames in enumerate(series):
            _, _, light = checked(frames, nominal, 1.0 if lamp is None else lamp[i])
            found, pixels = _ratios(frames, nominal, int(longer), int(shorter), noise)
            ratios += [ratio * light[longer] / light[shorter] for ratio in found]
            count += pixels
        if count < _FEWEST:
            raise CalibrationError(
                f"exposures {nominal[longer]:g} s and {nominal[shorter]:g} s share {count} pixels "
                f"that both measure well; {_FEWEST} are needed to compare their times",
                remedy="bring the exposures closer together, or keep the nominal times",
            )
        step = np.log(ratios)
        middle = float(np.median(step))
        # The median of n values scatters by 1.25 times what their mean does.
        spread = 1.4826 * float(np.median(np.abs(step - middle)))
        overlap[shorter] = count
        log[shorter] = log[longer] + middle
        variance[shorter] = variance[longer] + (1.2533 * spread) ** 2 / len(step)
    factor = np.exp(log - np.log(nominal / nominal[order[0]]))
    return Exposures(nominal, factor, np.sqrt(variance), overlap)


def _ratios(
    frames: Sequence[Any], nominal: Floats, longer: int, shorter: int, noise: NoiseModel
) -> tuple[list[float], int]:
    """Ratios shorter / longer of interleaved parts of the pixels, and how many pixels."""
    long, short = (
        noise.linear(np.asarray(frames[i], float) - noise.black)
        - np.asarray(noise.dark) * nominal[i]
        for i in (longer, shorter)
    )
    ratio = nominal[shorter] / nominal[longer]
    # Chosen by the longer exposure alone, well inside its range: its noise hardly moves a pixel
    # over the bounds, while that of the shorter would choose its own errors.
    low = 25 * np.sqrt(noise.floor) / max(ratio, 1e-6)
    chosen = (long > min(low, 0.3 * noise.full)) & (long < 0.85 * noise.full)
    chosen &= np.asarray(frames[longer]) < noise.white
    a, b = long[chosen], short[chosen]
    parts = min(_GROUPS, a.size // 16)
    if parts < 1:
        return [], int(a.size)
    sums = [(float(b[i::parts].sum()), float(a[i::parts].sum())) for i in range(parts)]
    return [s / t for s, t in sums if s > 0 < t], int(a.size)
