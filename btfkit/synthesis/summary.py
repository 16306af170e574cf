"""A few slices of a material side by side, as the search for a tile sees them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Floats = NDArray[np.floating]
# Drift is what is longer than this share of a side.
_DRIFT = 1 / 6
# Beyond so many deviations a highlight is a highlight: one slice must not decide for all.
_MOST = 3.0


@final
@dataclass(frozen=True, eq=False)
class Summary:
    """Channels of several slices, each in its own deviations.

    Attributes:
        raw: (k, h, w) square roots of the values, NaN where not measured.
        flat: (k, h, w) the same without what drifts, mean 0.
    """

    raw: NDArray[np.float32]
    flat: NDArray[np.float32]

    @staticmethod
    def of(slices: Iterable[Floats]) -> Summary:
        """The summary of slices (h, w, c).

        Raises:
            ValueError: no slice has a measured texel.
        """
        raws, flats = [], []
        for image in slices:
            for channel in _few_channels(image):
                if np.isfinite(channel).any():
                    raw, flat = _prepared(channel)
                    raws.append(raw)
                    flats.append(flat)
        if not raws:
            raise ValueError("no texel of the sample is measured: nothing to make a tile of")
        return Summary(np.stack(raws), np.stack(flats))

    def mismatch(
        self, first: tuple[NDArray[np.intp], ...], second: tuple[NDArray[np.intp], ...]
    ) -> tuple[Floats, Floats, Floats]:
        """How unlike the texels at two grids (rows, cols) are, and where each is not measured.

        Returns:
            three (o, q): mean over slices of |difference|, at most 3 deviations each; and 1 where
            no slice measures the first, the second.
        """
        a, b = (self.flat[:, at[0], at[1]] for at in (first, second))
        apart = np.minimum(np.abs(a - b), _MOST)
        good = np.isfinite(apart)
        mean: Floats = np.where(good, apart, 0).sum(axis=0) / np.maximum(good.sum(axis=0), 1)
        return mean, _missing(a), _missing(b)


def spread_out(light: Floats, view: Floats, count: int) -> Sequence[int]:
    """Pairs that differ, first the most frontal, each next the farthest from those before.

    Args:
        light, view: (n, 3) directions. Steep ones are left out where there are others.
        count: of pairs at most.
    """
    usable = np.flatnonzero((view[:, 2] > 0.7) & (light[:, 2] > 0.4))
    if not len(usable):
        usable = np.arange(len(view))
    where = np.concatenate([light[usable, :2], view[usable, :2]], axis=1).astype(np.float64)
    chosen = [int(np.argmax(view[usable, 2] + 1e-3 * light[usable, 2]))]
    distance = np.full(len(usable), np.inf)
    while len(chosen) < min(count, len(usable)):
        distance = np.minimum(distance, np.square(where - where[chosen[-1]]).sum(axis=1))
        farthest = int(np.argmax(distance))
        if distance[farthest] < 1e-6:
            break
        chosen.append(farthest)
    return [int(usable[i]) for i in chosen]


def _missing(slices: Floats) -> Floats:
    return np.where(np.isfinite(slices).any(axis=0), 0.0, 1.0)


def _few_channels(image: Floats) -> list[Floats]:
    """At most three channels (h, w): of a spectrum, the means of its thirds."""
    c = image.shape[-1]
    if c <= 3:
        return [image[..., i] for i in range(c)]
    return [part.mean(axis=-1) for part in np.array_split(image, 3, axis=-1)]


def _prepared(channel: Floats) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    good = np.isfinite(channel)
    values = np.where(good, channel, 0).astype(np.float64)
    # The eye sees ratios in the light and little in the dark: between line and logarithm.
    raw = np.sign(values) * np.sqrt(np.abs(values))
    base = _local_mean(raw, good)
    floor = 0.05 * float(np.abs(raw[good]).mean())
    flat = raw / np.maximum(base, floor) if floor > 0 else raw
    flat = flat - _local_mean(np.where(good, flat, 0), good)
    return _in_deviations(raw, good), _in_deviations(flat, good)


def _local_mean(values: Floats, good: NDArray[np.bool_]) -> Floats:
    sigma = [_DRIFT * size for size in values.shape]
    total = ndimage.gaussian_filter(values, sigma, mode="reflect", truncate=2.5)
    weight = ndimage.gaussian_filter(good.astype(np.float64), sigma, mode="reflect", truncate=2.5)
    return total / np.maximum(weight, 1e-9)


def _in_deviations(values: Floats, good: NDArray[np.bool_]) -> NDArray[np.float32]:
    measured = values[good]
    # Rounding of a constant is no structure.
    deviation = max(float(measured.std()), 1e-6 * float(np.abs(measured).mean()), 1e-30)
    return np.where(good, (values - measured.mean()) / deviation, np.nan).astype(np.float32)
