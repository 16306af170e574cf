"""The stage of the lamp: its brightness in every frame, from monitor, references and overlaps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from btfkit.calibration import lamp as lamps
from btfkit.calibration.lamp import Lamp
from btfkit.calibration.radiometry import Radiometry, as_plane
from btfkit.errors import CalibrationError
from btfkit.sequence import Sequence as Frames

Floats = NDArray[np.floating]
LIT = ("sample", "white", "colour", "reference", "target", "sphere")


def lamp_frames(sequence: Frames) -> Sequence[int]:
    """Indices of the frames whose content tells the lamp: none where a monitor does."""
    lit = sequence.of_kind(*LIT)
    if all(sequence.frames[i].lamp is not None for i in lit):
        return ()
    return lit


def lamp_factors(sequence: Frames, radiometry: Radiometry) -> tuple[list[int], Lamp]:
    """Frames lit by the lamp, and its brightness in each.

    Without a monitor, references tell the drift, and overlaps of exposures the flicker within
    one pose.

    Raises:
        CalibrationError: a reading of the monitor that is none.
    """
    lit = list(sequence.of_kind(*LIT))
    frames = [sequence.frames[i] for i in lit]
    time = np.array([np.nan if f.time_s is None else f.time_s for f in frames])
    readings = [f.lamp for f in frames if f.lamp is not None]
    if frames and len(readings) == len(frames):
        return lit, lamps.from_monitor(readings, [f.file for f in frames], time)
    drift = _drift(sequence, radiometry, time)
    flicker = _flicker(sequence, radiometry)
    if not flicker:
        return lit, drift
    factor = drift.factor * np.array([flicker.get(i, 1.0) for i in lit])
    worst = max(abs(gain - 1) for gain in flicker.values())
    note = f"flicker of up to {100 * worst:.2f} % between the exposures of a pose"
    return lit, replace(drift, factor=factor, note="; ".join(filter(None, (drift.note, note))))


def _drift(sequence: Frames, radiometry: Radiometry, time: Floats) -> Lamp:
    """Brightness at the times (n,) of the lit frames, from references where there are some."""
    references = sequence.of_kind("reference")
    if not references or not np.isfinite(time).all():
        ones = np.ones(len(time))
        note = "no lamp monitor and no timed reference frames: the lamp is taken as steady"
        return Lamp("none", ones, float("nan"), time, ones, note)
    merged = [radiometry.radiance(sequence, [i]) for i in references]
    seen = np.all([np.isfinite(m.radiance) for m in merged], axis=0)
    if seen.mean() < 0.01:
        raise CalibrationError(
            f"{sequence.frames[references[0]].file}: the reference frames saturate",
            remedy="capture them at a shorter exposure",
        )
    level = [float(m.radiance[seen].mean(dtype=float)) for m in merged]
    sd = [float(np.sqrt(m.variance[seen].mean(dtype=float) / seen.sum())) for m in merged]
    at = [float(sequence.frames[i].time_s or 0) for i in references]
    return lamps.from_references(at, level, sd, time)


def _flicker(sequence: Frames, radiometry: Radiometry) -> dict[int, float]:
    """Gains by frame, of those that stand out of their error and of the exposure times."""
    found: dict[int, float] = {}
    for group in sequence.groups(*LIT).values():
        times = [sequence.frames[i].exposure_s for i in group]
        if len(group) < 2 or None in times or len(set(times)) < len(times):
            continue
        nominal = [float(t or 0) for t in times]
        raw = [as_plane(sequence.image(i)) for i in group]
        exposure = [t * radiometry.factor(t) for t in nominal]
        try:
            gain, sd = lamps.overlap_gains(raw, exposure, radiometry.noise)
        except CalibrationError:
            # Exposures that share nothing tell nothing of each other.
            continue
        told = np.abs(gain - 1) > np.maximum(4 * sd, 1e-3)
        found |= {i: float(g) for i, g, t in zip(group, gain, told, strict=True) if t}
    return found
