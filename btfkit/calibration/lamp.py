"""How bright the lamp was during each frame: by its monitor, by references, or by overlaps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from btfkit.calibration.exposures import refine_exposures
from btfkit.calibration.noise import NoiseModel
from btfkit.errors import CalibrationError

Floats = NDArray[np.floating]
# Below this the lamp was off, or the monitor blind.
_DIMMEST = 0.02


@final
@dataclass(frozen=True, eq=False)
class Lamp:
    """Brightness of the lamp, relative to its median over the run.

    Attributes:
        source: "monitor", "references" or "none".
        factor: (n,) during each frame. sd: relative deviation of a factor.
        time_s, level: (m,) readings that the factors come from.
        drift: largest less smallest factor. note: what could not be told.
    """

    source: str
    factor: Floats
    sd: float
    time_s: Floats
    level: Floats
    note: str = ""

    @property
    def drift(self) -> float:
        """Largest less smallest factor."""
        return float(np.ptp(self.factor)) if self.factor.size else 0.0

    def record(self) -> dict[str, Any]:
        """As JSON's own types."""
        return {
            "source": self.source, "factor": self.factor.tolist(), "sd": self.sd,
            "time_s": self.time_s.tolist(), "level": self.level.tolist(), "drift": self.drift,
            "note": self.note,
        }  # fmt: skip


def from_monitor(reading: ArrayLike, files: Sequence[str], time_s: ArrayLike) -> Lamp:
    """Factors from the readings of a lamp monitor.

    Args:
        reading: (n,) of lit frames, relative.
        files: (n,) for messages.
        time_s: (n,) since the start; NaN where not known.

    Raises:
        CalibrationError: a reading that is none, or a lamp that was off, naming the frame.
    """
    values, time = np.asarray(reading, float), np.asarray(time_s, float)
    middle = float(np.nanmedian(values)) if np.isfinite(values).any() else np.nan
    bad = np.flatnonzero(~(values > max(_DIMMEST * middle, 0)))
    if bad.size:
        raise CalibrationError(
            f"{files[bad[0]]}: the lamp monitor read {values[bad[0]]:g}, the median is {middle:g}; "
            f"{bad.size} such frames",
            remedy="capture these frames again; the lamp was off or the monitor failed",
        )
    return Lamp("monitor", values / middle, 0.0, time, values / middle)


def from_references(time_s: ArrayLike, level: ArrayLike, sd: ArrayLike, at_s: ArrayLike) -> Lamp:
    """Factors from one pose and exposure that the run measured again and again.

    Between references the factor is interpolated. How well that does is tried by leaving out
    one reference after another; where a constant does as well, there is no drift to see.

    Args:
        time_s: (m,) of the references, seconds since the start.
        level: (m,) radiance of the reference, any unit.
        sd: (m,) its deviation, same unit.
        at_s: (n,) of the frames.

    Raises:
        CalibrationError: no reference, or one without light.
    """
    order = np.argsort(np.asarray(time_s, float), kind="stable")
    time = np.asarray(time_s, float)[order]
    value, noise = np.asarray(level, float)[order], np.asarray(sd, float)[order]
    at = np.asarray(at_s, float)
    if not value.size or not np.all(value > 0) or not np.all(np.isfinite(time)):
        raise CalibrationError(
            f"{value.size} reference frames, levels {value.tolist()[:5]}, "
            f"times {time.tolist()[:5]}; expected lit references with times",
            remedy="repeat a reference pose during the run, and write time_s",
        )
    relative = value / np.median(value)
    own = float(np.sqrt(np.mean((noise / value) ** 2)))
    if len(value) < 3:
        spread = float(np.ptp(relative)) / 2
        factor = np.interp(at, time, relative)
        note = f"{len(value)} references: between them the lamp may have done anything"
        return Lamp("references", factor, max(own, spread), time, relative, note)
    inner = range(1, len(value) - 1)
    left_out = [
        np.interp(time[i], np.delete(time, i), np.delete(relative, i)) - relative[i] for i in inner
    ]
    wrong = float(np.sqrt(np.mean(np.square(left_out))))
    constant = float(np.std(relative, ddof=1))
    if constant <= max(wrong, own):
        note = f"no drift beyond {100 * constant:.3f} %: held constant"
        return Lamp("references", np.ones(len(at)), constant, time, relative, note)
    return Lamp("references", np.interp(at, time, relative), max(wrong, own), time, relative)


def overlap_gains(
    frames: Sequence[Any], exposure_s: ArrayLike, noise: NoiseModel
) -> tuple[Floats, Floats]:
    """Gain of each frame of one exposure series, from what neighbours in exposure both measure.

    A lamp without a monitor flickers between the exposures of a pose. The longest exposure has
    gain 1: how it compares with other poses, references tell.

    Returns:
        gain (k,) and its relative deviation (k,).

    Raises:
        CalibrationError: neighbours share too few pixels.
    """
    found = refine_exposures([frames], exposure_s, noise)
    return found.factor, found.sd
