"""Which measured pairs answer for a light and a view, and with what weights."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from btfkit import directions, nearfield
from btfkit.btf import BTF
from btfkit.directions import Floats
from btfkit.materials.measured.near import Near
from btfkit.materials.measured.triangulation import DirectionMesh, parabolic

Array = NDArray[np.float32]
Index = NDArray[np.intp]
# With fewer partners than this on a side, a list of pairs is not a grid but scattered.
_FEWEST_PARTNERS = 6
_SCATTERED_NEIGHBOURS = 8


class Nest(NamedTuple):
    """Directions of one kind, each with the same ones of the other.

    Attributes:
        light_first: whether the outer ones are lights.
        outer, inner: their triangulations. pairs: (outer, inner) index of each pair.
    """

    light_first: bool
    outer: DirectionMesh
    inner: DirectionMesh
    pairs: Index


@final
class Blend:
    """The pairs of a BTF that answer for a light and a view.

    Lists in which views have lights in common are blended over triangles of views, and for each
    of these over triangles of its own lights (or the other way round); lists without such
    structure over their nearest pairs. Pairs lit from below the horizon are left out; of equal
    pairs the first counts.

    Args:
        light, view: (n, 3) unit vectors.
        lamps, eyes: where light and view come from, when that is near.

    Attributes:
        light: as given.

    Raises:
        ValueError: no pair is lit from above the horizon.
    """

    def __init__(
        self, light: Array, view: Array, *, lamps: Near | None = None, eyes: Near | None = None
    ) -> None:
        self.light, self._lamps, self._eyes = light, lamps, eyes
        pairs = np.flatnonzero((light[:, 2] >= 0) & (view[:, 2] >= 0))
        if not pairs.size:
            raise ValueError(f"none of {len(light)} pairs is lit and seen from above the horizon")
        lights, which_light = directions.unique(light[pairs])
        views, which_view = directions.unique(view[pairs])
        self._light_first = False
        self._tree: cKDTree | None = None
        if _partners(which_view, which_light) >= _FEWEST_PARTNERS or len(views) == 1:
            self._nest(pairs, views, which_view, lights, which_light)
        elif _partners(which_light, which_view) >= _FEWEST_PARTNERS or len(lights) == 1:
            self._light_first = True
            self._nest(pairs, lights, which_light, views, which_view)
        elif len(pairs) >= len(lights) * len(views):
            self._nest(pairs, views, which_view, lights, which_light)
        else:
            self._pairs = pairs
            self._tree = cKDTree(_joined(light[pairs], view[pairs]))

    @staticmethod
    def of(arrays: Mapping[str, NDArray[Any]]) -> Blend:
        """From light and view (n, 3), and light_position and view_position where known."""
        lamps, eyes = (Near.of(arrays.get(f"{name}_position")) for name in ("light", "view"))
        light, view = (
            np.asarray(arrays[name], np.float32)
            if f"{name}_position" not in arrays
            else directions.normalize(arrays[f"{name}_position"]).astype(np.float32)
            for name in ("light", "view")
        )
        return Blend(light, view, lamps=lamps, eyes=eyes)

    @property
    def near(self) -> bool:
        """Whether weights depend on the place on the sample."""
        return self._lamps is not None or self._eyes is not None

    def nest(self) -> Nest:
        """The pairs as one table.

        Raises:
            TypeError: they are none: views have lights of their own, or lamps or eyes are near.
        """
        if self.near or self._tree is not None or len(self._meshes) != 1:
            what = "near lights or views" if self.near else "views with lights of their own"
            raise TypeError(f"this BTF has {what}; expected every view under every light")
        mesh, lists = self._meshes[0]
        home = self._home[:, 1]
        return Nest(self._light_first, self._outer, mesh, lists[home])

    def _nest(
        self, pairs: Index, outer: Array, which: Index, inner: Array, which_inner: Index
    ) -> None:
        self._outer = DirectionMesh(outer)
        self._meshes: list[tuple[DirectionMesh, Index]] = []
        self._home = np.empty((len(outer), 2), np.intp)
        groups: dict[bytes, tuple[Index, list[Index]]] = {}
        for row in range(len(outer)):
            members = np.flatnonzero(which == row)
            partners, first = np.unique(which_inner[members], return_index=True)
            group = groups.setdefault(partners.tobytes(), (partners, []))
            self._home[row] = list(groups).index(partners.tobytes()), len(group[1])
            group[1].append(pairs[members[first]])
        for partners, lists in groups.values():
            self._meshes.append((DirectionMesh(inner[partners]), np.stack(lists)))

    def weights(
        self, light: Array, view: Array, at: NDArray[np.floating] | None = None
    ) -> tuple[Index, Array]:
        """Pairs and their weights for queries.

        Args:
            light, view: (b, 3) unit vectors above the horizon.
            at: (b, 2) x and y on the sample in mm from its centre; needed where lamps or eyes
                are near.

        Returns:
            (b, k) indices of pairs, (b, k) weights, not negative and of sum 1.
        """
        if self._lamps is not None and at is not None:
            light = self._lamps.from_centre(light, at)
        if self._eyes is not None and at is not None:
            view = self._eyes.from_centre(view, at)
        once = len(light) > 1 and bool((light == light[0]).all() and (view == view[0]).all())
        if once:
            pair, weight = self._weights(light[:1], view[:1])
            shape = (len(light), pair.shape[1])
            return np.broadcast_to(pair, shape), np.broadcast_to(weight, shape)
        return self._weights(light, view)

    def cosines(self, pair: Index, at: NDArray[np.floating] | None = None) -> Array:
        """(b, k) cosines of the lights of pairs (b, k), as they fall on the places `at` (b, 2)."""
        if self._lamps is None or at is None:
            return self.light[pair, 2]
        lamp = self._lamps.position[pair]
        square = nearfield.squared_distances(lamp, at[:, None, 0], at[:, None, 1])
        return nearfield.cosines(lamp, square)

    def _weights(self, light: Floats | Array, view: Floats | Array) -> tuple[Index, Array]:
        if self._tree is not None:
            return self._scattered(light, view)
        outside, inside = (light, view) if self._light_first else (view, light)
        outer, outer_weight = self._outer.weights(outside)
        b = len(outer)
        pair = np.zeros((b, 3, 3), np.intp)
        weight = np.zeros((b, 3, 3))
        home = self._home[outer]
        for group, (mesh, pairs) in enumerate(self._meshes):
            use = home[..., 0] == group
            rows = np.flatnonzero(use.any(axis=1))
            if not rows.size:
                continue
            inner, inner_weight = mesh.weights(inside[rows])
            local, corner = np.nonzero(use[rows])
            pair[rows[local], corner] = pairs[home[rows[local], corner, 1][:, None], inner[local]]
            weight[rows[local], corner] = inner_weight[local]
        weight *= outer_weight[..., None]
        return pair.reshape(b, 9), weight.reshape(b, 9).astype(np.float32)

    def _scattered(self, light: Floats | Array, view: Floats | Array) -> tuple[Index, Array]:
        """Weights ((r - d) / (r d))^2 of the nearest pairs; r is where the next one lies.

        Source: Franke and Nielson, "Smooth interpolation of large sets of scattered data", 1980.
        """
        k = min(_SCATTERED_NEIGHBOURS, len(self._pairs))
        tree: Any = self._tree
        distance, near = tree.query(_joined(light, view), k=range(1, k + 2))
        reach = distance[:, k:]
        distance, near = np.maximum(distance[:, :k], 1e-9), np.minimum(near[:, :k], tree.n - 1)
        # Where no pair is beyond, all of them answer.
        reach = np.where(np.isfinite(reach), reach, 2 * distance[:, -1:])
        weight = np.square(np.maximum(reach / distance - 1, 1e-9))
        weight /= weight.sum(axis=1, keepdims=True)
        weight[weight < 1e-6] = 0
        return self._pairs[near], weight.astype(np.float32)


def pair_arrays(btf: BTF) -> dict[str, NDArray[np.float32]]:
    """What `Blend.of` needs to know of a BTF's pairs, as arrays to store."""
    found = {
        name: getattr(btf, name) for name in ("light", "view", "light_position", "view_position")
    }
    return {n: np.asarray(a, np.float32) for n, a in found.items() if a is not None}


def _joined(light: NDArray[np.floating], view: NDArray[np.floating]) -> Floats:
    return np.concatenate([parabolic(light), parabolic(view)], axis=1)


def _partners(outer: Index, inner: Index) -> float:
    """Median number of distinct inner directions for each outer one."""
    both = np.unique(np.stack([outer, inner], axis=1), axis=0)
    return float(np.median(np.bincount(both[:, 0])))
