"""What a student learns from: queries that its teacher answers, new ones at every step."""

from __future__ import annotations

import warnings
from typing import NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import BTF
from btfkit.directions import from_angles
from btfkit.fitting.neumip.data import Batch, Source
from btfkit.materials.base import Material
from btfkit.native.neural.layout import Array
from btfkit.queries import QuerySet

# Rows of a source that is asked of the teacher alone: what its errors are told by.
ROWS = 1 << 16
_HELD = 1 << 14
# Lowest light and view that are asked for beyond those of the data.
_LOWEST = np.radians(80.0)


class Pairs(NamedTuple):
    """(n, 3) directions that were measured together, to learn between."""

    light: Array
    view: Array


@final
class Lessons(Source):
    """Random places and directions, answered by the teacher.

    Three quarters of the directions are those of the data where there are some, each moved by a
    few degrees, so that what lies between is learnt, too; the others are drawn over the hemisphere.
    """

    def __init__(
        self, teacher: Material, *, levels: int, seed: int, pairs: Pairs | None = None
    ) -> None:
        self._teacher, self._levels = teacher, levels
        self._seed, self._pairs = seed, pairs

    def batch(self, step: int, count: int) -> Batch:
        return self._asked(np.random.default_rng([self._seed, 1, step]), count)

    def held_out(self) -> Batch:
        return self._asked(np.random.default_rng([self._seed, 2]), _HELD)

    def _asked(self, rng: np.random.Generator, count: int) -> Batch:
        uv = rng.random((count, 2), np.float32)
        light, view = over_hemisphere(rng, count), over_hemisphere(rng, count)
        if self._pairs is not None:
            some = rng.integers(len(self._pairs.light), size=count * 3 // 4)
            for way, known in ((light, self._pairs.light), (view, self._pairs.view)):
                way[: len(some)] = moved(rng, known[some])
        footprint = None
        if self._levels > 1:
            blur = 0.5 * 2 ** (rng.random(count, np.float32) * (self._levels - 1))
            footprint = np.where(rng.random(count) < 0.5, np.float32(0.5), blur)
        return Batch(uv, light, view, footprint, asked(self._teacher, uv, light, view, footprint))


def asked(
    teacher: Material, uv: Array, light: Array, view: Array, footprint: Array | None
) -> Array:
    """Reflectance (b, c) of a teacher; NaN where nothing is seen."""
    with warnings.catch_warnings():
        # A teacher says once what it does not know; the student does not ask for it.
        warnings.simplefilter("ignore", UserWarning)
        found = teacher.evaluate(uv, light, view, 0.5 if footprint is None else footprint)
    rgb: Array = found.reflectance
    if (found.opacity < 0.5).any():
        rgb = np.where(found.opacity[:, None] < 0.5, np.float32(np.nan), rgb)
    return rgb


def queries_of(teacher: Material, *, seed: int) -> QuerySet:
    """Queries with a teacher's answers: the source of a fit that has no data."""
    rng = np.random.default_rng([seed, 3])
    uv = rng.random((ROWS, 2), np.float32)
    light, view = over_hemisphere(rng, ROWS), over_hemisphere(rng, ROWS)
    return QuerySet(
        uv, light, view, rgb=asked(teacher, uv, light, view, None),
        size=teacher.header.grid, channels=teacher.header.channels,
        provenance={"teacher": teacher.model, "of": dict(teacher.header.provenance)},
    )  # fmt: skip


def pairs_of(source: BTF | QuerySet, train: NDArray[np.intp]) -> Pairs | None:
    """Directions of the data; None of queries that are all over the hemisphere anyway."""
    if not isinstance(source, BTF):
        return None
    return Pairs(source.light[train].astype(np.float32), source.view[train].astype(np.float32))


def over_hemisphere(rng: np.random.Generator, count: int) -> Array:
    """(count, 3) directions, even in cos of the polar angle's square, no lower than 80 degrees."""
    theta = np.arcsin(np.sqrt(rng.random(count)) * np.sin(_LOWEST))
    return from_angles(theta, rng.uniform(0, 2 * np.pi, count)).astype(np.float32)


def moved(rng: np.random.Generator, directions: Array, spread: float = 0.05) -> Array:
    """Directions (b, 3) moved by about `spread` radians, above the horizon."""
    found = directions + rng.normal(0, spread, directions.shape).astype(np.float32)
    found[:, 2] = np.maximum(found[:, 2], 0.02)
    unit: Array = found / np.linalg.norm(found, axis=1, keepdims=True)
    return unit
