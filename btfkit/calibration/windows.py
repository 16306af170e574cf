"""Windows of a sequence's frames: merged exposures, and stray light taken out of them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit.calibration.merge import Merged, merge_exposures
from btfkit.calibration.radiometry import Radiometry, as_plane
from btfkit.calibration.stray import Stray, frame_means
from btfkit.sequence import Sequence

Floats = NDArray[np.floating]
Window = tuple[slice, slice]
# Pixels that tell the mean of a frame: 1 of 25.
EVERY = slice(2, None, 5)


def radiance_of(
    sequence: Sequence,
    group: tuple[int, ...],
    window: Window,
    radiometry: Radiometry,
    stray: Stray | None,
    lamp: list[float],
) -> Merged:
    """Merged exposures of a window of one pose, without stray light.

    Args:
        group: frames of the pose. lamp: its brightness during each.
        window: rows and columns; it begins with a whole cell of a mosaic.
    """
    merged = merged_window(radiometry, sequence, group, window, lamp)
    if stray is None or stray.share == 0:
        return merged
    sparse = merged_window(radiometry, sequence, group, (EVERY, EVERY), lamp)
    return without_stray(radiometry, stray, merged, sparse, window)


def merged_window(
    radiometry: Radiometry,
    sequence: Sequence,
    group: tuple[int, ...],
    window: Window,
    lamp: list[float],
) -> Merged:
    """As `Radiometry.radiance`, of a window of the frames only."""
    frames = [sequence.frames[i] for i in group]
    times = [float(frame.need("exposure_s")) for frame in frames]
    warm = [f.temperature_c for f in frames if f.temperature_c is not None]
    noise = radiometry.at_temperature(float(np.mean(warm)) if warm else None)
    raw, channels = [], 1
    for i in group:
        image = sequence.image(i)
        channels = 1 if image.ndim == 2 else image.shape[2]
        raw.append(as_plane(image[window]))

    def part(value: Any) -> Any:
        if np.ndim(value) != 2:
            return value
        return as_plane(value.reshape(len(value), -1, channels)[window])

    noise = replace(
        noise, black=part(noise.black), dark=part(noise.dark), sensitivity=part(noise.sensitivity)
    )
    merged = merge_exposures(raw, [t * radiometry.factor(t) for t in times], noise, lamp=lamp)
    if channels == 1:
        return merged
    shape = (len(merged.radiance), -1, channels)
    return Merged(
        merged.radiance.reshape(shape),
        merged.variance.reshape(shape),
        merged.validity.reshape(shape),
    )


def without_stray(
    radiometry: Radiometry, stray: Stray, merged: Merged, sparse: Merged, window: Window
) -> Merged:
    """As `Stray.removed`, with the frame's mean from a part of its pixels."""
    h, w = merged.radiance.shape[:2]
    rows, columns = sparse.radiance.shape[:2]
    lens, few = _lens(radiometry, merged, window), _lens(radiometry, sparse, (EVERY, EVERY))
    if merged.radiance.ndim == 3:
        spread: Floats = stray.share * frame_means(sparse, few, None) / lens
    else:
        # An odd step meets the colours of a mosaic in the order of the mosaic itself, and windows
        # begin with a whole cell of it.
        added = stray.share * frame_means(sparse, few, radiometry.colours((rows, columns)))
        own = radiometry.colours((h, w))
        spread = (added[0] if own is None else added[own]) / lens
    return replace(merged, radiance=(merged.radiance - spread).astype(np.float32))


def _lens(radiometry: Radiometry, merged: Merged, window: Window) -> Floats:
    """Shading of the lens over a window of the frame, of the shape of what was merged there."""
    shading, shape = radiometry.shading, merged.radiance.shape
    if shading is None:
        return np.ones(shape)
    return shading.reshape(len(shading), -1, *shape[2:])[window]
