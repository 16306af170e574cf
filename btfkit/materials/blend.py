"""Which measured pairs answer for a light and a view, and with what weights.

Directions are triangulated in parabolic coordinates (x, y) / (1 + z), where the hemisphere is the
unit disc; a ring just outside it, each of whose points stands for the nearest measured direction,
makes every query of the hemisphere fall into a triangle.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import Delaunay, cKDTree

from btfkit import directions
from btfkit.btf import BTF
from btfkit.directions import Floats

Array = NDArray[np.float32]
Index = NDArray[np.intp]
# With fewer partners than this on a side, a list of pairs is not a grid but scattered.
_FEWEST_PARTNERS = 6
_SCATTERED_NEIGHBOURS = 8
# The ring touches the disc at 1: this much further out rounding cannot leave it.
_RING_RADIUS = 1.02
# Solving for the equivalent direction converges by texel size / distance to the lamp each time.
_NEAR_STEPS = 6


def parabolic(direction: ArrayLike) -> Floats:
    """(..., 2) parabolic coordinates of (..., 3) unit vectors; the hemisphere is the unit disc."""
    d = np.asarray(direction, float)
    return d[..., :2] / (1 + d[..., 2:])


@final
class Mesh:
    """A Delaunay triangulation of directions of the upper hemisphere.

    Args:
        table: (m, 3) distinct unit vectors, z at least 0.
    """

    def __init__(self, table: NDArray[np.floating]) -> None:
        d = np.asarray(table, float)
        lowest = int(np.sum(d[:, 2] <= d[:, 2].min() + 1e-3))
        count = max(10, lowest)
        azimuth = 2 * np.pi * np.arange(count) / count
        horizon = directions.from_angles(np.full(count, np.pi / 2), azimuth)
        radius = _RING_RADIUS / np.cos(np.pi / count)
        self._stands_for = np.concatenate([np.arange(len(d)), np.argmax(horizon @ d.T, axis=1)])
        self.points = np.concatenate([parabolic(d), radius * horizon[:, :2]])
        self._half = float(np.abs(self.points).max()) * (1 + 1e-9)
        self._triangulate()

    def _triangulate(self) -> None:
        triangles = Delaunay(self.points).simplices
        a, b, c = (self.points[triangles[:, k]] for k in range(3))
        edge, other = a - c, b - c
        area = edge[:, 0] * other[:, 1] - edge[:, 1] * other[:, 0]
        # Slivers between points on one line have no inverse, and no inside.
        whole = np.abs(area) > 1e-14
        edge, other, area = edge[whole], other[whole], area[whole]
        self._triangles, self._origin = triangles[whole], c[whole]
        rows = np.stack([other[:, 1], -other[:, 0], -edge[:, 1], edge[:, 0]], axis=1)
        self._frame = (rows / area[:, None]).reshape(-1, 2, 2)
        self._cells = int(np.clip(2 * np.sqrt(len(self._triangles)), 4, 64))
        corners = self.points[self._triangles]
        low, high = (self._cell(bound) for bound in (corners.min(axis=1), corners.max(axis=1)))
        cell = np.arange(self._cells)
        within = [
            (low[:, k, None] <= cell) & (cell <= high[:, k, None]) for k in range(2)
        ]  # each (triangles, cells)
        reached = (within[0][:, :, None] & within[1][:, None]).reshape(len(corners), -1)
        home, triangle = np.nonzero(reached.T)
        count = reached.sum(axis=0)
        slot = np.arange(len(home)) - np.repeat(np.cumsum(count) - count, count)
        # The triangles that reach into each cell of a grid over the disc; the first one pads.
        self._reaching = np.zeros((self._cells**2, count.max()), np.intp)
        self._reaching[home, slot] = triangle

    def _cell(self, point: Floats) -> Index:
        cell = (point / self._half + 1) * (self._cells / 2)
        return np.clip(cell.astype(np.intp), 0, self._cells - 1)

    def weights(self, direction: NDArray[np.floating]) -> tuple[Index, Floats]:
        """Three rows of the table and their weights, not negative and of sum 1.

        Args:
            direction: (b, 3) unit vectors, z at least 0.

        Returns:
            (b, 3) rows of the table, (b, 3) weights.
        """
        p = parabolic(direction)
        cell = self._cell(p)
        home = cell[:, 0] * self._cells + cell[:, 1]
        best = np.full(len(p), -np.inf)
        chosen = np.zeros(len(p), np.intp)
        for candidates in self._reaching.T:
            triangle = candidates[home]
            inside = self._barycentric(triangle, p).min(axis=1)
            better = inside > best
            best[better], chosen[better] = inside[better], triangle[better]
        weight = self._barycentric(chosen, p)
        # A query on a measured direction is that direction, not its neighbours by rounding.
        weight[weight < 1e-6] = 0
        weight /= weight.sum(axis=1, keepdims=True)
        return self._stands_for[self._triangles[chosen]], weight

    def _barycentric(self, triangle: Index, p: Floats) -> Floats:
        """(b, 3) weights of the corners of a triangle each, negative where p is outside."""
        frame, step = self._frame[triangle], p - self._origin[triangle]
        first = frame[:, 0, 0] * step[:, 0] + frame[:, 0, 1] * step[:, 1]
        second = frame[:, 1, 0] * step[:, 0] + frame[:, 1, 1] * step[:, 1]
        return np.stack([first, second, 1 - first - second], axis=1)


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

    def _nest(
        self, pairs: Index, outer: Array, which: Index, inner: Array, which_inner: Index
    ) -> None:
        self._outer = Mesh(outer)
        self._meshes: list[tuple[Mesh, Index]] = []
        self._home = np.empty((len(outer), 2), np.intp)
        groups: dict[bytes, tuple[Index, list[Index]]] = {}
        for row in range(len(outer)):
            members = np.flatnonzero(which == row)
            partners, first = np.unique(which_inner[members], return_index=True)
            group = groups.setdefault(partners.tobytes(), (partners, []))
            self._home[row] = list(groups).index(partners.tobytes()), len(group[1])
            group[1].append(pairs[members[first]])
        for partners, lists in groups.values():
            self._meshes.append((Mesh(inner[partners]), np.stack(lists)))

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


def on_sample(
    uv: NDArray[np.floating], grid: tuple[int, int], texel_mm: float
) -> NDArray[np.floating]:
    """(b, 2) x and y in mm from the centre of the sample, of uv (b, 2)."""
    h, w = grid
    return (uv - 0.5) * np.array([w, -h]) * texel_mm


def _joined(light: NDArray[np.floating], view: NDArray[np.floating]) -> Floats:
    return np.concatenate([parabolic(light), parabolic(view)], axis=1)


def _partners(outer: Index, inner: Index) -> float:
    """Median number of distinct inner directions for each outer one."""
    both = np.unique(np.stack([outer, inner], axis=1), axis=0)
    return float(np.median(np.bincount(both[:, 0])))


@final
@dataclass(frozen=True, eq=False)
class Near:
    """Lamps or cameras at finite distance: texels see them in directions of their own.

    Attributes:
        mesh: of their directions from the centre of the sample.
        distance: (m,) mm from the centre.
    """

    mesh: Mesh
    distance: Floats

    @staticmethod
    def of(position: NDArray[np.floating] | None) -> Near | None:
        """From (n, 3) positions in mm from the centre; None stays None."""
        if position is None:
            return None
        above = position[position[:, 2] >= 0]
        unit = directions.normalize(above).astype(np.float32)
        table, which = directions.unique(unit)
        _, first = np.unique(which, return_index=True)
        return Near(Mesh(table), np.linalg.norm(above[first].astype(float), axis=1))

    def from_centre(self, direction: Array, at: NDArray[np.floating]) -> Array:
        """The direction in which the centre sees what a texel sees along `direction`.

        The lamps lie on a surface around the sample, between them at a distance blended from
        theirs; where the texel's ray meets it, the centre looks. Exact at every lamp.

        Args:
            direction: (b, 3) unit vectors from the texels. at: (b, 2) texels, mm.

        Returns:
            (b, 3) unit vectors.
        """
        along = direction.astype(float)
        foot = np.concatenate([at, np.zeros((len(at), 1))], axis=1)
        across = np.sum(foot * along, axis=1)
        seen = along
        for _ in range(_NEAR_STEPS):
            row, weight = self.mesh.weights(seen)
            reach = np.sum(self.distance[row] * weight, axis=1)
            inside = np.square(across) + np.square(reach) - np.sum(np.square(foot), axis=1)
            way = np.sqrt(np.maximum(inside, 0)) - across
            seen = directions.normalize(foot + np.maximum(way, 1e-9)[:, None] * along)
            seen[:, 2] = np.maximum(seen[:, 2], 0)
        return seen.astype(np.float32)
