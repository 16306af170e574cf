"""Which lights and views were measured, and how much an answer elsewhere can be trusted.

A query is as far from a pair as its light from the pair's and its view from the pair's view, both
angles together. Each direction reaches as far as its neighbours lie, within bounds; the
confidence is 1 within that reach of a pair and falls to 0 at twice of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from btfkit import directions

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

Array = NDArray[np.float32]
Floats = NDArray[Any]

# How far a direction reaches, radians: what its sixth neighbour says, within these bounds. A
# single direction tells of those as near as a lobe or a shadow's edge is wide.
_LEAST, _MOST, _NEIGHBOURS = np.radians(8.0), np.radians(20.0), 6
# Pairs that a list keeps, drawn at random; in four dimensions twice as many would lie a fifth
# closer together. Directions that a grid keeps.
_MOST_PAIRS, _MOST_ON_A_GRID = 2048, 1024
# Pairs that are looked at, of more.
SAMPLE = 1 << 16
# A list of so large a share of all combinations of its directions counts as all of them.
_GRID = 0.5
# Pairs of directions at which the covered share is estimated, and the lowest z of them.
_LOOKS, _LOWEST_Z = 4096, 0.02
# Distances that are taken one by one, rather than looked up in a tree; and of these at a time.
_COMPARED, _COMPARED_AT_A_TIME = 1 << 24, 1 << 16
# Below this uncovered share nothing is said, and nothing is done.
DENSE = 0.1
# Directions flatter than this no rig measures, and no data are blamed for.
_STEEPEST_Z = float(np.cos(np.radians(75.0)))
# A view within 25 degrees of above is upright.
_UPRIGHT_Z = float(np.cos(np.radians(25.0)))


@final
@dataclass(frozen=True, eq=False)
class Coverage:
    """The directions of some pairs.

    Attributes:
        light, view: (a, 3) and (b, 3) distinct unit vectors.
        pairs: (n, 2) which light with which view; None for all combinations.
        count: of the pairs that this describes, before any were left out.
    """

    light: Array
    view: Array
    pairs: NDArray[np.intp] | None
    count: int

    def __post_init__(self) -> None:
        for name, table in (("light", self.light), ("view", self.view)):
            if table.ndim != 2 or table.shape[1:] != (3,) or not len(table):
                raise ValueError(f"coverage: {name} has shape {table.shape}; expected (n, 3)")
            if not np.allclose(np.linalg.norm(table, axis=1), 1, atol=0.01):
                raise ValueError(f"coverage: {name} holds vectors that are not of length 1")
            # As files hold them: what is written and read again answers the same.
            object.__setattr__(self, name, table.astype(np.float16).astype(np.float32))
        if self.pairs is not None:
            sizes = (len(self.light), len(self.view))
            if self.pairs.ndim != 2 or self.pairs.shape[1:] != (2,) or not len(self.pairs):
                raise ValueError(f"coverage: pairs have shape {self.pairs.shape}; expected (n, 2)")
            if (self.pairs < 0).any() or (self.pairs >= sizes).any():
                raise ValueError(f"coverage: pairs name directions beyond {sizes}")

    def __eq__(self, other: object) -> bool:
        """Whether all arrays are equal."""
        if not isinstance(other, Coverage):
            return NotImplemented
        mine, theirs = self.arrays(), other.arrays()
        return mine.keys() == theirs.keys() and all(
            np.array_equal(array, theirs[name]) for name, array in mine.items()
        )

    def __hash__(self) -> int:
        """By what is cheap to look at."""
        return hash((self.count, len(self.light), len(self.view)))

    @staticmethod
    def of(light: ArrayLike, view: ArrayLike, *, count: int | None = None) -> Coverage:
        """The coverage of pairs (n, 3) and (n, 3); views from below the horizon do not count.

        Args:
            light, view: of each pair. count: of how many pairs these are a sample, if they are.

        Raises:
            ValueError: no pair is seen from above the horizon.
        """
        lights, views = (np.asarray(d, np.float32).reshape(-1, 3) for d in (light, view))
        good = views[:, 2] > 0
        for table in (lights, views):
            finite = np.isfinite(table)
            # Looking at rows costs ten times what looking at everything does.
            if not finite.all():
                good &= finite.all(axis=1)
        if not good.all():
            lights, views = lights[good], views[good]
        if not len(lights):
            raise ValueError(f"coverage: none of {len(good)} pairs is seen from above the horizon")
        count = count or len(lights)
        if len(lights) > SAMPLE:
            # Rows of a query file: more of them tell no more.
            few = np.random.default_rng(0).choice(len(lights), SAMPLE, replace=False)
            lights, views = lights[few], views[few]
        unit = (directions.normalize(d).astype(np.float32) for d in (lights, views))
        (a, of_a), (b, of_b) = (directions.unique(d) for d in unit)
        pairs = np.unique(np.stack([of_a, of_b], axis=1), axis=0)
        small = max(len(a), len(b)) <= _MOST_ON_A_GRID
        if small and len(pairs) >= _GRID * len(a) * len(b):
            return Coverage(a, b, None, count)
        if len(pairs) > _MOST_PAIRS:
            pairs = pairs[np.random.default_rng(0).permutation(len(pairs))[:_MOST_PAIRS]]
        used_a, of_a = np.unique(pairs[:, 0], return_inverse=True)
        used_b, of_b = np.unique(pairs[:, 1], return_inverse=True)
        renamed = np.stack([of_a.reshape(-1), of_b.reshape(-1)], axis=1).astype(np.intp)
        return Coverage(a[used_a], b[used_b], renamed, count)

    @staticmethod
    def of_arrays(arrays: Mapping[str, NDArray[Any]]) -> Coverage:
        """What `arrays` gave.

        Raises:
            KeyError, ValueError: it is not of a coverage.
        """
        pairs = arrays.get("pairs")
        return Coverage(
            np.asarray(arrays["light"], np.float32), np.asarray(arrays["view"], np.float32),
            None if pairs is None else pairs.astype(np.intp), int(arrays["count"].reshape(-1)[0]),
        )  # fmt: skip

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All of it by name, as files hold it: directions as float16, good to 0.05 degrees."""
        found: dict[str, NDArray[Any]] = {
            "light": self.light.astype(np.float16), "view": self.view.astype(np.float16),
            "count": np.array([self.count], np.int64),
        }  # fmt: skip
        return found if self.pairs is None else found | {"pairs": self.pairs.astype(np.int32)}

    def confidence(self, light: ArrayLike, view: ArrayLike) -> Array:
        """(...) 1 where pairs were measured, towards 0 where answers are guessed.

        Args:
            light, view: (..., 3) directions; shapes broadcast, lengths do not matter.

        Returns:
            0 for views from below the horizon and for directions that are not finite.
        """
        lights, views = (np.asarray(d, float) for d in (light, view))
        for name, d in (("light", lights), ("view", views)):
            if d.shape[-1:] != (3,):
                raise ValueError(f"{name} has shape {d.shape}; expected (..., 3)")
        shape = np.broadcast_shapes(lights.shape, views.shape)
        flat = [np.broadcast_to(d, shape).reshape(-1, 3) for d in (lights, views)]
        out = np.zeros(len(flat[0]), np.float32)
        long = [np.linalg.norm(d, axis=1) for d in flat]
        good = np.flatnonzero(
            np.isfinite(long[0]) & np.isfinite(long[1]) & (long[0] > 0) & (flat[1][:, 2] > 0)
        )
        if len(good):
            asked = [d[good] / n[good, None] for d, n in zip(flat, long, strict=True)]
            out[good] = _faded(self._distance(asked[0], asked[1]))
        return out.reshape(shape[:-1])

    def _distance(self, light: Floats, view: Floats) -> Floats:
        """(b,) from the nearest pair, in its reach."""
        if self.pairs is None:
            return np.hypot(self._lights.distance(light), self._views.distance(view))
        return self._joined.distance(np.concatenate([light, view], axis=1))

    @cached_property
    def _lights(self) -> _Spots:
        return _Spots(self.light)

    @cached_property
    def _views(self) -> _Spots:
        return _Spots(self.view)

    @cached_property
    def _joined(self) -> _Spots:
        assert self.pairs is not None
        light, view = self.light[self.pairs[:, 0]], self.view[self.pairs[:, 1]]
        return _Spots(np.concatenate([light, view], axis=1))

    def uncovered(self, *, flattest_z: float = _STEEPEST_Z) -> float:
        """Mean of 1 - confidence over pairs of directions spread evenly above `flattest_z`."""
        light, view = spread_pairs(_LOOKS, np.random.default_rng(0), flattest_z)
        return float(1 - self.confidence(light, view).mean())

    @cached_property
    def covered(self) -> float:
        """Mean confidence over what rigs can measure: directions within 75 degrees."""
        return 1 - self.uncovered()

    @property
    def dense(self) -> bool:
        """Whether pairs cover what rigs can measure: answers are interpolated, not guessed."""
        return self.covered > 1 - DENSE

    def said(self) -> str:
        """One line: what was measured, and what is therefore extrapolated; empty where dense."""
        if self.dense:
            return ""
        lights, views = len(self.light), len(self.view)
        beside = self.pairs is not None and bool(
            np.all(
                np.sum(self.light[self.pairs[:, 0]] * self.view[self.pairs[:, 1]], axis=1) > 0.99
            )
        )
        if views == 1 and lights == 1:
            return "1 pair: answers under other lights and at other views are extrapolated"
        if beside:
            return (
                f"{self.count} pairs, lit from the eye: answers under other lights are extrapolated"
            )
        if views == 1:
            other = "oblique answers" if self.view[0, 2] > _UPRIGHT_Z else "answers at other views"
            return f"1 view: {other} are extrapolated"
        if lights == 1:
            return "1 light: answers under other lights are extrapolated"
        share = 100 * self.covered
        return (
            f"{self.count} pairs, {lights} lights and {views} views: they cover {share:.0f} % of "
            f"the directions within 75 degrees; other answers are extrapolated"
        )

    def described(self) -> dict[str, Any]:
        """What it says, as JSON types."""
        return {
            "pairs": self.count, "lights": len(self.light), "views": len(self.view),
            "covered": round(self.covered, 4),
            "said": self.said() or "no direction is far from a pair",
        }  # fmt: skip


