"""PCA, fitted: as many components as are asked for, or as bytes or an error allow."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import BTF
from btfkit.errors import FitError
from btfkit.fitting.factorisation import EncodedRows, LowRank, factorised
from btfkit.fitting.interpolation import images_of
from btfkit.materials.base import Header
from btfkit.materials.measured.blend import pair_arrays
from btfkit.materials.measured.pca import PCA, Domain, PCASpec
from btfkit.queries import QuerySet
from btfkit.settings import parsed
from btfkit.textures import HALF_RANGE


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
    rows = EncodedRows(
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


def _ranks(s: Settings, parts: list[LowRank], wanted: list[int], budget: float) -> list[int]:
    if s.error:
        return [part.rank_for(s.error) for part in parts]
    if not s.bytes:
        return wanted
    ranks = [1] * len(parts)
    each = [2 * sum(side.shape[0] for side in (f.left, f.right)) for f in parts]
    left = budget - sum(each)
    # The component that explains most comes next, as long as there is room.
    rest = sorted(
        ((value, k) for k, f in enumerate(parts) for value in f.singular[1 : wanted[k]]),
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
    parts: list[LowRank],
    ranks: list[int],
) -> PCA:
    n, h, w, c = btf.shape
    arrays: dict[str, Any] = {name: a[measured] for name, a in pair_arrays(btf).items()}
    for k, (factors, rank) in enumerate(zip(parts, ranks, strict=True)):
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
    return PCA(spec, arrays, Header.of(btf))
