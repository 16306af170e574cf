"""The native store `*.btf.zarr`: a Zarr v3 group that xarray, Dask and cloud stores open as it is.

    texture (n, h, w, c) float16 or float32, one chunk a texture, sharded by a run of pairs
    light, view (n, 3) float32            optional: light_position, view_position (n, 3) mm,
    validity, variance, footprint         attributes: what `BTF` says about itself,
                                          and masked_texels, how many texels are NaN

Every chunk is compressed and carries a CRC32C, so a damaged one is told, never answered.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, final

import numpy as np
import zarr
from numpy.typing import NDArray

from btfkit.btf import BTF, QUANTITY
from btfkit.errors import FormatError
from btfkit.textures import Array, Textures

VERSION = 1
IMAGE_AXES = ("pair", "row", "column", "channel")
# A texture of more values than this is a damaged header, not a sample.
_MOST_VALUES = 1 << 31
_AGAIN = "ingest the source again, or copy the store again"


def detect(path: Path) -> bool:
    """Whether `path` is a Zarr v3 group that says it is a btfkit store."""
    metadata = path / "zarr.json"
    return metadata.is_file() and b'"btfkit"' in metadata.read_bytes()[:65536]


def read(path: Path) -> BTF:
    """The BTF in a native store; textures are decoded when they are asked for.

    Raises:
        FormatError: not a store, of a newer version, incomplete or damaged.
    """
    try:
        group = zarr.open_group(path, mode="r", zarr_format=3)
        attributes: dict[str, Any] = dict(group.attrs)
        version = attributes.get("btfkit")
    except Exception as error:  # zarr raises whatever its parsers raise
        raise FormatError(path, f"not a readable Zarr group ({error})", remedy=_AGAIN) from error
    if not isinstance(version, int) or not 1 <= version <= VERSION:
        raise FormatError(path, f"store version {version!r}; this version reads up to {VERSION}")
    if attributes.get("quantity") != QUANTITY:
        raise FormatError(path, f"quantity {attributes.get('quantity')!r}; expected {QUANTITY!r}")
    textures = StoreTextures(path, _member(path, group, "texture"))

    def small(name: str) -> NDArray[Any] | None:
        if name not in group:
            return None
        return _whole(path, _member(path, group, name))

    try:
        return BTF(
            textures=textures,
            light=_required(path, small("light"), "light"),
            view=_required(path, small("view"), "view"),
            light_position=small("light_position"),
            view_position=small("view_position"),
            validity=small("validity"),
            variance=StoreTextures(path, _member(path, group, "variance"))
            if "variance" in group
            else None,
            footprint=small("footprint"),
            channels=tuple(attributes["channels"]),
            colour=attributes["colour"],
            texel_mm=attributes["texel_mm"],
            wrap=attributes["wrap"],
            licence=attributes["licence"],
            provenance=attributes["source"],
            history=tuple(attributes["history"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(path, f"the store contradicts itself: {error}", remedy=_AGAIN) from error


@final
class StoreTextures(Textures):
    """The textures of a native store: one chunk is read for one texture."""

    def __init__(self, path: Path, array: zarr.Array[Any]) -> None:
        shape = array.shape
        if (
            len(shape) != 4
            or min(shape) < 1
            or int(np.prod(shape[1:], dtype=object)) > _MOST_VALUES
        ):
            raise FormatError(path, f"{array.basename} has shape {shape}", remedy=_AGAIN)
        if array.dtype not in (np.float16, np.float32) or array.chunks != (1, *shape[1:]):
            raise FormatError(
                path,
                f"{array.basename} is {array.dtype} in chunks {array.chunks}; "
                f"expected float16 or float32, one chunk a texture",
            )
        self.shape = (shape[0], shape[1], shape[2], shape[3])
        self.dtype = array.dtype
        self._path, self._array = path, array
        self._run = (array.shards or array.chunks)[0]

    def _read(self, index: int) -> Array:
        shard = shard_path(self._path / self._array.basename, index // self._run)
        if not shard.is_file():
            # Zarr answers a missing shard with the fill value, silently.
            raise FormatError(shard, f"missing; it holds pair {index}", remedy=_AGAIN)
        try:
            return np.asarray(self._array[index], np.float32)
        except Exception as error:  # whatever the codecs raise on damaged bytes
            raise FormatError(
                shard, f"the chunk of pair {index} is damaged ({error})", remedy=_AGAIN
            ) from error


def shard_path(array: Path, shard: int) -> Path:
    """File of a shard of an image array: Zarr's default chunk key encoding."""
    return array / "c" / str(shard) / "0" / "0" / "0"


def _required(path: Path, array: NDArray[Any] | None, name: str) -> NDArray[Any]:
    if array is None:
        raise FormatError(path, f"the store has no array {name!r}", remedy=_AGAIN)
    return array


def _member(path: Path, group: zarr.Group, name: str) -> zarr.Array[Any]:
    try:
        member = group[name]
    except Exception as error:
        raise FormatError(path, f"array {name!r} is missing or damaged ({error})") from error
    if not isinstance(member, zarr.Array):
        raise FormatError(path, f"{name!r} is a group; expected an array")
    return member


def _whole(path: Path, array: zarr.Array[Any]) -> NDArray[Any]:
    if int(np.prod(array.shape, dtype=object)) > _MOST_VALUES:
        raise FormatError(path, f"{array.basename} has shape {array.shape}", remedy=_AGAIN)
    try:
        return np.asarray(array[...])
    except Exception as error:
        raise FormatError(
            path, f"array {array.basename!r} is damaged ({error})", remedy=_AGAIN
        ) from error
