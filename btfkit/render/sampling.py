"""Where in a pixel rays go through, and which numbers choose their lights."""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]
# The root of g³ = g + 1: multiples of 1/g and 1/g² fill the square evenly.
_PLASTIC = 1.3247179572447460
STEP: Floats = np.array([1 / _PLASTIC, 1 / _PLASTIC**2])
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX = (
    (np.uint64(30), np.uint64(0xBF58476D1CE4E5B9)),
    (np.uint64(27), np.uint64(0x94D049BB133111EB)),
)


@final
class PixelSamples:
    """Low-discrepancy samples: the R2 sequence in every pixel; lights shifted between pixels.

    Args:
        size: (h, w) pixels.
        samples: rays a pixel.
        seed: of the shifts.

    Source: Roberts, "The Unreasonable Effectiveness of Quasirandom Sequences", 2018.
    """

    def __init__(self, size: tuple[int, int], samples: int, *, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.size, self.samples = size, samples
        sequence = (0.5 + np.arange(samples)[:, None] * STEP) % 1
        self._within = _tent(sequence) if samples > 1 else np.zeros((1, 2))
        # Another order, so that a place in the pixel does not go with a direction of light.
        self._lights = sequence[rng.permutation(samples)]
        self._key = rng.integers(1 << 63, size=2, dtype=np.uint64)

    def places(self, pixels: NDArray[np.intp], some: range) -> Floats:
        """(pixels * some, 2) columns and rows in the picture, mirrored at its borders."""
        h, w = self.size
        centre = np.stack([pixels % w + 0.5, pixels // w + 0.5], axis=1)
        place = (centre[:, None] + self._within[some.start : some.stop]).reshape(-1, 2)
        place = np.abs(place)
        return np.minimum(place, 2.0 * np.array([w, h]) - place)

    def lights(self, pixels: NDArray[np.intp], some: range) -> Floats:
        """(pixels * some, 2) even numbers in 0..1."""
        return ((self._lights[some.start : some.stop] + self._shifts(pixels)[:, None]) % 1).reshape(
            -1, 2
        )

    def _shifts(self, pixels: NDArray[np.intp]) -> Floats:
        """(pixels, 2) even numbers in 0..1.

        Source: Steele et al., "Fast Splittable Pseudorandom Number Generators", 2014, the
        finaliser in the constants of SplitMix64.
        """
        x = (pixels[:, None].astype(np.uint64) + np.uint64(1)) * _GOLDEN ^ self._key
        for shift, factor in _MIX:
            x = (x ^ (x >> shift)) * factor
        return ((x ^ (x >> np.uint64(31))) >> np.uint64(11)) / 2.0**53


def _tent(square: Floats) -> Floats:
    """Even numbers in 0..1 as places under a tent from -1 to 1."""
    return np.where(
        square < 0.5, np.sqrt(2 * square) - 1, 1 - np.sqrt(np.maximum(2 - 2 * square, 0))
    )
