"""The leading singular vectors of a BTF that is only streamed.

The matrix has a row for every pair and channel and a column for every texel. Block power
iteration finds its leading right singular vectors; each iteration reads every texture once, and
memory is that of the result and of one block of textures. Values that are not measured take
those of the factorisation as it stands, pass by pass.

Source: Halko, Martinsson and Tropp, "Finding structure with randomness", 2011; filling in
missing values: Troyanskaya et al., "Missing value estimation methods for DNA microarrays", 2001.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit import native
from btfkit.btf import BTF
from btfkit.errors import FitError
from btfkit.materials.measured.pca import Domain, encoded

Floats = NDArray[np.float32]
_BLOCK_BYTES = 1 << 26
_OVERSAMPLING = 8
# Inner rounds that fit a block's coefficients to what is measured of it.
_FILLS = 3


@final
class EncodedRows:
    """The values of a BTF in the factorised domain, block of pairs by block.

    Args:
        btf: what is read, again and again unless it fits in `memory` bytes.
        domain, floor: as in `PCASpec`.
        passes: that are expected, the first included.
        progress: called with (pairs gone through in all passes, pairs to go through).

    Attributes:
        measured: (n,) pairs of which something is measured.
    """

    def __init__(
        self,
        btf: BTF,
        domain: Domain,
        floor: float,
        *,
        memory: int,
        passes: int = 1,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        self._btf, self._domain, self._floor = btf, domain, floor
        self._progress, self._done, self._total = progress, 0, passes * len(btf)
        self.shape = btf.shape
        one = 4 * math.prod(btf.shape[1:])
        self._count = max(1, _BLOCK_BYTES // one)
        self._kept: list[Floats] | None = [] if one * len(btf) <= memory else None
        self.measured = np.zeros(len(btf), bool)
        for block, values in self:
            self.measured[block] = np.isfinite(values).any(axis=(1, 2))
            if self._kept is not None:
                self._kept.append(values)
        if not self.measured.any():
            raise FitError("no texel of any texture is measured (all are NaN)")

    def __iter__(self) -> Iterator[tuple[slice, Floats]]:
        """(pairs, values (pairs, c, h w)), NaN where not measured."""
        for index, start in enumerate(range(0, len(self._btf), self._count)):
            block = slice(start, min(start + self._count, len(self._btf)))
            if self._kept is not None and index < len(self._kept):
                yield block, self._kept[index]
            else:
                with ThreadPoolExecutor(native.threads()) as workers:
                    images = list(workers.map(self._read, range(block.start, block.stop)))
                yield block, np.stack(images)
            self._done += block.stop - block.start
            if self._progress:
                # An error asked for may take more passes than were foreseen.
                self._progress(min(self._done, self._total), self._total)

    def _read(self, pair: int) -> Floats:
        image = self._btf.texture(pair)
        value = encoded(np.where(np.isfinite(image), image, np.nan), self._domain, self._floor)
        return np.ascontiguousarray(value.reshape(-1, value.shape[-1]).T, np.float32)


@final
@dataclass(frozen=True, eq=False)
class LowRank:
    """left @ right.T, the best approximation of its rank.

    Attributes:
        left: (rows, k), singular values included. right: (texels, k), orthonormal.
        singular: (k,) descending. energy, count: sum of squares and number of all values.
    """

    left: Floats
    right: Floats
    singular: NDArray[np.float64]
    energy: float
    count: int

    def error(self, rank: int) -> float:
        """Root mean square of what the first `rank` components leave."""
        rest = self.energy - float(np.square(self.singular[:rank]).sum())
        return math.sqrt(max(rest, 0.0) / self.count)

    def rank_for(self, error: float) -> int:
        """The fewest components that leave no more than `error`; all where none do."""
        good = [k for k in range(1, len(self.singular) + 1) if self.error(k) <= error]
        return good[0] if good else len(self.singular)


def factorised(
    rows: EncodedRows,
    channels: tuple[int, ...],
    rank: int,
    *,
    passes: int,
    start: Floats | None = None,
) -> LowRank:
    """The leading components of some channels of a BTF.

    Args:
        rows: what is factorised. channels: whose rows take part.
        rank: components. passes: over the data.
        start: (texels, k) orthonormal columns to begin with.
    """
    n, h, w, _ = rows.shape
    k = min(rank + _OVERSAMPLING, n * len(channels), h * w)
    rng = np.random.default_rng(0)
    basis = rng.standard_normal((h * w, k)).astype(np.float32)
    if start is not None:
        basis[:, : start.shape[1]] = start[:, :k]
    basis = np.linalg.qr(basis)[0]
    for done in range(passes - 1):
        image = np.zeros((h * w, k), np.float64)
        for _, block in _matrix(rows, channels):
            values = _filled(block, basis if done or start is not None else None)
            image += values.T @ (values @ basis)
        basis = np.linalg.qr(image)[0].astype(np.float32)
    left = np.empty((n * len(channels), k), np.float32)
    energy = 0.0
    for place, block in _matrix(rows, channels):
        values = _filled(block, basis if passes > 1 else None)
        left[place] = values @ basis
        energy += float(np.square(values, dtype=np.float64).sum())
    u, singular, v = np.linalg.svd(left.astype(np.float64), full_matrices=False)
    return LowRank(
        (u * singular)[:, :rank].astype(np.float32),
        (basis @ v.T)[:, :rank].astype(np.float32),
        singular[:rank],
        energy,
        n * len(channels) * h * w,
    )


def _matrix(rows: EncodedRows, channels: tuple[int, ...]) -> Iterator[tuple[slice, Floats]]:
    """Rows of the matrix and their place in it, block by block."""
    c = len(channels)
    for pairs, values in rows:
        part = values if c == values.shape[1] else values[:, channels]
        yield slice(pairs.start * c, pairs.stop * c), part.reshape(-1, part.shape[-1])


def _filled(block: Floats, basis: Floats | None) -> Floats:
    """A block whose missing values are its row's mean or, with a basis, what that predicts."""
    missing = ~np.isfinite(block)
    if not missing.any():
        return block
    number = np.maximum((~missing).sum(axis=1, keepdims=True), 1)
    mean = np.where(missing, 0, block).sum(axis=1, keepdims=True) / number
    filled = np.where(missing, mean, block).astype(np.float32)
    if basis is not None:
        for _ in range(_FILLS):
            filled = np.where(missing, (filled @ basis) @ basis.T, block)
    return filled
