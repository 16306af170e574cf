"""Images of Bonn's binary `.btf`: factors multiplied out, or values picked, when asked for.

Pair l + nL * v is light l under view v. Texel rows and columns are index arrays, so that windows
and flips cost nothing.
"""

from __future__ import annotations

import bz2
import copy
import threading
from abc import abstractmethod
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self, final

import numpy as np
from numpy.typing import NDArray

from btfkit.errors import FormatError
from btfkit.io.bonn import colour as bonn_colour
from btfkit.io.bonn.body import Chunks, Factors, Layout
from btfkit.native import factors as kernel
from btfkit.textures import Array, Index, Textures

# Planes of a colour model and values of chunks that are in work at a time, bytes.
_AT_ONCE = 1 << 25
# Unpacked chunks that are kept, bytes.
_KEPT = 1 << 26


@final
@dataclass(frozen=True, eq=False)
class Grid:
    """Where the images asked for lie in the file.

    Attributes:
        pairs: (n,) pairs of the file.
        rows, cols: (h,) and (w,) texels of the file.
        scale: (n,) factor of each image.
        tint: (c,) factor of each channel, or None.
    """

    pairs: Index
    rows: Index
    cols: Index
    scale: Array
    tint: Array | None = None


class BonnTextures(Textures):
    """What the kinds of file share: pairs, windows, factors of the values."""

    def __init__(self, layout: Layout, grid: Grid) -> None:
        self._layout, self._grid = layout, grid
        channels = len(layout.meta.channels)
        self.shape = (len(grid.pairs), len(grid.rows), len(grid.cols), channels)

    def _read(self, index: int) -> Array:
        return self.batch([index])[0]

    def batch(self, pairs: Sequence[int] | Index, *, out: Array | None = None) -> Array:
        """(k, h, w, c) images of several pairs at once.

        Args:
            pairs: (k,) indices.
            out: (k, h, w, c) contiguous float32 to fill instead of a new array.
        """
        index = np.asarray(pairs, np.intp)
        if out is None:
            out = np.empty((len(index), *self.shape[1:]), np.float32)
        self._fill(self._grid.pairs[index], self._grid.scale[index], out)
        if self._grid.tint is not None:
            out *= self._grid.tint
        return out

    def texels(self, pairs: Index, rows: Index, cols: Index) -> Array:
        grid = self._grid
        found = self._pick(grid.pairs[pairs], grid.scale[pairs], grid.rows[rows], grid.cols[cols])
        return found if grid.tint is None else found * grid.tint

    def crop(self, rows: slice, cols: slice) -> Self:
        grid = self._grid
        return self._with(Grid(grid.pairs, grid.rows[rows], grid.cols[cols], grid.scale, grid.tint))

    def subset(self, pairs: Index) -> Self:
        grid = self._grid
        return self._with(
            Grid(grid.pairs[pairs], grid.rows, grid.cols, grid.scale[pairs], grid.tint)
        )

    def _with(self, grid: Grid) -> Self:
        other = copy.copy(self)
        BonnTextures.__init__(other, self._layout, grid)
        return other

    @abstractmethod
    def _fill(self, pairs: Index, scale: Array, out: Array) -> None:
        """Fill `out` (k, h, w, c) with images of pairs (k,) of the file, times scale (k,)."""

    @abstractmethod
    def _pick(self, pairs: Index, scale: Array, rows: Index, cols: Index) -> Array:
        """(b, c) values of pairs, rows and columns (b,) of the file, times scale (b,)."""


def _filled(
    factors: Factors, grid: Grid, width: int, pairs: Index, scale: Array, log: bool, out: Array
) -> None:
    """Images (k, h, w, c) of one factorisation: k rows a channel, or texels with channels."""
    b, h, w, c = out.shape
    if factors.left_channels == c:
        rows = c * pairs[:, None] + np.arange(c)
        down, along = width * grid.rows, grid.cols
        target = out
    else:
        rows = pairs[:, None]
        down = c * width * grid.rows
        along = (c * grid.cols[:, None] + np.arange(c)).reshape(-1)
        target = out.reshape(b, h, w * c, 1)
    kernel.images(factors.left, factors.right, rows, down, along, scale, log=log, out=target)


def _picked(
    factors: Factors, channels: int, pairs: Index, texels: Index, scale: Array, log: bool
) -> Array:
    """(b, channels) values of one factorisation; pairs count within it."""
    each = np.arange(channels)
    i = np.broadcast_to(pairs[:, None], (len(pairs), channels))
    j = np.broadcast_to(texels[:, None], (len(pairs), channels))
    if factors.left_channels == channels:
        i = channels * i + each
    else:
        j = channels * j + each
    factor = np.repeat(scale, channels)
    found = kernel.values(
        factors.left, factors.right, i.reshape(-1), j.reshape(-1), factor, log=log
    )
    return found.reshape(-1, channels)


