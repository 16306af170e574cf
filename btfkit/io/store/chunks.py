"""Textures of a native store read straight from its shards, as our own writer packs them.

Zarr's own way through a shard takes four times as long for one chunk; it stays the way for stores
that were packed otherwise. The layout is that of Zarr v3's sharding codec: chunks, each with its
CRC32C, then an index of (offset, bytes) of 16 bytes a chunk, and the CRC32C of that.

Source: Zarr enhancement proposal 2, sharding codec, version 1.0.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, final

import numpy as np
import zarr
from numcodecs.blosc import decompress
from numcodecs.checksum32 import CRC32C
from numpy.typing import NDArray

from btfkit.textures import Array

_CRC_BYTES, _ENTRY_BYTES = 4, 16
_MISSING = np.iinfo(np.uint64).max


@final
class Chunks:
    """The textures of a sharded array, one chunk each.

    Args:
        array: an array that `are_ours` holds for.
        shard_path: file of a shard, by its number.
    """

    def __init__(self, array: zarr.Array[Any], shard_path: Any) -> None:
        self._shape, self._dtype = array.shape[1:], np.dtype(array.dtype).newbyteorder("<")
        self._bytes = int(np.prod(self._shape)) * self._dtype.itemsize
        self._run = array.shards[0] if array.shards else 1
        self._path = shard_path
        self._indices: dict[int, NDArray[np.uint64]] = {}

    def read(self, index: int) -> Array:
        """(h, w, c) texture `index`.

        Raises:
            OSError: the shard cannot be read.
            ValueError, RuntimeError: a checksum or the compressed bytes are wrong.
        """
        shard, slot = divmod(index, self._run)
        with Path(self._path(shard)).open("rb", buffering=0) as file:
            offset, size = (int(value) for value in self._index(shard, file)[slot])
            if offset == _MISSING:
                raise ValueError("the chunk is missing")
            packed = _checked(_read(file, size, offset))
        # Blosc says first how much it unpacks to; nothing is unpacked that says otherwise.
        if int.from_bytes(packed[4:8], "little") != self._bytes:
            raise ValueError(f"it unpacks to other than {self._bytes} bytes")
        values = np.frombuffer(decompress(packed), self._dtype)
        return values.reshape(self._shape).astype(np.float32)

    def _index(self, shard: int, file: Any) -> NDArray[np.uint64]:
        # Without a lock, which would go neither to another process nor safely through a fork: who
        # comes second reads the same once more.
        if shard not in self._indices:
            size = self._run * _ENTRY_BYTES + _CRC_BYTES
            end = os.fstat(file.fileno()).st_size
            table = _checked(_read(file, size, max(end - size, 0)))
            self._indices[shard] = np.frombuffer(table, "<u8").reshape(-1, 2)
        return self._indices[shard]


def are_ours(array: zarr.Array[Any]) -> bool:
    """Whether an array is packed as `Chunks` reads it.

    Whole textures, Blosc and CRC32C, in shards with the index last.
    """
    codecs = array.metadata.to_dict().get("codecs")
    if not isinstance(codecs, (list, tuple)) or len(codecs) != 1:
        return False
    outer: Any = codecs[0]
    settings = outer.get("configuration", {})
    inner = [(c["name"], c.get("configuration", {}).get("endian")) for c in settings["codecs"]] \
        if outer.get("name") == "sharding_indexed" else []  # fmt: skip
    index = [codec["name"] for codec in settings.get("index_codecs", ())]
    whole = array.shape[1:]
    return (
        array.chunks == (1, *whole)
        and array.shards is not None
        and array.shards[1:] == whole
        and inner == [("bytes", "little"), ("blosc", None), ("crc32c", None)]
        and index == ["bytes", "crc32c"]
        and settings.get("index_location") == "end"
    )


def _read(file: Any, size: int, offset: int) -> bytes:
    file.seek(offset)
    data: bytes = file.read(size)
    return data


def _checked(data: bytes) -> bytes:
    """Data before its CRC32C, once it is right."""
    if len(data) <= _CRC_BYTES:
        raise ValueError("cut short")
    return bytes(CRC32C(location="end").decode(data))
