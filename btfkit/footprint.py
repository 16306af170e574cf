"""Footprints and levels of detail, as the contract defines them.

A footprint is the standard deviation of a Gaussian kernel in texels of the data's grid; 0.5 is one
texel, and what a texel holds already. Level l is the footprint 0.5 * 2^l; a BTF's level l is its
texture blurred by sqrt(footprint^2 - 0.25) texels. The native kernels and their twins, which lie
below this module, hold the same logarithm.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from btfkit.textures import Array

# One texel: the footprint that needs no level and no blur.
FINEST = 0.5


def level_of(footprint: ArrayLike) -> NDArray[np.floating]:
    """(...) levels, 0 or more, of footprints (...)."""
    return np.log2(2 * np.clip(footprint, FINEST, 1e30))


def of_level(level: ArrayLike) -> NDArray[np.floating]:
    """(...) footprints of levels (...), which may lie between whole ones."""
    return np.asarray(FINEST * 2.0 ** np.asarray(level))


def blur_of(footprint: float) -> float:
    """Variance, texels squared, of the blur that takes a texture to a footprint."""
    return footprint**2 - FINEST**2


def most_levels(size: tuple[int, int]) -> int:
    """Levels of a pyramid that ends in one texel."""
    return max(size).bit_length()


def level_sizes(size: tuple[int, int], levels: int) -> tuple[tuple[int, int], ...]:
    """(h, w) of each level of a pyramid, halved and rounded down, never below 1."""
    return tuple((max(size[0] >> s, 1), max(size[1] >> s, 1)) for s in range(levels))


def resolved_level(size: tuple[int, int], grid: tuple[int, int]) -> float:
    """Level of the data's grid (h, w) that a texture of `size` resolves, 0 or more."""
    ratio = math.sqrt(grid[0] * grid[1] / (size[0] * size[1]))
    return max(math.log2(ratio), 0.0)


@lru_cache(maxsize=8)
def gaussian(side: int, variance: float, *, wrap: bool) -> Array:
    """(side, side) matrix that blurs a column of texels; rows sum to 1, borders wrap or clamp.

    Args:
        side: texels. variance: of the Gaussian, texels squared.
    """
    if variance <= 0:
        return np.eye(side, dtype=np.float32)
    reach = math.ceil(4 * math.sqrt(variance))
    steps = np.arange(-reach, reach + 1)
    weight = np.exp(-(steps**2) / (2 * variance))
    weight /= weight.sum()
    matrix = np.zeros((side, side))
    at = np.arange(side)[:, None] + steps
    at = at % side if wrap else np.clip(at, 0, side - 1)
    np.add.at(matrix, (np.arange(side)[:, None], at), weight)
    return matrix.astype(np.float32)


def blurred(image: Array, down: Array, across: Array) -> Array:
    """down @ image @ across^T of an image (h, w, c); NaN where less than half is measured."""
    finite = np.isfinite(image)
    return blurred_measured(image, down, across, None if finite.all() else finite)


def blurred_measured(
    image: Array, down: Array, across: Array, measured: NDArray[np.bool_] | None
) -> Array:
    """As `blurred`, where it is known what is measured (h, w, c); None: everything."""
    if measured is None:
        return _separable(image, down, across)
    known = _separable(measured.astype(np.float32), down, across)
    total = _separable(np.where(measured, image, np.float32(0)), down, across)
    return np.where(known >= 0.5, total / np.maximum(known, 1e-6), np.float32(np.nan))


def _separable(image: Array, down: Array, across: Array) -> Array:
    h, w, c = image.shape
    part = (down @ image.reshape(h, -1)).reshape(-1, w, c)
    found: Array = np.matmul(across, part)
    return found
