"""The native store `*.btf.zarr`: a Zarr v3 group that xarray, Dask and cloud stores open as it is.

    texture (n, h, w, c) float16 or float32, one chunk a texture, sharded by a run of pairs
    light, view (n, 3) float32            optional: light_position, view_position (n, 3) mm,
    validity, variance, footprint,        attributes: what `BTF` says about itself,
    coverage, blur, blur_of               and masked_texels, how many texels are NaN

Every chunk is compressed and carries a CRC32C, so a damaged one is told, never answered.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, final

import numpy as np
import zarr
from numpy.typing import NDArray

from btfkit import native
from btfkit.btf import BTF, QUANTITY
from btfkit.errors import FormatError
from btfkit.footprint import Blurs
from btfkit.io.store.chunks import Chunks, are_ours
from btfkit.remote import Location, Remote
from btfkit.textures import Array, Index, Textures

VERSION = 1
IMAGE_AXES = ("pair", "row", "column", "channel")
# More values a texture, or more pairs, than this: a damaged header, not a sample.
_MOST_VALUES, _MOST_PAIRS = 1 << 31, 1 << 24
# Memory for rows of all textures, which ABRDFs are taken from.
_BAND_BYTES = 64 << 20
# The attribute that makes a group a store of ours: its version.
MARK = "btfkit"
_MARKED = f'"{MARK}"'.encode()
# The attribute of a store whose validity is that a texture's value is finite.
SAID_BY_TEXTURES = "validity_is_finite"
_AGAIN = "ingest the source again, or copy the store again"


def detect(path: Path) -> bool:
    """Whether `path` is a Zarr v3 group that says it is a btfkit store."""
    metadata = path / "zarr.json"
    if not metadata.is_file():
        return False
    with metadata.open("rb") as file:
        return _MARKED in file.read(1 << 20)


def is_store(where: Remote) -> bool:
    """The same of a remote folder.

    Raises:
        OSError: it cannot be reached.
    """
    return where.exists("zarr.json") and _MARKED in where.read("zarr.json")


def read(path: Location) -> BTF:
    """The BTF in a native store; textures are decoded when they are asked for.

    Raises:
        FormatError: not a store, of a newer version, incomplete or damaged.
    """
    try:
        group = open_group(path)
        attributes: dict[str, Any] = dict(group.attrs)
        version = attributes.get(MARK)
    except Exception as error:  # zarr raises whatever its parsers raise
        raise FormatError(
            str(path), f"not a readable Zarr group ({error})", remedy=_AGAIN
        ) from error
    if not isinstance(version, int) or not 1 <= version <= VERSION:
        raise FormatError(
            str(path), f"store version {version!r}; this version reads up to {VERSION}"
        )
    if attributes.get("quantity") != QUANTITY:
        raise FormatError(
            str(path), f"quantity {attributes.get('quantity')!r}; expected {QUANTITY!r}"
        )
    textures = StoreTextures(path, _member(path, group, "texture"))
    n, h, w, _ = textures.shape

    def small(name: str, *shapes: tuple[int, ...], kind: str = "f") -> NDArray[Any] | None:
        if name not in group:
            return None
        return _whole(path, _member(path, group, name), shapes, kind)

    try:
        return BTF(
            textures=textures,
            light=_required(path, small("light", (n, 3)), "light"),
            view=_required(path, small("view", (n, 3)), "view"),
            light_position=small("light_position", (n, 3)),
            view_position=small("view_position", (n, 3)),
            # Where textures say it themselves, by NaN, a copy of it in memory says no more.
            validity=None
            if attributes.get(SAID_BY_TEXTURES)
            else small("validity", (n, h, w), (1, h, w), kind="b"),
            variance=StoreTextures(path, _member(path, group, "variance"))
            if "variance" in group
            else None,
            footprint=small("footprint", (n,)),
            coverage=StoreTextures(path, _member(path, group, "coverage"))
            if "coverage" in group
            else None,
            blurs=Blurs(
                StoreTextures(path, _member(path, group, "blur")),
                _required(path, small("blur_of", (n,), kind="i"), "blur_of"),
            )
            if "blur" in group
            else None,
            **_said(attributes),
        )
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise FormatError(
            str(path), f"the store contradicts itself: {error}", remedy=_AGAIN
        ) from error


def open_group(path: Location) -> zarr.Group:
    """The Zarr group of a store, for reading."""
    if isinstance(path, Path):
        return zarr.open_group(path, mode="r", zarr_format=3)
    with path.told():
        return zarr.open_group(path.url, mode="r", zarr_format=3)


def masked_texels(path: Location) -> int:
    """How many texels of a store hold a value that is not finite."""
    masked = open_group(path).attrs.get("masked_texels", 0)
    return masked if isinstance(masked, int) else 0


@final
class StoreTextures(Textures):
    """The textures of a native store: one chunk is read for one texture."""

    def __init__(self, path: Location, array: zarr.Array[Any]) -> None:
        shape = array.shape
        if (
            len(shape) != 4
            or min(*shape, *(array.shards or array.chunks)) < 1
            or int(np.prod(shape[1:], dtype=object)) > _MOST_VALUES
            or shape[0] > _MOST_PAIRS
        ):
            raise FormatError(str(path), f"{array.basename} has shape {shape}", remedy=_AGAIN)
        if array.dtype not in (np.float16, np.float32) or array.chunks != (1, *shape[1:]):
            raise FormatError(
                str(path),
                f"{array.basename} is {array.dtype} in chunks {array.chunks}; "
                f"expected float16 or float32, one chunk a texture",
            )
        self.shape = (shape[0], shape[1], shape[2], shape[3])
        self.dtype = array.dtype
        self._path, self._array = path, array
        self._run = (array.shards or array.chunks)[0]
        local = isinstance(path, Path)
        self._chunks = Chunks(array, self._shard) if local and are_ours(array) else None
        self._there: frozenset[str] | None = None
        self._band: tuple[int, Array] | None = None

    def __getstate__(self) -> dict[str, Any]:
        # Another process keeps a band of its own.
        return {**self.__dict__, "_band": None}

    def _shard(self, shard: int) -> str:
        return f"{self._path}/{shard_name(self._array.basename, shard)}"

    def _has(self, shard: int) -> bool:
        if isinstance(self._path, Path):
            return Path(self._shard(shard)).is_file()
        if self._there is None:
            # Listed once: whole stores do not change.
            folder = f"{self._array.basename}/c"
            self._there = frozenset(f"{folder}/{name}" for name in self._path.names(folder))
        return shard_name(self._array.basename, shard) in self._there

    def _read(self, index: int) -> Array:
        number = index // self._run
        shard = self._shard(number)
        if not self._has(number):
            # Zarr answers a missing shard with the fill value, silently.
            raise FormatError(shard, f"missing; it holds pair {index}", remedy=_AGAIN)
        try:
            if self._chunks:
                return self._chunks.read(index)
            return np.asarray(self._array[index], np.float32)
        except Exception as error:  # whatever the codecs raise on damaged bytes
            raise FormatError(
                shard, f"the chunk of pair {index} is damaged ({error})", remedy=_AGAIN
            ) from error

    def texels(self, pairs: Index, rows: Index, cols: Index) -> Array:
        """(b, c) scattered values; asked for most pairs, a band of rows of all is kept at hand."""
        n, h, w, c = self.shape
        height = min(h, _BAND_BYTES // (n * w * c * self.dtype.itemsize))
        first = int(rows.min(initial=h)) // max(height, 1) * height
        few = 2 * len(np.unique(pairs)) < n
        if few or height < 1 or int(rows.max(initial=0)) >= first + height:
            return super().texels(pairs, rows, cols)
        if self._band is None or self._band[0] != first:
            self._band = first, self._rows(slice(first, min(first + height, h)))
        return self._band[1][pairs, rows - first, cols].astype(np.float32)

    def _rows(self, rows: slice) -> Array:
        """(n, rows, w, c) some rows of every texture, read by all processors."""
        band = np.empty((len(self), rows.stop - rows.start, *self.shape[2:]), self.dtype)

        def read(pair: int) -> None:
            band[pair] = self._read(pair)[rows]

        with ThreadPoolExecutor(native.threads()) as workers:
            for _ in workers.map(read, range(len(self))):
                pass
        return band


def shard_name(array: str, shard: int) -> str:
    """A shard of an image array inside its store: Zarr's default chunk key encoding."""
    return f"{array}/c/{shard}/0/0" + ("" if array == "validity" else "/0")


