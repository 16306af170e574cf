"""Whether the reference pose still looks as it did: its level, and where it is."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# Neighbours of a correlation peak that its place between pixels is read from.
_PATCH = 1


class Drift(NamedTuple):
    """Change of the reference since the run began: relative level, and pixels."""

    level: float
    shift_px: float


def compared(
    first: NDArray[np.uint16],
    now: NDArray[np.uint16],
    *,
    black: float,
    scale: float,
    window: NDArray[np.bool_],
) -> Drift:
    """How far a frame of the reference pose is from the first one.

    Args:
        first, now: (h, w) or (h, w, 3) counts.
        black: counts of no light.
        scale: light (exposure and lamp) of `now` over that of `first`.
        window: (h, w) pixels of the white reference.
    """
    level = (now[window].mean() - black) / max((first[window].mean() - black) * scale, 1e-9) - 1
    return Drift(float(level), float(np.hypot(*moved(binned(first), binned(now))) * 2))


def binned(image: NDArray[np.uint16]) -> NDArray[np.float64]:
    """(h/2, w/2) means of 2 x 2 pixels, so that a mosaic's colours do not count."""
    grey = image.mean(-1) if image.ndim == 3 else image.astype(np.float64)
    h, w = grey.shape[0] // 2 * 2, grey.shape[1] // 2 * 2
    return np.asarray(grey[:h, :w].reshape(h // 2, 2, w // 2, 2).mean((1, 3)))


def moved(first: NDArray[np.float64], now: NDArray[np.float64]) -> tuple[float, float]:
    """Rows and columns by which a picture has moved, by windowed cross-correlation.

    Good to a twentieth of a pixel on a picture with edges: enough to see that something gave way.
    """
    window = np.outer(np.hanning(first.shape[0]), np.hanning(first.shape[1]))
    a, b = (np.fft.rfft2((image - image.mean()) * window) for image in (first, now))
    peak = np.fft.irfft2(np.conj(a) * b, first.shape)
    row, col = np.unravel_index(int(np.argmax(peak)), peak.shape)
    parts = []
    for axis, (at, count) in enumerate(zip((int(row), int(col)), first.shape, strict=True)):
        line = np.take(peak, int(col) if axis == 0 else int(row), axis=1 - axis)
        left, middle, right = (float(line[(at + k) % count]) for k in (-_PATCH, 0, _PATCH))
        bend = left - 2 * middle + right
        between = 0.0 if bend == 0 else 0.5 * (left - right) / bend
        parts.append((at if at <= count // 2 else at - count) + between)
    return parts[0], parts[1]
