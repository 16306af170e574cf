"""The images of a BTF as a lazy list: whatever knows its shape and can give image i.

A reader subclasses `Textures` and overrides `_read`; where its format can answer a batch,
a window or scattered texels faster than by whole images, it overrides that too.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
Index = NDArray[np.intp]
# float16 ends at 65504; from here on rounding could reach infinity, and float32 is taken.
HALF_RANGE = 6e4


class Textures(ABC):
    """n images of h x w texels with c channels, read when asked for.

    Attributes:
        shape: (n, h, w, c).
    """

    shape: tuple[int, int, int, int]

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, index: int) -> Array:
        """(h, w, c) image of pair `index`, linear, float32."""
        n = self.shape[0]
        if not -n <= index < n:
            raise IndexError(f"pair {index} of {n}")
        return self._read(int(index) % n)

    @abstractmethod
    def _read(self, index: int) -> Array:
        """(h, w, c) float32 image; `index` is within 0..n-1. Called from several threads."""

    def batch(self, pairs: Sequence[int] | Index) -> Array:
        """(k, h, w, c) images of several pairs at once."""
        out = np.empty((len(pairs), *self.shape[1:]), np.float32)
        for slot, pair in enumerate(pairs):
            out[slot] = self[int(pair)]
        return out

    def texels(self, pairs: Index, rows: Index, cols: Index) -> Array:
        """Scattered values.

        Args:
            pairs, rows, cols: (b,) indices.

        Returns:
            (b, c) values.
        """
        out = np.empty((len(pairs), self.shape[3]), np.float32)
        order = np.argsort(pairs, kind="stable")
        distinct, start = np.unique(pairs[order], return_index=True)
        for pair, members in zip(distinct, np.split(order, start[1:]), strict=True):
            out[members] = self[int(pair)][rows[members], cols[members]]
        return out

    def crop(self, rows: slice, cols: slice) -> Textures:
        """The window of every image; formats that can decode less override this.

        Args:
            rows, cols: slices with start < stop within the image and no step.
        """
        return _Window(self, rows, cols)

    def subset(self, pairs: Index) -> Textures:
        """The images of the given pairs, in that order."""
        return _Subset(self, pairs)


@final
class ArrayTextures(Textures):
    """Images that already lie in an array-like of shape (n, h, w, c)."""

    def __init__(self, array: Any) -> None:
        if len(array.shape) != 4:
            raise ValueError(f"textures have shape {tuple(array.shape)}; expected (n, h, w, c)")
        self.shape = tuple(int(size) for size in array.shape)  # type: ignore[assignment]
        self._array = array

    def _read(self, index: int) -> Array:
        return np.asarray(self._array[index], np.float32)

    def texels(self, pairs: Index, rows: Index, cols: Index) -> Array:
        if isinstance(self._array, np.ndarray):
            return self._array[pairs, rows, cols].astype(np.float32)
        return super().texels(pairs, rows, cols)


@final
class _Window(Textures):
    """One window of every image of another list."""

    def __init__(self, inner: Textures, rows: slice, cols: slice) -> None:
        self._inner, self._rows, self._cols = inner, rows, cols
        n, _, _, c = inner.shape
        self.shape = (n, rows.stop - rows.start, cols.stop - cols.start, c)

    def _read(self, index: int) -> Array:
        return np.ascontiguousarray(self._inner[index][self._rows, self._cols])

    def texels(self, pairs: Index, rows: Index, cols: Index) -> Array:
        return self._inner.texels(pairs, rows + self._rows.start, cols + self._cols.start)


@final
class _Subset(Textures):
    """Some images of another list."""

    def __init__(self, inner: Textures, pairs: Index) -> None:
        self._inner, self._pairs = inner, pairs
        self.shape = (len(pairs), *inner.shape[1:])

    def _read(self, index: int) -> Array:
        return self._inner[int(self._pairs[index])]

    def batch(self, pairs: Sequence[int] | Index) -> Array:
        return self._inner.batch(self._pairs[np.asarray(pairs, np.intp)])

    def texels(self, pairs: Index, rows: Index, cols: Index) -> Array:
        return self._inner.texels(self._pairs[pairs], rows, cols)

    def crop(self, rows: slice, cols: slice) -> Textures:
        return _Subset(self._inner.crop(rows, cols), self._pairs)

    def subset(self, pairs: Index) -> Textures:
        return _Subset(self._inner, self._pairs[pairs])


def narrowed(values: NDArray[np.floating]) -> NDArray[np.float16] | NDArray[np.float32]:
    """Values as float16, or as float32 where one of them is beyond `HALF_RANGE`."""
    largest = np.abs(values).max(initial=0.0, where=np.isfinite(values))
    return values.astype(np.float16) if largest <= HALF_RANGE else values.astype(np.float32)


def as_textures(source: Any) -> Textures:
    """`source` as a lazy list of images: one already, or an array-like (n, h, w, c)."""
    return source if isinstance(source, Textures) else ArrayTextures(source)
