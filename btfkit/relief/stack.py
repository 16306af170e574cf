"""The values of a BTF by texel: what photometric stereo and parallax read, once.

Lengths are in texels: a place is (column, row), heights count texel edges, rows run against y.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from btfkit import directions
from btfkit.btf import BTF
from btfkit.native import trace as tracer
from btfkit.textures import HALF_RANGE

Array = NDArray[np.float32]
Floats = NDArray[Any]
Progress = Callable[[int, int], None]
Values = NDArray[np.float16] | NDArray[np.float32]

# Bytes that a stack may take in memory, and on disk where it takes more; pairs beyond which more of
# them tell a texel little.
_MOST_BYTES, _MOST_DISK = 3 << 29, 1 << 36
_MOST_VIEWS, _MOST_LIGHTS = 32, 48
# Of these few views all lights, for normals; of these few lights all views, for parallax. Normals
# do without views flatter than 60 degrees.
_NORMAL_VIEWS, _PARALLAX_LIGHTS, _STEEP = 8, 12, 0.5
# The largest value of an image is a clipped one where so many texels have it, unless half do.
_CLIPPED_TEXELS, _CLIPPED_SHARE = 4, 0.0005
# Views count by this power of the width in which they show a texel's surface: what it bought is in
# docs/heightfields.md.
_SHOWN = 8.0
# Where visibility is asked, from a texel's centre, texels.
_BESIDE = np.array([0.13, 0.07], np.float32)


@final
@dataclass(frozen=True, eq=False)
class Stack:
    """Some pairs of a BTF, all values of a texel side by side, sorted by view.

    Attributes:
        values: (h, w, n, c) float16, float32 where one is beyond 6e4; NaN where not measured or
            saturated. On disk, in a file without a name, where they are many: all that read them
            go from rows to rows.
        pairs: (n,) of the BTF. light, view: (n, 3) unit vectors.
        light_near, view_near: (n, 3) positions in texels from the centre of the sample, or None.
        light_of, view_of: (n,) which distinct direction each is.
        lights, views: (k, 3) distinct directions.
        wrap: whether the sample tiles.
        unmeasured, saturated: values left out, of all.
    """

    values: Values
    pairs: NDArray[np.intp]
    light: Array
    view: Array
    light_near: Array | None
    view_near: Array | None
    light_of: NDArray[np.intp]
    view_of: NDArray[np.intp]
    lights: Array
    views: Array
    wrap: bool
    unmeasured: int
    saturated: int

    @property
    def size(self) -> tuple[int, int]:
        """(h, w)."""
        return self.values.shape[0], self.values.shape[1]

    @cached_property
    def grey(self) -> Values:
        """(h, w, n, 1) mean of the channels."""
        if self.values.shape[3] == 1:
            return self.values
        out = _room((*self.values.shape[:3], 1), self.values.dtype)
        # Row by row, to spare memory.
        count = self.values.shape[3]
        for row, into in zip(self.values, out, strict=True):
            # A channel at a time: numpy is slow along an axis of three.
            into[..., 0] = sum(row[..., c].astype(np.float32) for c in range(count)) / count
        return out

    def subset(self, keep: NDArray[np.bool_]) -> Stack:
        """The pairs of a mask (n,)."""
        at = np.flatnonzero(keep)
        lights, light_of = directions.unique(self.light[at])
        views, view_of = directions.unique(self.view[at])
        values = _room((*self.size, len(at), self.values.shape[3]), self.values.dtype)
        for row, into in zip(self.values, values, strict=True):
            into[...] = row[:, at]
        return replace(
            self, values=values, pairs=self.pairs[at],
            light=self.light[at], view=self.view[at],
            light_near=None if self.light_near is None else self.light_near[at],
            view_near=None if self.view_near is None else self.view_near[at],
            lights=lights, light_of=light_of, views=views, view_of=view_of,
        )  # fmt: skip

    def for_normals(self) -> Stack:
        """All lights of a few upright views."""
        few = _upright(self.views)
        return self if len(few) == len(self.views) else self.subset(np.isin(self.view_of, few))

    def for_parallax(self) -> Stack:
        """All views of a few lights that several of them share."""
        views = np.zeros((len(self.lights), len(self.views)), bool)
        views[self.light_of, self.view_of] = True
        shared = views.sum(axis=1)
        good = np.flatnonzero(shared >= max(2, int(shared.max()) // 2))
        few = good[spread(self.lights[good], _PARALLAX_LIGHTS)] if len(good) else good
        return self.subset(np.isin(self.light_of, few)) if len(few) else self

    def of_views(self) -> Iterator[tuple[int, slice]]:
        """Each view with the run of its pairs."""
        starts = np.searchsorted(self.view_of, np.arange(len(self.views) + 1))
        for which in range(len(self.views)):
            yield which, slice(int(starts[which]), int(starts[which + 1]))

    def seen(self, values: Values, height: Array, rows: slice) -> Array:
        """(t, n, c) values of the surface points over the texels of some rows.

        Args:
            values: (h, w, n, c), `values` or `grey`.
            height: (h, w) of the surface, texels: it is seen at place - height x view_xy / view_z.
            rows: texels in these rows.
        """
        w = self.size[1]
        lifted = height[rows].reshape(-1, 1)
        if not np.any(lifted):
            return values[rows].reshape(-1, *values.shape[2:]).astype(np.float32)
        row, col = np.mgrid[rows, :w].reshape(2, -1, 1).astype(np.float32)
        out = np.empty((len(lifted), *values.shape[2:]), np.float32)
        for which, run in self.of_views():
            vx, vy, vz = (float(x) for x in self.views[which])
            step = 1 / max(vz, 1e-3)
            out[:, run] = sampled(
                values[:, :, run], row[:, 0] + lifted[:, 0] * vy * step,
                col[:, 0] - lifted[:, 0] * vx * step, wrap=self.wrap,
            )  # fmt: skip
        return out

    def shown(self, slope: Floats) -> Array:
        """(t, n) weights of pairs, 1 where a view shows a surface as wide as the plane, or wider.

        A view sees a surface that turns away from it in a narrow part of its picture. What lies
        between its pixels is lost there, and convex parts look lower than they are.

        Args:
            slope: (t, 2) dz/dx, dz/dy.
        """
        tangent = self.views[:, :2] / np.maximum(self.views[:, 2:], 1e-3)
        width = np.clip(1 - slope @ tangent.T, 0, 1) ** _SHOWN
        return width[:, self.view_of].astype(np.float32)

    def place(self, height: Array, rows: slice) -> Array:
        """(t, 3) points of the surface over the texels of some rows, as positions count."""
        return places(height, rows)


def places(height: Array, rows: slice = slice(None)) -> Array:
    """(t, 3) points over the texels of some rows of heights (h, w), texels from the centre."""
    h, w = height.shape
    grid = np.meshgrid(np.arange(h)[rows], np.arange(w), indexing="ij")
    row, col = (part.reshape(-1).astype(np.float32) for part in grid)
    x, y = col + 0.5 - w / 2, h / 2 - 0.5 - row
    return np.stack([x, y, height[rows].reshape(-1)], axis=1).astype(np.float32)


def slopes(height: Array, *, wrap: bool) -> Array:
    """(h, w, 2) dz/dx, dz/dy of heights in texels, softened by a texel."""
    soft = gaussian_filter(height, 1.0, mode="wrap" if wrap else "nearest")
    around = np.pad(soft, 1, mode="wrap" if wrap else "edge")
    dx = (around[1:-1, 2:] - around[1:-1, :-2]) / 2
    dy = (around[:-2, 1:-1] - around[2:, 1:-1]) / 2
    return np.stack([dx, dy], axis=-1).astype(np.float32)


def read_stack(btf: BTF, *, progress: Progress | None = None) -> Stack:
    """Well spread pairs of a BTF, each read once.

    Raises:
        ValueError: no pair is lit from above the horizon.
    """
    pairs = chosen(btf)
    lights, light_of = directions.unique(btf.light[pairs])
    views, view_of = directions.unique(btf.view[pairs])
    order = np.argsort(view_of, kind="stable")
    pairs, light_of, view_of = pairs[order], light_of[order], view_of[order]
    _, h, w, c = btf.shape
    values = _room((h, w, len(pairs), c), np.dtype(np.float16))
    unmeasured = saturated = 0
    for start in range(0, len(pairs), 8):
        run = slice(start, min(start + 8, len(pairs)))
        # A copy: textures in memory are given as they lie there.
        images = np.array(btf.batch(pairs[run]), np.float32)
        unmeasured += int((~np.isfinite(images)).any(axis=-1).sum())
        saturated += _leave_out_clipped(images)
        if values.dtype == np.float16 and np.nanmax(np.abs(images), initial=0) > HALF_RANGE:
            values = _widened(values, start)
        values[:, :, run] = images.transpose(1, 2, 0, 3)
        if progress:
            progress(run.stop, len(pairs))
    return Stack(
        values=values, pairs=pairs, light=btf.light[pairs], view=btf.view[pairs],
        light_near=_in_texels(btf.light_position, pairs, btf.texel_mm),
        view_near=_in_texels(btf.view_position, pairs, btf.texel_mm),
        light_of=light_of, view_of=view_of, lights=lights, views=views,
        wrap=btf.wrap == "wrap", unmeasured=unmeasured, saturated=saturated,
    )  # fmt: skip


def _room(shape: tuple[int, ...], dtype: np.dtype[Any]) -> Values:
    """An array in memory, or in a temporary file where it is large."""
    if dtype.itemsize * math.prod(shape) <= _MOST_BYTES:
        return np.empty(shape, dtype)
    with tempfile.TemporaryFile() as file:
        # The file is gone with its last reader.
        return np.memmap(file, dtype, "w+", shape=shape)


def _widened(values: Values, filled: int) -> Values:
    """The same in float32; only the first `filled` pairs hold anything yet."""
    out = _room(values.shape, np.dtype(np.float32))
    for row, into in zip(values, out, strict=True):
        into[:, :filled] = row[:, :filled]
    return out


def sampled(values: Floats, row: Floats, col: Floats, *, wrap: bool) -> Array:
    """(t, ...) values (h, w, ...) at places between texel centres, bilinear."""
    h, w = values.shape[:2]
    i, j = np.floor(row).astype(np.intp), np.floor(col).astype(np.intp)
    tail = (1,) * (values.ndim - 2)
    a, b = (
        (part - whole).astype(np.float32).reshape(-1, *tail) for part, whole in ((row, i), (col, j))
    )
    out = np.zeros((len(row), *values.shape[2:]), np.float32)
    for down, across, share in (
        (0, 0, (1 - a) * (1 - b)), (0, 1, (1 - a) * b), (1, 0, a * (1 - b)), (1, 1, a * b),
    ):  # fmt: skip
        r, c = i + down, j + across
        r, c = (r % h, c % w) if wrap else (np.clip(r, 0, h - 1), np.clip(c, 0, w - 1))
        out += share * values[r, c]
    return out


def visibility(height: Array, towards: Array, *, wrap: bool) -> NDArray[np.bool_]:
    """(k, h, w) whether surface points see each of k directions over the relief itself.

    Args:
        height: (h, w) texels.
        towards: (k, 3) unit vectors.
    """
    h, w = height.shape
    maps = np.zeros((h, w, 10), np.float32)
    maps[..., 6:8], maps[..., 9] = 0.5, 1
    relief = tracer.geometry(np.ascontiguousarray(height, np.float32), maps, wrap=wrap)
    row, col = np.mgrid[:h, :w].reshape(2, -1)
    # Not at the corners of the surface's cells: there the fold of a seam hides itself.
    place = np.stack([col, row], axis=1).astype(np.float32) + _BESIDE
    up = np.broadcast_to(np.array([0, 0, 1], np.float32), (h * w, 3))
    sharp = np.zeros(h * w, np.float32)
    found = np.empty((len(towards), h, w), bool)
    for into, ray in zip(found, towards, strict=True):
        lit = np.broadcast_to(np.asarray(ray, np.float32), (h * w, 3))
        into[...] = tracer.trace(relief, place, lit, up, sharp).visible.reshape(h, w) > 0
    return found


def chosen(btf: BTF) -> NDArray[np.intp]:
    """Pairs that `read_stack` reads: lit from above, of spread lights and views if many.

    Raises:
        ValueError: no pair is lit from above the horizon.
    """
    good = (btf.light[:, 2] > 0) & (btf.view[:, 2] > 0.05)
    if not good.any():
        raise ValueError("no pair is lit from above the horizon")
    _, h, w, c = btf.shape
    most = max(_MOST_DISK // (2 * h * w * c), 1)
    (lights, light_of), (views, view_of) = (directions.unique(d) for d in (btf.light, btf.view))
    if len(views) > 1 and len(lights) > 1 and int(good.sum()) > len(views) + len(lights):
        wide = spread(lights, _MOST_LIGHTS), spread(views, _MOST_VIEWS)
        few = wide[0][:_PARALLAX_LIGHTS], _upright(views)
        all_lights = np.isin(light_of, wide[0]) & np.isin(view_of, few[1])
        all_views = np.isin(view_of, wide[1]) & np.isin(light_of, few[0])
        kept = good & (all_lights | all_views)
        good = kept if kept.any() else good
    index: NDArray[np.intp] = np.flatnonzero(good)
    return index if len(index) <= most else index[:: -(-len(index) // most)]


def _upright(views: Array) -> NDArray[np.intp]:
    """A few views far from each other, none of them flat unless all are."""
    steep = np.flatnonzero(views[:, 2] >= min(_STEEP, float(views[:, 2].max())))
    return steep[spread(views[steep], _NORMAL_VIEWS)]


def spread(table: Array, count: int) -> NDArray[np.intp]:
    """Up to `count` rows of (k, 3) directions far from each other, the most upright first."""
    chosen = [int(np.argmax(table[:, 2]))]
    nearest = table @ table[chosen[0]]
    for _ in range(min(count, len(table)) - 1):
        chosen.append(int(np.argmin(nearest)))
        nearest = np.maximum(nearest, table @ table[chosen[-1]])
    return np.array(chosen)


def _leave_out_clipped(images: Array) -> int:
    """NaN where images (k, h, w, c) are clipped at their largest value; how many texels."""
    count = 0
    for image in images:
        largest = np.nanmax(image) if np.isfinite(image).any() else np.nan
        at = (image >= largest).any(axis=-1)
        share = at.mean()
        if _CLIPPED_SHARE < share < 0.5 and at.sum() >= _CLIPPED_TEXELS:
            image[at] = np.nan
            count += int(at.sum())
        image[~np.isfinite(image).all(axis=-1)] = np.nan
    return count


def _in_texels(
    position: Array | None, pairs: NDArray[np.intp], texel_mm: float | None
) -> Array | None:
    if position is None or texel_mm is None:
        return None
    return (position[pairs] / texel_mm).astype(np.float32)
