"""A BTF as a fit reads it: looked at by several parts, decoded once, its missing texels counted."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import replace
from threading import Lock
from typing import final

import numpy as np

from btfkit.btf import BTF
from btfkit.queries import QuerySet
from btfkit.textures import Array, Index, Textures

# Textures that `auto`, the look at held-out pairs and the evaluation share.
_MOST_BYTES = 128 << 20


def read_once(source: BTF | QuerySet) -> BTF | QuerySet:
    """The same data; textures that are asked for one by one, or few, are kept for who asks next."""
    if isinstance(source, QuerySet):
        return source
    return replace(source, textures=Once(source), validity=None)


def masked(source: BTF | QuerySet, rows: Index) -> int:
    """How many texels of the pairs that were read (or of the rows) are not measured."""
    if isinstance(source, QuerySet):
        return int((~source.valid()[rows]).sum())
    textures = source.textures
    return int(textures.masked[rows].sum()) if isinstance(textures, Once) else 0


@final
class Once(Textures):
    """Textures of a BTF, NaN where not valid; the last that were read one by one stay at hand.

    Attributes:
        masked: (n,) texels of each pair that are not measured; 0 where it was not read yet.
    """

    def __init__(self, btf: BTF, *, most_bytes: int = _MOST_BYTES) -> None:
        self._btf, self.shape = btf, btf.shape
        self.masked = np.zeros(len(btf), np.int64)
        self._most = most_bytes // (4 * int(np.prod(btf.shape[1:])))
        self._kept: OrderedDict[int, Array] = OrderedDict()
        self._lock = Lock()

    def _read(self, index: int) -> Array:
        with self._lock:
            if index in self._kept:
                self._kept.move_to_end(index)
                return self._kept[index]
        image = self._btf.texture(index)
        self._count(np.array([index]), image[None])
        with self._lock:
            self._kept[index] = image
            while len(self._kept) > self._most:
                self._kept.popitem(last=False)
        return image

    def batch(self, pairs: Sequence[int] | Index) -> Array:
        index = np.asarray(pairs, np.intp)
        with self._lock:
            known = {slot: self._kept[pair] for slot, pair in enumerate(index.tolist())
                     if pair in self._kept}  # fmt: skip
        rest = [slot for slot in range(len(index)) if slot not in known]
        if not known:
            images = self._btf.batch(index)
        else:
            images = np.empty((len(index), *self.shape[1:]), np.float32)
            if rest:
                images[rest] = self._btf.batch(index[rest])
            for slot, image in known.items():
                images[slot] = image
        self._count(index, images)
        if self._most >= len(self):
            # All of it has room: whoever comes next needs no decoding.
            with self._lock:
                self._kept.update(zip(index.tolist(), images, strict=True))
        return images

    def texels(self, pairs: Index, rows: Index, cols: Index) -> Array:
        return self._btf.texels(pairs, rows, cols)

    def crop(self, rows: slice, cols: slice) -> Textures:
        return Once(self._btf.crop(rows, cols))

    def _count(self, pairs: Index, images: Array) -> None:
        missing = ~np.isfinite(images).all(axis=-1)
        self.masked[pairs] = missing.sum(axis=(1, 2))