@final
class WholeTextures(BonnTextures):
    """FMF: one factorisation of all images."""

    def _fill(self, pairs: Index, scale: Array, out: Array) -> None:
        (factors,) = self._layout.factors
        _filled(factors, self._grid, self._layout.width, pairs, scale, self._layout.log, out)

    def _pick(self, pairs: Index, scale: Array, rows: Index, cols: Index) -> Array:
        (factors,) = self._layout.factors
        texels = self._layout.width * rows + cols
        return _picked(factors, self.shape[3], pairs, texels, scale, self._layout.log)


@final
class ChannelTextures(BonnTextures):
    """DFMF: one factorisation a channel, in the space of a colour model."""

    def _fill(self, pairs: Index, scale: Array, out: Array) -> None:
        k, h, w, c = out.shape
        step = max(1, _AT_ONCE // (4 * k * w * c))
        one = np.ones(k, np.float32)
        for start in range(0, h, step):
            part = slice(start, min(h, start + step))
            grid = Grid(pairs, self._grid.rows[part], self._grid.cols, scale)
            planes = []
            for factors in self._layout.factors:
                plane = np.empty((k, len(grid.rows), w, 1), np.float32)
                _filled(factors, grid, self._layout.width, pairs, one, False, plane)
                planes.append(plane[..., 0])
            for channel, plane in enumerate(self._decoded(planes)):
                np.multiply(plane, scale[:, None, None], out=out[:, part, :, channel])

    def _pick(self, pairs: Index, scale: Array, rows: Index, cols: Index) -> Array:
        texels = self._layout.width * rows + cols
        one = np.ones(len(pairs), np.float32)
        planes = [
            kernel.values(factors.left, factors.right, pairs, texels, one, log=False)
            for factors in self._layout.factors
        ]
        return np.stack([plane * scale for plane in self._decoded(planes)], axis=-1)

    def _decoded(self, planes: list[Array]) -> list[Array]:
        layout = self._layout
        found = bonn_colour.decoded(
            layout.colour_model, planes, mean=layout.colour_mean, transform=layout.colour_transform
        )
        for plane in found:
            plane[~np.isfinite(plane)] = np.nan
        return found


@final
class ViewTextures(BonnTextures):
    """PVF: a mean and principal components for each view."""

    def _fill(self, pairs: Index, scale: Array, out: Array) -> None:
        grid, width = self._grid, self._layout.width
        for view, members, lights in self._by_view(pairs):
            factors = self._layout.factors[view]
            part = np.empty((len(members), *out.shape[1:]), np.float32)
            one = np.ones(len(members), np.float32)
            _filled(factors, grid, width, lights, one, False, part)
            means = self._means(
                factors, lights[:, None, None], width * grid.rows[:, None] + grid.cols
            )
            out[members] = _added(part, means, scale[members, None, None, None])

    def _pick(self, pairs: Index, scale: Array, rows: Index, cols: Index) -> Array:
        out = np.empty((len(pairs), self.shape[3]), np.float32)
        texels = self._layout.width * rows + cols
        for view, members, lights in self._by_view(pairs):
            factors = self._layout.factors[view]
            one = np.ones(len(members), np.float32)
            part = _picked(factors, self.shape[3], lights, texels[members], one, False)
            means = self._means(factors, lights, texels[members])
            out[members] = _added(part, means, scale[members, None])
        return out

    def _by_view(self, pairs: Index) -> list[tuple[int, Index, Index]]:
        """View, members of `pairs` under it, and their lights."""
        lights = self._layout.directions.light.shape[1]
        views = pairs // lights
        return [
            (int(view), members := np.flatnonzero(views == view), pairs[members] % lights)
            for view in np.unique(views)
        ]

    def _means(self, factors: Factors, lights: Index, texels: Index) -> Array:
        """What is added, (..., c) for lights and texels (...)."""
        channels = self.shape[3]
        table: NDArray[Any] = np.asarray(factors.mean)
        at = lights if factors.left_channels == channels else texels
        # What float32 cannot hold becomes NaN or infinite, and is masked like other such values.
        with np.errstate(invalid="ignore", over="ignore"):
            return table.reshape(-1, channels)[at].astype(np.float32)


def _added(part: Array, means: Array, scale: Array) -> Array:
    """(part + means) scale; NaN where float32 cannot hold it."""
    with np.errstate(over="ignore", invalid="ignore"):
        found = (part + means) * scale
    return np.where(np.isfinite(found), found, np.float32(np.nan))


@final
class ValueTextures(BonnTextures):
    """BDI: the values themselves, texel by texel.

    An image has one value of each texel, and so touches all of the file: ask for windows, for
    texels, or for many images at once. Texels that a sparse file does not store are NaN.
    """

    def __init__(self, path: Path, layout: Layout, grid: Grid, chunks: Chunks) -> None:
        super().__init__(layout, grid)
        self._path, self._chunks = path, chunks
        self._unpacked: OrderedDict[int, NDArray[np.uint8]] = OrderedDict()
        self._lock = threading.Lock()
        self._sparse = chunks.compression == 2
        if self._sparse:
            # Place of each texel among those that its chunk stores.
            self._places = np.empty(chunks.mask.shape, np.int64)
            for start in range(0, len(chunks.mask), chunks.rows):
                part = chunks.mask[start : start + chunks.rows]
                placed = np.maximum(np.cumsum(part) - 1, 0)
                self._places[start : start + chunks.rows] = placed.reshape(part.shape)

    def __getstate__(self) -> dict[str, Any]:
        # Another process unpacks its own chunks.
        return {n: v for n, v in self.__dict__.items() if n not in ("_lock", "_unpacked")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._lock, self._unpacked = threading.Lock(), OrderedDict()

    def _fill(self, pairs: Index, scale: Array, out: Array) -> None:
        rows, cols = self._grid.rows, self._grid.cols
        for number in np.unique(rows // self._chunks.rows):
            inside = np.flatnonzero(rows // self._chunks.rows == number)
            r, c = rows[inside, None], cols[None, :]
            places = self._place(r, c)[..., None]
            found = self._chunk(int(number))[places, pairs].astype(np.float32)
            found[~np.isfinite(found)] = np.nan
            found[self._missing(r, c)] = np.nan
            out[:, inside] = np.moveaxis(found, 2, 0) * scale[:, None, None, None]

    def _pick(self, pairs: Index, scale: Array, rows: Index, cols: Index) -> Array:
        out = np.empty((len(pairs), self.shape[3]), np.float32)
        numbers = rows // self._chunks.rows
        for number in np.unique(numbers):
            inside = np.flatnonzero(numbers == number)
            place = self._place(rows[inside], cols[inside])
            out[inside] = self._chunk(int(number))[place, pairs[inside]]
        out[~np.isfinite(out)] = np.nan
        out[self._missing(rows, cols)] = np.nan
        return out * scale[:, None]

    def _place(self, rows: Index, cols: Index) -> Index:
        """Place of texels within their chunk; rows and columns broadcast."""
        if self._sparse:
            return self._places[rows, cols]
        return rows % self._chunks.rows * self._layout.width + cols

    def _missing(self, rows: Index, cols: Index) -> NDArray[np.bool_]:
        """Whether texels are not in the file."""
        missing = ~self._chunks.mask[rows, cols]
        return missing if self._sparse else np.zeros_like(missing)

    def _chunk(self, number: int) -> NDArray[np.float16]:
        """(texels, pairs, c) values of a chunk."""
        data = self._chunks.data[number]
        if self._chunks.compression == 1:
            data = self._unpack(number)
        if not len(data):
            # Nothing of it is stored; one texel to point at.
            return np.zeros((1, self._layout.pairs, self.shape[3]), np.float16)
        return data.view("<f2").reshape(-1, self._layout.pairs, self.shape[3])

    def _unpack(self, number: int) -> NDArray[np.uint8]:
        with self._lock:
            if number in self._unpacked:
                self._unpacked.move_to_end(number)
                return self._unpacked[number]
        inside = self._chunks.mask[number * self._chunks.rows :][: self._chunks.rows]
        expected = 2 * inside.size * self._layout.pairs * self.shape[3]
        try:
            unpacker = bz2.BZ2Decompressor()
            # One byte more tells a chunk that unpacks to more than it may.
            data = unpacker.decompress(self._chunks.data[number].tobytes(), expected + 1)
        except (OSError, ValueError, EOFError) as error:
            raise FormatError(self._path, f"chunk {number} is damaged ({error})") from error
        if len(data) != expected or not unpacker.eof:
            raise FormatError(
                self._path,
                f"chunk {number} unpacks to {'more' if len(data) > expected else len(data)} bytes; "
                f"expected {expected}",
                remedy="download or copy the file again",
            )
        unpacked = np.frombuffer(data, np.uint8)
        with self._lock:
            self._unpacked[number] = unpacked
            while sum(map(len, self._unpacked.values())) > _KEPT and len(self._unpacked) > 1:
                self._unpacked.popitem(last=False)
        return unpacked