def _required(path: Location, array: NDArray[Any] | None, name: str) -> NDArray[Any]:
    if array is None:
        raise FormatError(str(path), f"the store has no array {name!r}", remedy=_AGAIN)
    return array


def _member(path: Location, group: zarr.Group, name: str) -> zarr.Array[Any]:
    try:
        member = group[name]
    except Exception as error:
        raise FormatError(str(path), f"array {name!r} is missing or damaged ({error})") from error
    if not isinstance(member, zarr.Array):
        raise FormatError(str(path), f"{name!r} is a group; expected an array")
    return member


def _said(attributes: dict[str, Any]) -> dict[str, Any]:
    """What attributes say about a BTF, by its field names.

    Raises:
        KeyError, TypeError: an attribute is missing or of the wrong kind.
    """
    expected: dict[str, tuple[str, type | tuple[type, ...]]] = {
        "channels": ("channels", list),
        "colour": ("colour", str),
        "texel_mm": ("texel_mm", (int, float, type(None))),
        "wrap": ("wrap", str),
        "licence": ("licence", (str, type(None))),
        "provenance": ("source", dict),
        "history": ("history", list),
    }
    said: dict[str, Any] = {}
    for name, (key, kind) in expected.items():
        value = attributes[key]
        if not isinstance(value, kind) or isinstance(value, bool):
            raise TypeError(f"{key} is {str(value)[:60]!r}")
        if isinstance(value, list):
            if not all(isinstance(each, str) for each in value):
                raise TypeError(f"{key} is {str(value)[:60]}; expected texts")
            value = tuple(value)
        said[name] = float(value) if name == "texel_mm" and value is not None else value
    return said


def _whole(
    path: Location, array: zarr.Array[Any], shapes: tuple[tuple[int, ...], ...], kind: str
) -> NDArray[Any]:
    """All of a small array of one of the given shapes."""
    if array.shape not in shapes or array.dtype.kind != kind:
        raise FormatError(
            str(path), f"{array.basename} is {array.dtype} of shape {array.shape}", remedy=_AGAIN
        )
    try:
        # Zarr answers a missing chunk with the fill value, silently.
        lacking = array.nchunks - array.nchunks_initialized
        if lacking > 0:
            raise FormatError(
                str(path), f"{lacking} chunks of {array.basename!r} are missing", remedy=_AGAIN
            )
        return np.asarray(array[...])
    except FormatError:
        raise
    except Exception as error:  # whatever the codecs raise on damaged bytes
        raise FormatError(
            str(path), f"array {array.basename!r} is damaged ({error})", remedy=_AGAIN
        ) from error
