"""Footprints and levels of detail, as the contract defines them.

A footprint is the standard deviation of a Gaussian kernel in texels of the data's grid; 0.5 is one
texel, and what a texel holds already. Level l is the footprint 0.5 * 2^l; a BTF's level l is its
texture blurred by sqrt(footprint^2 - 0.25) texels. The native kernels and their twins, which lie
below this module, hold the same logarithm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from btfkit.textures import Array, Index, as_textures

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


@final
@dataclass(frozen=True, eq=False)
class Blurs:
    """The blur of every texel of every view, which differs over a texture seen by a near camera.

    Attributes:
        maps: (m, h, w, 3) covariance of a texel's whole blur, texels squared: uu, uv, vv with u
            along columns and v along rows; NaN where the view does not show it. Lazy.
        of: (n,) which map each pair has; all lights of a view share one.

    Raises:
        ValueError: arrays that do not fit each other.
    """

    maps: Any
    of: NDArray[np.integer]

    def __post_init__(self) -> None:
        object.__setattr__(self, "maps", as_textures(self.maps))
        m, _, _, c = self.maps.shape
        if c != 3 or self.of.ndim != 1 or self.of.size == 0:
            raise ValueError(f"maps {self.maps.shape} of pairs {self.of.shape} are no blurs")
        if self.of.min() < 0 or self.of.max() >= m:
            raise ValueError(f"pairs have blurs {self.of.min()} to {self.of.max()}; there are {m}")

    def of_pair(self, pair: int) -> Array:
        """(h, w, 3) covariance of the blur of every texel of a pair."""
        return np.asarray(self.maps[int(self.of[pair])])

    def subset(self, pairs: Index) -> Blurs:
        """Those of some pairs, without maps that none of them has."""
        used, of = np.unique(self.of[pairs], return_inverse=True)
        return Blurs(self.maps.subset(used.astype(np.intp)), of)

    def crop(self, rows: slice, cols: slice) -> Blurs:
        """Those of a window."""
        return Blurs(self.maps.crop(rows, cols), self.of)
