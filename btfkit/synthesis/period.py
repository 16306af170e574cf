"""What repeats in a sample, and how large a tile can be cut from it.

Each axis is looked at by itself: how well the sample agrees with itself moved along that axis
(normalised correlation of what is measured in both, by FFT), and whether its two ends meet.

Source of the masked correlation: Padfield, "Masked object registration in the Fourier domain",
IEEE Transactions on Image Processing 21(5), 2012.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]
# Shorter sides are left as they are: no overlap of theirs shows anything.
SHORTEST = 8
# Share of a side that the ends overlap at least, and the widest overlap that helps.
_OVERLAP, _WIDEST = 1 / 8, 192
# A peak must be this high, and this many deviations of chance.
_HEIGHT, _DEVIATIONS = 0.2, 4.0
# A smaller period counts if its peak is nearly the highest; so does a larger tile.
_NEARLY = 0.8


@final
@dataclass(frozen=True)
class Side:
    """How one axis of a sample becomes one of a tile.

    Attributes:
        size: of the sample, texels. period: after which it repeats; 0 where nothing does.
        tile: of the tile to cut. overlap: how far the sample goes on after the tile.
        agreement: correlation of the sample with itself, one tile on; 0 where nothing repeats.
    """

    size: int
    period: int
    tile: int
    overlap: int
    agreement: float

    @property
    def start(self) -> int:
        """First row or column of the window, which lies in the middle of the sample."""
        return (self.size - self.tile - self.overlap) // 2


def side_of(flat: Floats, raw: Floats) -> Side:
    """The tile that the rows of a sample allow.

    Args:
        flat: (k, h, w) slices without drift, mean 0; NaN where not measured.
        raw: (k, h, w) the same slices with it.
    """
    size = flat.shape[1]
    if size < SHORTEST:
        return Side(size, 0, size, 0, 0.0)
    overlap = max(2, min(round(size * _OVERLAP), _WIDEST))
    agreement = self_agreement(flat)[: size - overlap + 1]
    period = _period(agreement, _chance(flat, len(agreement)))
    if _closes(raw, period):
        return Side(size, period, size, 0, 1.0)
    if not period:
        return Side(size, 0, size - overlap, overlap, 0.0)
    tile = _longest(agreement, period, size)
    return Side(size, period, tile, min(size - tile, tile, _WIDEST), float(agreement[tile]))


def self_agreement(flat: Floats) -> Floats:
    """(h,) correlation of slices (k, h, w) with themselves, moved by 0, 1, … rows."""
    size = flat.shape[1]
    good = np.isfinite(flat)
    # Twice the length: what is moved out does not come in again.
    values = np.fft.rfft(np.where(good, flat, 0), 2 * size, axis=1)
    squares = np.fft.rfft(np.where(good, flat, 0) ** 2, 2 * size, axis=1)
    mask = np.fft.rfft(good.astype(np.float64), 2 * size, axis=1)

    def moved(a: NDArray[np.complexfloating], b: NDArray[np.complexfloating]) -> Floats:
        return np.fft.irfft((a.conj() * b).sum(axis=(0, 2)), 2 * size)[:size]

    energy = np.maximum(moved(squares, mask), 0) * np.maximum(moved(mask, squares), 0)
    scale = float(np.sqrt(energy[0]))
    # Rounding leaves 1e-16 of the whole where nothing overlaps.
    return moved(values, values) / np.maximum(np.sqrt(energy), 1e-9 * scale + 1e-30)


def _chance(flat: Floats, count: int) -> Floats:
    """(count,) deviation of the agreement of a sample in which nothing repeats.

    By the number of patches in what overlaps, each as large as the sample resembles itself.
    """
    down = _patch(self_agreement(flat))
    across = _patch(self_agreement(np.swapaxes(flat, 1, 2)))
    _, h, w = flat.shape
    patches = np.maximum((h - np.arange(count)) * w / (down * across), 1)
    return 1 / np.sqrt(patches)


def _patch(agreement: Floats) -> float:
    """Texels along an axis that go together: the sum of the first lobe of the agreement."""
    ends = np.flatnonzero(agreement <= 0)
    lobe = agreement[: ends[0] if len(ends) else len(agreement)]
    return max(1.0, float(2 * np.square(lobe).sum() - 1)) if len(lobe) else 1.0


def _period(agreement: Floats, chance: Floats) -> int:
    """The smallest move after which the sample agrees with itself nearly best; 0 for none."""
    inner = np.arange(2, len(agreement) - 1)
    if not len(inner):
        return 0
    peaks = inner[
        (agreement[inner] >= agreement[inner - 1])
        & (agreement[inner] > agreement[inner + 1])
        & (agreement[inner] > np.maximum(_HEIGHT, _DEVIATIONS * chance[inner]))
    ]
    # Before the agreement has fallen, a peak is the texel's own neighbourhood.
    fallen = np.flatnonzero(agreement < 0.5 * agreement[peaks].max(initial=0))
    peaks = peaks[peaks > (fallen[0] if len(fallen) else len(agreement))]
    if not len(peaks):
        return 0
    return int(peaks[agreement[peaks] >= _NEARLY * agreement[peaks].max()][0])


def _longest(agreement: Floats, period: int, size: int) -> int:
    """The largest whole number of periods over which the sample still agrees nearly best.

    Of at least half the sample, where there is one: a small tile repeats itself before the eye.
    """
    found, exact, count = [period], float(period), 1
    while True:
        reach = max(1, round(0.1 * period))
        middle = round(exact * (count + 1) / count)
        if middle > len(agreement) - 1:
            break
        near = np.arange(max(middle - reach, 1), min(middle + reach + 1, len(agreement)))
        best = int(near[np.argmax(agreement[near])])
        count, exact = count + 1, float(best)
        found.append(best)
    large = [tile for tile in found if 2 * tile >= size] or found[-1:]
    values = agreement[large]
    return large[int(np.flatnonzero(values >= _NEARLY * values.max())[-1])]


def _closes(raw: Floats, period: int) -> bool:
    """Whether the last row of slices (k, h, w) goes on in the first as neighbours do.

    The step across must be a neighbour's, far from that between strangers; where the sample
    repeats, the neighbours are those a number of periods away.
    """
    size = raw.shape[1]
    repeats = round(size / period) if period else 1
    if period and abs(repeats * period - size) > 0.1 * period:
        return False
    apart = _steps(raw, 1)
    expected = apart
    if repeats > 1:
        at = np.rint(np.arange(1, repeats) * size / repeats).astype(int) - 1
        expected = apart[at]
    across = float(_mean_step(raw[:, -1], raw[:, 0]))
    far = np.unique(np.linspace(size / 4, 3 * size / 4, 8).astype(int))
    stranger = float(np.mean([_steps(raw, int(apart)).mean() for apart in far]))
    neighbour = float(expected.mean())
    spread = float(apart.std()) if repeats == 1 else float(expected.std())
    allowed = max(0.2 * (stranger - neighbour), 0.1 * neighbour, 0.5 * spread)
    return across <= neighbour + allowed + 1e-12


def _steps(raw: Floats, apart: int) -> Floats:
    """(h - apart,) mean |step| between rows of slices."""
    return np.array([_mean_step(raw[:, i], raw[:, i + apart]) for i in range(raw.shape[1] - apart)])


def _mean_step(a: Floats, b: Floats) -> float:
    step = np.abs(a - b)
    good = np.isfinite(step)
    return float(step[good].mean()) if good.any() else 0.0
