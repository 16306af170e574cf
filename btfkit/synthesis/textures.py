"""The textures of a tile, made when they are asked for."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import BTF
from btfkit.synthesis.drift import Drift
from btfkit.synthesis.indexmap import IndexMap
from btfkit.textures import Array, Index, Textures, as_textures

# Share of the range up to which a gain acts in full.
_KNEE = 0.8


def without_drift(
    image: Array, index: IndexMap, drift: Drift, strengths: NDArray[np.floating]
) -> Array:
    """(p, q, c) the tile of an image (h, w, c) without the drift of `strengths`."""
    return index.of(image) * gain_of(index, drift, strengths)


def gain_of(index: IndexMap, drift: Drift, strengths: NDArray[np.floating]) -> Array:
    """(p, q, c) the factor that takes the drift of a tile away."""
    row, col = drift.origin
    return drift.gain(strengths)[index.rows - row, index.cols - col]


def within(values: Array, gain: Array, peak: float) -> Array:
    """values x gain where both ends of a range 0..peak stay where they are.

    What is white because the range ends there says nothing of the light: it stays white. From
    the knee on, values run straight to the end, so that what was brighter stays brighter.
    """
    knee = np.minimum(_KNEE * peak, 0.9 * peak / np.maximum(gain, 1e-6))
    reached = gain * knee
    share = (values - knee) / (peak - knee)
    return np.where(
        values <= knee, values * gain, np.minimum(reached + (peak - reached) * share, peak)
    ).astype(np.float32)


@final
class Strengths:
    """The drift of every pair of a BTF, measured when a pair is first asked for.

    Args:
        btf: what is tiled. drift: its fields.
        kept: whether the drift stays: then all strengths are 0.
    """

    def __init__(self, btf: BTF, drift: Drift, *, kept: bool = False) -> None:
        self._btf, self._drift, self._kept = btf, drift, kept
        self._found: dict[int, NDArray[np.float32]] = {}

    def of(self, pair: int, image: Array | None = None) -> NDArray[np.float32]:
        """(2, k, c) of one pair; `image` where it is at hand, so that it isn't read again."""
        if pair not in self._found:
            seen = self._btf.texture(pair) if image is None else image
            strengths = self._drift.strengths(seen).astype(np.float32)
            self._found[pair] = 0 * strengths if self._kept else strengths
        return self._found[pair]

    def largest(self, index: IndexMap, pairs: Iterable[int]) -> float:
        """The largest relative change that taking the drift of some pairs away makes."""
        gains = (gain_of(index, self._drift, self.of(pair)) for pair in pairs)
        return max((float(np.abs(gain - 1).max()) for gain in gains), default=0.0)


@final
class TiledTextures(Textures):
    """Images of a tile: texels of a sample by one map, each image without its own drift.

    Args:
        inner: (n, h, w, c) images of the sample: its textures or their variance.
        index: where each texel comes from.
        drift, strengths: the fields, and how strong they are in each pair.
        power: of the gain: 1 for values, 2 for variances.
    """

    def __init__(
        self, inner: Any, index: IndexMap, drift: Drift, strengths: Strengths, *, power: int = 1
    ) -> None:
        self._inner: Textures = as_textures(inner)
        self._index, self._drift, self._strengths, self._power = index, drift, strengths, power
        n, _, _, c = self._inner.shape
        self.shape = (n, *index.size, c)

    def _read(self, index: int) -> Array:
        strengths = self._power * self._strengths.of(index)
        return without_drift(self._inner[index], self._index, self._drift, strengths)

    def texels(self, pairs: Index, rows: Index, cols: Index) -> Array:
        row, col = self._index.rows[rows, cols], self._index.cols[rows, cols]
        distinct, which = np.unique(pairs, return_inverse=True)
        strengths = np.stack([self._power * self._strengths.of(int(pair)) for pair in distinct])
        gain = self._drift.gain_at(strengths[which], row, col)
        return self._inner.texels(pairs, row, col) * gain
