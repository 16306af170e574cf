"""The textures of a tile, made when they are asked for."""

from __future__ import annotations

from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import BTF
from btfkit.synthesis.drift import Drift
from btfkit.synthesis.indexmap import IndexMap
from btfkit.textures import Array, Index, Textures, as_textures


def without_drift(
    image: Array, index: IndexMap, drift: Drift, strengths: NDArray[np.floating]
) -> Array:
    """(p, q, c) the tile of an image (h, w, c) without the drift of `strengths`."""
    row, col = drift.origin
    return index.of(image) * drift.gain(strengths)[index.rows - row, index.cols - col]


@final
class Strengths:
    """The drift of every pair of a BTF, measured when a pair is first asked for."""

    def __init__(self, btf: BTF, drift: Drift) -> None:
        self._btf, self._drift = btf, drift
        self._found: dict[int, NDArray[np.float32]] = {}

    def of(self, pair: int, image: Array | None = None) -> NDArray[np.float32]:
        """(2, k, c) of one pair; `image` where it is at hand, so that it isn't read again."""
        if pair not in self._found:
            seen = self._btf.texture(pair) if image is None else image
            self._found[pair] = self._drift.strengths(seen).astype(np.float32)
        return self._found[pair]


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
