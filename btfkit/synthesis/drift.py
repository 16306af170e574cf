"""What drifts across a sample, bent until its ends meet.

Light falls off, lenses vignette: one end of a sample is brighter than the other, and repeated
side by side that is a step. The step between the two ends is measured on the overlap, where both
show the same place, and spread over the tile as the smoothest field that has it.

The field is Moisan's smooth component, in closed form and for the lowest frequencies only: a step
of cos(k y) across the rows is met by sinh(kappa (x - P/2)) / (2 sinh(kappa P/2)) cos(k y), which
is harmonic, meets itself with that step and with equal slopes, and has mean 0; k = 0 is a ramp.

Source: Moisan, "Periodic plus Smooth Image Decomposition", Journal of Mathematical Imaging and
Vision 39, 2011.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]
# Waves along a side of the tile that count as drift; shorter ones are the material.
_WAVES = 2
# Below this share of the mean of an image a local mean says nothing about the light.
_FLOOR = 0.02


@final
@dataclass(frozen=True, eq=False)
class Drift:
    """The fields that bend a sample until it meets itself, up to their strengths.

    Attributes:
        origin: (row, col) of the window in the sample. tile: (p, q). overlap: (rows, cols).
        ramps: per axis (2 waves + 1, size + overlap), functions across that axis's seam.
        waves: per axis the same shape, the functions along that axis.
    """

    origin: tuple[int, int]
    tile: tuple[int, int]
    overlap: tuple[int, int]
    ramps: tuple[Floats, Floats]
    waves: tuple[Floats, Floats]

    @staticmethod
    def of(origin: tuple[int, int], tile: tuple[int, int], overlap: tuple[int, int]) -> Drift:
        """The fields of a window at `origin` that shows a tile and the overlaps after it."""
        lengths = [t + o for t, o in zip(tile, overlap, strict=True)]
        waves = tuple(_waves(n, t) for n, t in zip(lengths, tile, strict=True))
        ramps = (_ramps(lengths[0], *tile), _ramps(lengths[1], *tile[::-1]))
        return Drift(origin, tile, overlap, ramps, (waves[0], waves[1]))

    def strengths(self, image: Floats) -> Floats:
        """(2, k, c) how strong each field is in an image (h, w, c), by the axis of its step.

        Logarithms of gain. Texels that are not measured on both ends do not count; an axis without
        overlap has no step, and neither has an image whose mean is not positive.
        """
        (row, col), (p, q), (down, across) = self.origin, self.tile, self.overlap
        window = image[row : row + p + down, col : col + q + across].astype(np.float64)
        floor = _FLOOR * _mean(window)
        turned = np.swapaxes(window[:p], 0, 1)
        down_step = _step(window[:down, :q], window[p:, :q], self.waves[1][:, :q], floor)
        across_step = _step(turned[:across], turned[q:], self.waves[0][:, :p], floor)
        return np.stack([down_step, across_step])

    def gain(self, strengths: Floats) -> NDArray[np.float32]:
        """(p + o, q + o, c) factor for the window that takes the drift away."""
        down = np.einsum("kx,kc,ky->xyc", self.ramps[0], strengths[0], self.waves[1], optimize=True)
        across = np.einsum(
            "kx,kc,ky->xyc", self.waves[0], strengths[1], self.ramps[1], optimize=True
        )
        return np.exp(-(down + across)).astype(np.float32)

    def gain_at(
        self, strengths: Floats, rows: NDArray[np.intp], cols: NDArray[np.intp]
    ) -> NDArray[np.float32]:
        """(b, c) the same at rows and columns (b,) of the sample, with strengths (b, 2, k, c)."""
        x, y = rows - self.origin[0], cols - self.origin[1]
        down = self.ramps[0][:, x] * self.waves[1][:, y]
        across = self.waves[0][:, x] * self.ramps[1][:, y]
        field = np.einsum("kb,bkc->bc", down, strengths[:, 0])
        field += np.einsum("kb,bkc->bc", across, strengths[:, 1])
        return np.exp(-field).astype(np.float32)


def _waves(length: int, period: int) -> Floats:
    """(2 waves + 1, length) the constant, and cosine and sine of each wave the period can hold."""
    phase = 2 * np.pi * np.arange(length) / period
    pairs = [
        (2 * k < period) * f(k * phase) for k in range(1, _WAVES + 1) for f in (np.cos, np.sin)
    ]
    return np.stack([np.ones(length), *pairs])


def _ramps(length: int, tile: int, beside: int) -> Floats:
    """(2 waves + 1, length) the harmonic functions that rise by 1 from one end to the other."""
    x = np.arange(length)
    turns, at = np.divmod(x, tile)
    at = (at + 0.5) / tile - 0.5
    ramps = [at]
    for k in range(1, _WAVES + 1):
        # sinh(a t) / sinh(a / 2), by exponentials of what is below 0: a may be thousands.
        a = 2 * np.pi * k * tile / beside
        rise = np.sign(at) * (np.exp(a * (np.abs(at) - 0.5)) - np.exp(-a * (np.abs(at) + 0.5)))
        ramps += [rise / (2 * -np.expm1(-a))] * 2
    return np.stack(ramps) + turns


def _mean(image: Floats) -> Floats:
    """(c,) mean of what is measured of an image (h, w, c); 0 where nothing is."""
    good = np.isfinite(image)
    return np.where(good, image, 0).sum((0, 1)) / np.maximum(good.sum((0, 1)), 1)


def _step(near: Floats, far: Floats, waves: Floats, floor: Floats) -> Floats:
    """(k, c) waves of the logarithm of far / near along a seam; both (o, n, c)."""
    k, c = len(waves), near.shape[-1]
    good = np.isfinite(near) & np.isfinite(far)
    count = good.sum(axis=0)
    if not count.any() or (floor <= 0).all():
        return np.zeros((k, c))
    sums = [_low(np.where(good, side, 0).sum(axis=0)) for side in (near, far)]
    weight = np.maximum(_low(count.astype(np.float64)), 1e-9)
    lit = floor > 0
    means = [np.maximum(total / weight, np.where(lit, floor, 1.0)) for total in sums]
    step = np.where(lit, np.log(means[1]) - np.log(means[0]), 0.0)
    # A wave that the side cannot hold is 0 all over.
    return waves @ step / np.maximum(np.square(waves).sum(axis=1, keepdims=True), 1.0)


def _low(values: Floats) -> Floats:
    """Values (n, c) around a closed seam, without what is shorter than drift."""
    spectrum = np.fft.rfft(values, axis=0)
    k = np.arange(len(spectrum))[:, None]
    return np.fft.irfft(spectrum * np.exp(-0.5 * (k / _WAVES) ** 2), len(values), axis=0)
