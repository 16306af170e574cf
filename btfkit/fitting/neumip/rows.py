"""What NeuMIP is trained on where it is no textures: rows of query files."""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import BTF
from btfkit.errors import FitError
from btfkit.fitting.neumip.data import (
    HELD_PAIRS,
    HELD_TEXELS,
    Batch,
    Progress,
    Source,
    TexelSource,
)
from btfkit.native.neural.layout import Array
from btfkit.queries import QuerySet

# Rows that are put in order at a time: a short fit never comes to most of them.
_AT_A_TIME = 1 << 16


@final
class RowSource(Source):
    """Rows of a query file with their own footprints, in one shuffled order.

    Args:
        curved: whether curvature and opacity count: what is not seen, having an opacity below
            1/2, is no measurement.
    """

    def __init__(
        self,
        queries: QuerySet,
        train: NDArray[np.intp],
        test: NDArray[np.intp],
        *,
        seed: int,
        curved: bool = False,
    ) -> None:
        if queries.rgb is None:
            raise FitError("these queries have no answers (no rgb): there is nothing to fit")
        usable = queries.valid()
        train = train[usable[train]]
        self.masked = int(len(queries) - usable.sum())
        if not len(train):
            raise FitError(f"none of {len(queries)} queries is finite and seen from above")
        rng = np.random.default_rng([seed, 11])
        self._rows = _Ordered(queries, rng.permutation(train), curved=curved)
        held = test[usable[test]]
        few = rng.permutation(held)[: HELD_PAIRS * HELD_TEXELS]
        self._held = _Ordered(queries, few, curved=curved).until(len(few))
        self._seed = seed

    def batch(self, step: int, count: int) -> Batch:
        have = len(self._rows)
        if count >= have:
            return self._rows.until(have)
        # Every epoch begins elsewhere, so that the same rows do not always meet.
        a_epoch = have // count
        epoch, turn = divmod(step, a_epoch)
        rest = have - a_epoch * count
        first = int(np.random.default_rng([self._seed, epoch]).integers(rest + 1)) + turn * count
        return _cut(self._rows.until(first + count), slice(first, first + count))

    def held_out(self) -> Batch:
        return self._held


@final
class _Ordered:
    """Rows of a query file in the order of `rows`, so that a batch is a run of them.

    Args:
        curved: whether curvature and opacity count.
    """

    def __init__(self, queries: QuerySet, rows: NDArray[np.intp], *, curved: bool) -> None:
        assert queries.rgb is not None
        self._queries, self._order, self._done = queries, rows, 0
        bent = curved and queries.curvature is not None and bool(queries.curvature.any())
        self._opacity = queries.opacity if curved else None

        def room(of: Array | None) -> Array | None:
            return None if of is None else np.empty((len(rows), *of.shape[1:]), np.float32)

        self._all = Batch(
            np.empty((len(rows), 2), np.float32), np.empty((len(rows), 3), np.float32),
            np.empty((len(rows), 3), np.float32), room(queries.footprint),
            np.empty((len(rows), queries.rgb.shape[1]), np.float32), room(queries.weight),
            room(queries.curvature) if bent else None, rows,
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self._order)

    def until(self, stop: int) -> Batch:
        """All of them, of which those before `stop` are in place."""
        while self._done < min(stop, len(self)):
            at = slice(self._done, self._done + _AT_A_TIME)
            self._put(self._order[at], at)
            self._done = at.stop
        return self._all

    def _put(self, rows: NDArray[np.intp], at: slice) -> None:
        queries, to = self._queries, self._all
        assert queries.rgb is not None
        to.uv[at] = _taken(queries.uv, rows)
        to.light[at] = _unit(_taken(queries.light, rows))
        to.view[at] = _unit(_taken(queries.view, rows))
        target = _taken(queries.rgb, rows)
        if self._opacity is not None:
            target = np.where(self._opacity[rows, None] < 0.5, np.float32(np.nan), target)
        to.target[at] = target
        for column, source in ((to.footprint, queries.footprint), (to.weight, queries.weight),
                               (to.curvature, queries.curvature)):  # fmt: skip
            if column is not None and source is not None:
                column[at] = source[rows]


def _taken(table: Array, rows: NDArray[np.intp]) -> Array:
    """table[rows] of a contiguous (n, k): numpy moves whole rows four times as fast as numbers."""
    n, k = table.shape
    found: Array = table.view(f"V{4 * k}").reshape(n).take(rows).view(np.float32).reshape(-1, k)
    return found


def _unit(rows: Array) -> NDArray[np.float64]:
    """Valid rows (n, 3) at length one; float64, in which no square of a float32 overflows."""
    wide = rows.astype(np.float64)
    found: NDArray[np.float64] = wide / np.sqrt(np.einsum("ij,ij->i", wide, wide))[:, None]
    return found


def _cut(rows: Batch, at: slice) -> Batch:
    footprint = None if rows.footprint is None else rows.footprint[at]
    weight = None if rows.weight is None else rows.weight[at]
    bend = None if rows.curvature is None else rows.curvature[at]
    place = None if rows.rows is None else rows.rows[at]
    view, target = rows.view[at], rows.target[at]
    return Batch(rows.uv[at], rows.light[at], view, footprint, target, weight, bend, place)


def source_of(
    data: BTF | QuerySet,
    train: NDArray[np.intp],
    test: NDArray[np.intp],
    *,
    levels: int,
    curved: bool,
    seed: int,
    pool_bytes: int,
    progress: Progress | None = None,
) -> Source:
    """Where batches of a BTF or of queries come from.

    Args:
        levels: of a BTF's textures that are drawn from. curved: whether a query's curvature counts.
    """
    if isinstance(data, BTF):
        return TexelSource(
            data, train, test, levels=levels, seed=seed, pool_bytes=pool_bytes, progress=progress
        )
    return RowSource(data, train, test, seed=seed, curved=curved)
