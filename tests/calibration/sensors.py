"""A sensor made up for tests: photons in, counts out. It shares no code with the calibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class FakeSensor:
    """Twelve bits, 15 electrons a count, 6 electrons of read noise.

    Attributes:
        gain: electrons a count. read_e: electrons. black, white: counts. dark_e_s: electrons a
            second. doubling_k, temperature_c: of the dark current.
    """

    gain: float = 15.0
    read_e: float = 6.0
    black: float = 200.0
    white: int = 4095
    dark_e_s: float = 0.0
    temperature_c: float = 24.0
    doubling_k: float = 6.0
    bend: float = 0.0

    def shoot(self, photons_s, exposure_s, rng, *, temperature_c=None, offset=0.0):
        """(h, w) uint16 counts of (h, w) electrons a second; `offset` counts of fixed pattern."""
        warm = self.temperature_c if temperature_c is None else temperature_c
        dark = self.dark_e_s * 2 ** ((warm - self.temperature_c) / self.doubling_k)
        electrons = rng.poisson((np.maximum(photons_s, 0) + dark) * exposure_s)
        above = (electrons + rng.normal(0, self.read_e, np.shape(photons_s))) / self.gain
        above *= 1 - self.bend * above / (self.white - self.black)
        counts = np.rint(self.black + offset + above)
        return np.clip(counts, 0, self.white).astype(np.uint16)


def information(mean, variance, slope_mean, slope_variance, white):
    """Fisher information that one rounded and clipped normal count holds, summed over its codes.

    Args:
        mean, variance: of the count. slope_mean, slope_variance: their derivatives.
        white: the highest code; everything above is in it.
    """
    from scipy.special import ndtr

    sd = np.sqrt(variance)
    low = int(max(np.floor(mean - 9 * sd), 0))
    high = int(min(np.ceil(mean + 9 * sd), white))
    if low >= white:
        return 0.0
    edges = np.append(np.arange(low, high + 1) - 0.5, high + 0.5)
    edges[0] = -np.inf
    if high == white:
        edges[-1] = np.inf

    def shares(step):
        m, s = mean + step * slope_mean, np.sqrt(variance + step * slope_variance)
        return np.diff(ndtr((edges - m) / s))

    step = 1e-4 * sd / max(slope_mean, 1e-300)
    p, change = shares(0.0), (shares(step) - shares(-step)) / (2 * step)
    told = p > 1e-15
    return float(np.sum(change[told] ** 2 / p[told]))
