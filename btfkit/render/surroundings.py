"""Pictures of the surroundings: which projection they are in, and what their values can be."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from btfkit.errors import FormatError

Array = NDArray[np.float32]
# The largest half float: what a sun that became infinite was at least.
_LARGEST_HALF = 65504.0
# A panorama whose sides are that near to 2 : 1 lacks a row or has one too many.
_RATIO = 0.02
# Looks at each pixel of the panorama along a side, where a probe is turned into one.
_FINE = 3


def cleaned(path: Path, values: Array) -> Array:
    """Radiance that is finite and not negative.

    Infinite values are suns beyond the range of half floats: they count as the largest half, or as
    the brightest finite value where that is more. NaN and negative values count as 0. It is told.
    """
    infinite = np.isposinf(values)
    if infinite.any():
        finite = values[np.isfinite(values)]
        sun = max(_LARGEST_HALF, float(finite.max(initial=0)))
        warnings.warn(
            f"{path}: {int(infinite.sum())} of {values.size} values are infinite, brighter than "
            f"half floats can be; they count as {sun:g}, which is the least that they were",
            stacklevel=3,
        )
        values = np.where(infinite, np.float32(sun), values)
    bad = ~np.isfinite(values) | (values < 0)
    if bad.any():
        warnings.warn(
            f"{path}: {int(bad.sum())} of {bad.size} values are negative or not finite; "
            "they count as 0",
            stacklevel=3,
        )
        values = np.where(bad, np.float32(0), values)
    return values


def as_panorama(path: Path, values: Array) -> Array:
    """A picture (h, w, c) by latitude and longitude, twice as wide as high, of what lies in a file.

    Raises:
        FormatError: neither that nor a square angular probe in black.
    """
    h, w = values.shape[:2]
    if abs(w - 2 * h) <= max(1, _RATIO * h):
        return values
    if h == w and _is_probe(values):
        warnings.warn(
            f"{path}: a square with black corners; it is taken for an angular probe that looks "
            "along -z",
            stacklevel=3,
        )
        return from_probe(values)
    raise FormatError(
        path,
        f"is {w} x {h}; expected a panorama by latitude and longitude, twice as wide as high, or a "
        "square angular probe in black",
        remedy="convert it to a panorama of 2 : 1",
    )


def from_probe(probe: Array) -> Array:
    """(n, 2 n, c) panorama of an angular probe (n, n, c).

    The middle of a probe looks along -z, its distance from the middle is the angle to that, and its
    rim looks back. Source: Debevec, "Light probe image gallery", 1998.
    """
    n = probe.shape[0]
    whole = _beyond_rim(probe)
    out = np.zeros((n, 2 * n, probe.shape[2]))
    for down in range(_FINE):
        for along in range(_FINE):
            theta = (np.arange(n) + (down + 0.5) / _FINE)[:, None] / n * np.pi
            azimuth = (np.arange(2 * n) + (along + 0.5) / _FINE) / n * np.pi
            # As in Environment: column 0 looks along z, the middle along -z, y is up.
            x, y = -np.sin(theta) * np.sin(azimuth), np.cos(theta)
            z = np.sin(theta) * np.cos(azimuth)
            flat = np.hypot(x, y)
            radius = np.arctan2(flat, -z) / np.pi / np.maximum(flat, 1e-12)
            out += _between(whole, (1 - y * radius) * n / 2 - 0.5, (1 + x * radius) * n / 2 - 0.5)
    return (out / _FINE**2).astype(np.float32)


def _is_probe(values: Array) -> bool:
    """Whether a square is black outside the circle in it, and not inside."""
    outside = _radius(len(values)) > 1 + 2 / len(values)
    bright = np.abs(values).max(axis=2)
    return bool(outside.any() and bright[outside].max() <= 1e-3 * bright.max() and bright.max() > 0)


def _radius(n: int) -> NDArray[np.float64]:
    """(n, n) distance of pixels from the middle; 1 is the rim."""
    at = (np.arange(n) + 0.5) * 2 / n - 1
    return np.hypot(at, at[:, None])


def _beyond_rim(probe: Array) -> Array:
    """The probe with its rim carried on outwards, so that no black is mixed in."""
    n = len(probe)
    row, col = np.indices((n, n)) + 0.5 - n / 2
    radius = np.hypot(row, col)
    most = n / 2 - 1
    scale = np.where(radius > most, most / np.maximum(radius, 1e-12), 1.0)
    inner = [np.clip(np.rint(at * scale + n / 2 - 0.5).astype(int), 0, n - 1) for at in (row, col)]
    return probe[inner[0], inner[1]]


def _between(values: Array, row: NDArray[np.float64], col: NDArray[np.float64]) -> Array:
    """Bilinear values at rows and columns counted from pixel centres."""
    n = len(values)
    top, left = (np.clip(np.floor(at).astype(int), 0, max(n - 2, 0)) for at in (row, col))
    down, along = (np.clip(at - start, 0, 1)[..., None] for at, start in ((row, top), (col, left)))
    below, right = np.minimum(top + 1, n - 1), np.minimum(left + 1, n - 1)
    upper = values[top, left] * (1 - along) + values[top, right] * along
    lower = values[below, left] * (1 - along) + values[below, right] * along
    return np.asarray(upper * (1 - down) + lower * down)
