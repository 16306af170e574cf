"""Rectification: error against CPU seconds of bilinear samples, areas and Gaussians.

The cloth is synthetic: pixels and texels are integrated from the same fine samples. Errors are
signal to noise against the mean over a texel's area, and against its Gaussian of half a texel.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from btfkit.native import resample

Floats = NDArray[Any]
# Camera pixels a texel, and samples a pixel.
SCALE, FINE = 3.3, 6
_SIDES = {False: (32, 64, 128), True: (8, 12, 16)}
_TILTS_DEG = (0.0, 45.0, 60.0, 75.0)


def cells(*, seed: int, quick: bool) -> list[dict[str, Any]]:
    """A row a method, size and tilt."""
    rng = np.random.default_rng(seed)
    return [row for side in _SIDES[quick] for tilt in _TILTS_DEG for row in _at(side, tilt, rng)]


def _cloth(texels: int, rng: np.random.Generator) -> Floats:
    """A weave with fibres, SCALE * FINE samples a texel and 150 more on every side."""
    size = int(texels * SCALE * FINE) + 300
    y, x = np.mgrid[:size, :size] / (SCALE * FINE)
    warp, weft = (0.5 + 0.5 * np.sin(2 * np.pi * at / 4.37) for at in (x, y))
    over = (np.floor(2 * x / 4.37) + np.floor(2 * y / 4.37)) % 2 > 0
    fibres = ndimage.gaussian_filter(rng.standard_normal((size, size)), 1.2)
    return np.clip(np.where(over, warp, weft) * 0.6 + 0.2 + 0.12 * fibres / fibres.std(), 0.02, 2)


def _integrated(fine: Floats, rows: Floats, columns: Floats) -> Floats:
    """Means over the rectangles between edges, in samples."""
    total = np.cumsum(np.cumsum(np.pad(fine, ((1, 0), (1, 0))), 0), 1)
    at = ndimage.map_coordinates(total, np.meshgrid(rows, columns, indexing="ij"), order=1)
    return np.diff(np.diff(at, axis=0), axis=1) / (np.diff(rows)[:, None] * np.diff(columns))


def _snr_db(truth: Floats, found: Floats) -> float:
    """Variance of the truth over the mean square of the error."""
    return float(10 * np.log10(np.var(truth) / np.mean((found - truth) ** 2)))


def _at(texels: int, tilt_deg: float, rng: np.random.Generator) -> list[dict[str, Any]]:
    """One line a method, at one size and one tilt."""
    fine = _cloth(texels, rng)
    tilt = np.radians(tilt_deg)
    wide, span = FINE / np.cos(tilt), texels * SCALE * FINE
    columns = np.arange(150 - 140 // wide * wide, 150 + span + 140, wide)
    rows = np.arange(150 - 140 // FINE * FINE, 150 + span + 140, FINE)
    frame = _integrated(fine, rows, columns).astype(np.float32)[..., None]
    middle = 150 + (np.arange(texels) + 0.5) * SCALE * FINE
    grid = np.meshgrid((middle - columns[0]) / wide - 0.5, (middle - rows[0]) / FINE - 0.5)
    place: Floats = np.stack(grid, axis=-1).reshape(-1, 2)
    slope = np.diag([SCALE * np.cos(tilt), SCALE])
    edges = 150 + np.arange(texels + 1) * SCALE * FINE
    area_truth = _integrated(fine, edges, edges)
    blurred = ndimage.gaussian_filter(fine, 0.5 * SCALE * FINE, truncate=6)
    at = np.meshgrid(middle - 0.5, middle - 0.5, indexing="ij")
    gauss_truth = ndimage.map_coordinates(blurred, at, order=1)
    extra = np.maximum(0.25 * np.diag(slope) ** 2 - 1 / 12, 0.25)
    packed = np.array([resample.KEPT / extra[0], 0, resample.KEPT / extra[1]], np.float32)
    count = len(place)
    methods: dict[str, Callable[[], Any]] = {
        "bilinear": lambda: ndimage.map_coordinates(frame[..., 0], place[:, ::-1].T, order=1),
        "area": lambda: (
            resample.area(
                frame, place, np.tile(slope.astype(np.float32), (count, 1, 1)), threads=1
            ).value
        ),
        "ewa": lambda: resample.ewa(frame, place, np.tile(packed, (count, 1)), threads=1).value,
    }
    out = []
    for name, method in methods.items():
        start = time.process_time()
        found = method().reshape(texels, texels)
        seconds = time.process_time() - start
        out.append({
            "method": name, "texels": texels, "tilt, degrees": tilt_deg, "cpu_s": seconds,
            "dB to areas": _snr_db(area_truth, found),
            "dB to Gaussians": _snr_db(gauss_truth, found),
        })  # fmt: skip
    return out