# What a file of before, or a model from elsewhere, has to say.
UNKNOWN = "not stated in this file: which answers are measured and which are guessed is not known"


def spread_pairs(
    count: int, rng: np.random.Generator, lowest_z: float = _LOWEST_Z
) -> tuple[Array, Array]:
    """(count, 3) lights and views, each even over the part of the hemisphere above `lowest_z`."""
    found = []
    for _ in range(2):
        z, phi = rng.uniform(lowest_z, 1, count), rng.uniform(0, 2 * np.pi, count)
        found.append(directions.from_angles(np.arccos(z), phi).astype(np.float32))
    return found[0], found[1]


class _Spots:
    """Points (n, 3 or 6) on one sphere or two, each with how far it reaches."""

    def __init__(self, points: Floats) -> None:
        self._points = points.astype(float)
        k = min(_NEIGHBOURS, len(points) - 1)
        reach = np.full(len(points), _LEAST)
        if k:
            far, _ = self._nearest(self._points, k + 1)
            reach = np.clip(far.max(axis=1), _LEAST, _MOST)
        self._reach, self._k = reach, min(4, len(points))

    def distance(self, at: Floats) -> Floats:
        """(b,) from the nearest point, in its reach; chords stand for angles."""
        far, which = self._nearest(at, self._k)
        nearest: Floats = (far / self._reach[which]).min(axis=1)
        return nearest

    def _nearest(self, at: Floats, k: int) -> tuple[Floats, NDArray[np.intp]]:
        """(b, k) how far the k nearest points are, in no order, and which they are."""
        if len(at) * len(self._points) <= _COMPARED:
            return compared(at, self._points, k)
        far, which = self._tree.query(at, k=list(range(1, k + 1)))
        return far, which

    @cached_property
    def _tree(self) -> cKDTree:
        # Here, because it takes a third of a second to load, and few questions do without.
        from scipy.spatial import cKDTree

        return cKDTree(self._points)


def compared(at: Floats, points: Floats, k: int) -> tuple[Floats, NDArray[np.intp]]:
    """(b, k) chords from `at` (b, m) to the k nearest of `points` (n, m), in no order, and which.

    All are looked at; what a tree answers, to 1e-7: squares are differences of unit lengths.
    """
    long = np.square(points).sum(axis=1)
    minus = -2 * points.T
    far, which = np.empty((len(at), k)), np.empty((len(at), k), np.intp)
    step = max(_COMPARED_AT_A_TIME // len(points), 1)
    for first in range(0, len(at), step):
        rows = slice(first, first + step)
        square = at[rows] @ minus
        square += long
        which[rows] = np.argpartition(square, k - 1, axis=1)[:, :k]
        near = np.take_along_axis(square, which[rows], axis=1)
        far[rows] = near + np.square(at[rows]).sum(axis=1, keepdims=True)
    return np.sqrt(np.maximum(far, 0)), which


def _faded(distance: Floats) -> Floats:
    x = np.clip(distance - 1, 0, 1)
    return 1 - x * x * (3 - 2 * x)
