"""Colours between the pixels of a mosaic, after merging: a linear filter and its variance.

Source: Malvar, He, Cutler, "High-quality linear interpolation for demosaicing of Bayer-patterned
color images", 2004, figure 2. Where a sample under the filter says nothing, the mean of those
neighbours that do stands in: a saturated pixel does not spread over 5 x 5.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from btfkit.calibration.merge import SATURATED, Merged

Array = NDArray[np.float32]
CFAS = ("RGGB", "BGGR", "GRBG", "GBRG")
_CROSS = np.array(
    [[0, 0, -2, 0, 0], [0, 0, 4, 0, 0], [-2, 4, 8, 4, -2], [0, 0, 4, 0, 0], [0, 0, -2, 0, 0]]
)
_ALONG = np.array(
    [[0, 0, 1, 0, 0], [0, -2, 0, -2, 0], [-2, 8, 10, 8, -2], [0, -2, 0, -2, 0], [0, 0, 1, 0, 0]]
)
_DIAGONAL = np.array(
    [[0, 0, -3, 0, 0], [0, 4, 0, 4, 0], [-3, 0, 12, 0, -3], [0, 4, 0, 4, 0], [0, 0, -3, 0, 0]]
)
_NEAR = np.array([[0.25, 0.5, 0.25], [0.5, 1, 0.5], [0.25, 0.5, 0.25]])


def demosaic(merged: Merged, cfa: str, *, balance: ArrayLike = (1.0, 1.0, 1.0)) -> Merged:
    """Three colours at every pixel of a merged mosaic.

    Args:
        merged: (h, w) of a Bayer mosaic.
        cfa: colours of the first 2 x 2 pixels, row by row.
        balance: (3,) counts of a white surface: the filter reads detail from the other colours,
            which must be of like size for it.

    Returns:
        (h, w, 3) in the counts of each colour; NaN, as before, where a pixel saturates. A dead
        pixel takes what its neighbours say. The variance is of each colour by itself.

    Raises:
        ValueError: no such mosaic.
    """
    if cfa not in CFAS:
        raise ValueError(f"mosaic {cfa!r}; expected one of {', '.join(CFAS)}")
    white = np.asarray(balance, np.float32)
    h, w = merged.radiance.shape
    colour = sites(cfa, (h, w))
    scale = white[colour]
    known = np.isfinite(merged.radiance)
    value = np.where(known, merged.radiance, 0) / scale
    variance = np.where(known, merged.variance, 0) / scale**2
    radiance, spread = np.empty((h, w, 3), np.float32), np.empty((h, w, 3), np.float32)
    best, noise = _malvar(value, variance, cfa)
    # Beside what is not known the large filter would mix nothing into its result.
    holes = ~known.all() and _filtered(known.astype(np.float32), np.ones((5, 5))) < 24.5
    for c in range(3):
        own = (colour == c) & known
        radiance[..., c] = np.where(own, value, best[..., c]) * white[c]
        spread[..., c] = np.where(own, variance, noise[..., c]) * white[c] ** 2
        if np.any(holes):
            near, near_noise = _neighbours(value, variance, known & (colour == c))
            other = holes & ~own
            radiance[other, c] = near[other] * white[c]
            spread[other, c] = near_noise[other] * white[c] ** 2
    lost = (merged.validity == SATURATED)[..., None] | ~np.isfinite(radiance)
    validity = np.repeat(merged.validity[..., None], 3, axis=2)
    with np.errstate(invalid="ignore"):
        below = radiance * np.abs(radiance) < spread
    validity = np.where(lost, np.maximum(validity, SATURATED), below).astype(np.uint8)
    return Merged(np.where(lost, np.nan, radiance), np.where(lost, np.inf, spread), validity)


def sites(cfa: str, shape: tuple[int, int]) -> NDArray[np.intp]:
    """(h, w) channel that each pixel of a mosaic sees: 0 red, 1 green, 2 blue."""
    tile = np.array(["RGB".index(letter) for letter in cfa]).reshape(2, 2)
    return np.tile(tile, (shape[0] // 2 + 1, shape[1] // 2 + 1))[: shape[0], : shape[1]]


def _malvar(value: Any, variance: Any, cfa: str) -> tuple[Array, Array]:
    """(h, w, 3) where every sample under the filter is known, and the variance; own colours 0."""
    kernels = {"cross": _CROSS, "row": _ALONG, "column": _ALONG.T, "diagonal": _DIAGONAL}
    values = {name: _filtered(value, kernel / 16) for name, kernel in kernels.items()}
    noises = {name: _filtered(variance, (kernel / 16) ** 2) for name, kernel in kernels.items()}
    tile = sites(cfa, (2, 2))
    out, noise = np.zeros((*value.shape, 3), np.float32), np.zeros((*value.shape, 3), np.float32)
    for row in range(2):
        for col in range(2):
            at = (slice(row, None, 2), slice(col, None, 2))
            for c in {0, 1, 2} - {int(tile[row, col])}:
                name = "diagonal"
                if c == 1:
                    name = "cross"
                elif tile[row, col] == 1:
                    # Red and blue lie along the row of a green pixel, or along its column.
                    name = "row" if c in tile[row] else "column"
                out[(*at, c)], noise[(*at, c)] = values[name][at], noises[name][at]
    return out, noise


def _neighbours(value: Any, variance: Any, known: NDArray[np.bool_]) -> tuple[Array, Array]:
    """The mean of the known among the eight neighbours, and its variance; NaN without one."""
    weight = _filtered(known.astype(np.float32), _NEAR)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = _filtered(np.where(known, value, 0), _NEAR) / weight
        return mean, _filtered(np.where(known, variance, 0), _NEAR**2) / weight**2


def _filtered(plane: Any, kernel: NDArray[Any]) -> Array:
    import cv2

    # Mirrored about the outermost pixel, a mosaic goes on as a mosaic.
    filtered: Array = cv2.filter2D(
        np.ascontiguousarray(plane, np.float32), cv2.CV_32F, kernel.astype(np.float32),
        borderType=cv2.BORDER_REFLECT_101,
    )  # fmt: skip
    return filtered
