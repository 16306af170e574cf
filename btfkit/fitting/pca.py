"""PCA, fitted: a truncated singular value decomposition of a BTF that is only streamed.

The matrix has a row for every pair and channel and a column for every texel. Block power
iteration finds its leading right singular vectors; each iteration reads every texture once, and
memory is that of the result and of one block of textures. Values that are not measured take
those of the factorisation as it stands, pass by pass.

Source: Halko, Martinsson and Tropp, "Finding structure with randomness", 2011; filling in
missing values: Troyanskaya et al., "Missing value estimation methods for DNA microarrays", 2001.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit import native
from btfkit.btf import BTF
from btfkit.errors import FitError
from btfkit.fitting.interpolation import HALF_RANGE, images_of
from btfkit.fitting.settings import parsed
from btfkit.materials.blend import pair_arrays
from btfkit.materials.interpolation import header_of
from btfkit.materials.pca import PCA, Domain, PCASpec, encoded
from btfkit.queries import QuerySet

Floats = NDArray[np.float32]
_BLOCK_BYTES = 1 << 26
_OVERSAMPLING = 8
# Inner rounds that fit a block's coefficients to what is measured of it.
_FILLS = 3


@final
@dataclass(frozen=True)
class Settings:
    """What `--set key=value` reaches. At most one of the first three decides the size.

    Attributes:
        rank: components; 24 where nothing else is said.
        bytes: of all arrays of the model together.
        error: largest root mean square of what is left, in the factorised domain.
        layout: "joint", one factorisation for all channels, or "channels", one for each.
        domain: "log" or "linear". floor: of the logarithm, where values become linear.
        passes: over the data, the last included; more are more exact, and needed for many NaN.
        memory_mb: textures up to that size stay in memory, more are read in every pass.
    """

    rank: int = 0
    bytes: float = 0.0
    error: float = 0.0
    layout: str = "joint"
    domain: str = "log"
    floor: float = 1.0
    passes: int = 4
    memory_mb: int = 1024

    def __post_init__(self) -> None:
        chosen = [name for name in ("rank", "bytes", "error") if getattr(self, name) != 0]
        if len(chosen) > 1:
            raise ValueError(f"{' and '.join(chosen)} are set; expected one of them")
        if any(getattr(self, name) < 0 for name in chosen):
            raise ValueError(f"{chosen[0]} = {getattr(self, chosen[0])}; expected more than 0")
        if self.layout not in ("joint", "channels"):
            raise ValueError(f"layout = {self.layout!r}; expected joint or channels")
        if self.domain not in ("log", "linear"):
            raise ValueError(f"domain = {self.domain!r}; expected log or linear")
        if not self.floor > 0 or self.passes < 1 or self.memory_mb < 0:
            raise ValueError("floor, passes and memory_mb must be positive")


def pca(
    source: BTF | QuerySet,
    *,
    settings: Mapping[str, str],
    progress: Callable[[int, int], None] | None = None,
) -> PCA:
    """A BTF factorised to a given rank, size or error.

    Raises:
        FitError: queries instead of images, nothing measured, fewer bytes than one component.
    """
    s = parsed(Settings, "pca", settings)
    btf = images_of(source, "pca")
    n, h, w, c = btf.shape
    groups: list[tuple[int, ...]] = [tuple(range(c))]
    if s.layout == "channels":
        groups = [(k,) for k in range(c)]
    rows = Rows(
        btf,
        "log" if s.domain == "log" else "linear",
        s.floor,
        memory=s.memory_mb << 20,
        passes=1 + s.passes * len(groups),
        progress=progress,
    )
    most = [min(n * len(group), h * w) for group in groups]
    wanted, budget = _asked(s, btf, groups, most)
    found = []
    for group, k, limit in zip(groups, wanted, most, strict=True):
        factors = factorised(rows, group, k, passes=s.passes)
        while s.error and factors.error(k) > s.error and k < limit:
            k = min(2 * k, limit)
            factors = factorised(rows, group, k, passes=s.passes, start=factors.right)
        found.append(factors)
    ranks = _ranks(s, found, wanted, budget)
    return _packed(btf, s, rows.measured, found, ranks)


def _asked(
    s: Settings, btf: BTF, groups: list[tuple[int, ...]], most: list[int]
) -> tuple[list[int], float]:
    """Components to look for in each group, and bytes that they may take together."""
    if s.error:
        return [min(16, limit) for limit in most], math.inf
    if not s.bytes:
        return [min(s.rank or 24, limit) for limit in most], math.inf
    n, h, w, _ = btf.shape
    left = s.bytes - sum(array.nbytes for array in pair_arrays(btf).values())
    each = [2 * (n * len(group) + h * w) for group in groups]
    if left < sum(each):
        least = math.ceil(s.bytes - left + sum(each))
        raise FitError(
            f"bytes = {s.bytes:.0f} holds no component: one and the directions take {least}",
            remedy=f"set bytes={least} or more, or crop the BTF",
        )
    # A channel may take more than its share where another one is simpler.
    share = [int(left // sum(each)) if len(groups) == 1 else int(2 * left // sum(each))]
    return [min(max(share[0], 1), limit) for limit in most], left


def _ranks(s: Settings, found: list[Factors], wanted: list[int], budget: float) -> list[int]:
    if s.error:
        return [factors.rank_for(s.error) for factors in found]
    if not s.bytes:
        return wanted
    ranks = [1] * len(found)
    each = [2 * sum(side.shape[0] for side in (f.left, f.right)) for f in found]
    left = budget - sum(each)
    # The component that explains most comes next, as long as there is room.
    rest = sorted(
        ((value, k) for k, f in enumerate(found) for value in f.singular[1 : wanted[k]]),
        reverse=True,
    )
    for _, k in rest:
        if each[k] > left:
            break
        ranks[k] += 1
        left -= each[k]
    return ranks


def _packed(
    btf: BTF,
    s: Settings,
    measured: NDArray[np.bool_],
    found: list[Factors],
    ranks: list[int],
) -> PCA:
    n, h, w, c = btf.shape
    arrays: dict[str, Any] = {name: a[measured] for name, a in pair_arrays(btf).items()}
    for k, (factors, rank) in enumerate(zip(found, ranks, strict=True)):
        # Each texture of coefficients reaches 1: half precision suits it, and its table.
        scale = np.maximum(np.abs(factors.right[:, :rank]).max(axis=0), 1e-20)
        table = (factors.left[:, :rank] * scale).reshape(n, -1, rank)[measured]
        arrays[f"texture.{k}"] = (factors.right[:, :rank] / scale).reshape(h, w, rank).astype("f2")
        half = np.abs(table).max() < HALF_RANGE
        arrays[f"table.{k}"] = table.astype(np.float16 if half else np.float32)
    positions = tuple(name for name in arrays if name.endswith("_position"))
    domain: Domain = "log" if s.domain == "log" else "linear"
    spec = PCASpec(
        int(measured.sum()), (h, w), c, tuple(ranks), domain, s.floor, positions
    )  # fmt: skip
    return PCA(spec, arrays, header_of(btf))


@final
class Rows:
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
class Factors:
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
    rows: Rows,
    channels: tuple[int, ...],
    rank: int,
    *,
    passes: int,
    start: Floats | None = None,
) -> Factors:
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
    return Factors(
        (u * singular)[:, :rank].astype(np.float32),
        (basis @ v.T)[:, :rank].astype(np.float32),
        singular[:rank],
        energy,
        n * len(channels) * h * w,
    )


def _matrix(rows: Rows, channels: tuple[int, ...]) -> Iterator[tuple[slice, Floats]]:
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
