"""Which arrays a native store has, how they are cut into chunks and shards, and its attributes."""

from __future__ import annotations

from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import BloscCodec, Crc32cCodec

from btfkit.btf import BTF, QUANTITY
from btfkit.io.store.reader import IMAGE_AXES, SAID_BY_TEXTURES
from btfkit.textures import Textures, as_textures


def images_of(btf: BTF) -> dict[str, Textures]:
    """What has an image a pair, by its array."""
    beside = {"variance": btf.variance, "coverage": btf.coverage}
    return {"texture": btf.textures} | {
        name: as_textures(images) for name, images in beside.items() if images is not None
    }


def maps_of(btf: BTF) -> tuple[str, ...]:
    """Arrays that are written along with the images, and are none."""
    seen = ("validity",) if _said_by_textures(btf) else ()
    return (*seen, *(("blur",) if btf.blurs is not None else ()))


def attributes_of(btf: BTF) -> dict[str, Any]:
    """What a store says of a BTF before it is whole."""
    return {
        "quantity": QUANTITY,
        "colour": btf.colour,
        "channels": list(btf.channels),
        "texel_mm": btf.texel_mm,
        "wrap": btf.wrap,
        "licence": btf.licence,
        "source": dict(btf.provenance),
        "history": list(btf.history),
        **({SAID_BY_TEXTURES: True} if _said_by_textures(btf) else {}),
    }


def create(where: str, btf: BTF, *, dtype: str, run: int) -> None:
    """Begin a store: its group and arrays, and all that is no image written already.

    Args:
        where: path or URL. dtype: of the textures. run: pairs a shard.
    """
    group = zarr.open_group(where, mode="w", zarr_format=3, attributes=attributes_of(btf))
    for name, images in images_of(btf).items():
        group.create_array(
            name,
            shape=images.shape,
            chunks=(1, *images.shape[1:]),
            shards=(run, *images.shape[1:]),
            # Shares of a footprint need no more than half.
            dtype={"texture": dtype, "coverage": "float16"}.get(name, "float32"),
            compressors=_codecs(),
            fill_value=float("nan"),
            # By its own name: an axis of another length is another one.
            dimension_names=(*IMAGE_AXES[:3], "share" if name == "coverage" else IMAGE_AXES[3]),
            config={"write_empty_chunks": True},
        )
    small: dict[str, tuple[Any, tuple[str, ...]]] = {
        name: (getattr(btf, name), ("pair", "xyz"))
        for name in ("light", "view", "light_position", "view_position")
    }
    small["footprint"] = (btf.footprint, ("pair",))
    for name, (value, axes) in small.items():
        if value is not None:
            _put(group, name, np.asarray(value, np.float32), axes, value.shape)
    if _said_by_textures(btf):
        h, w = btf.shape[1:3]
        _empty(group, "validity", (len(btf), h, w), (run, h, w), IMAGE_AXES[:3])
    if btf.blurs is not None:
        axes = ("posed", "row", "column", "uu_uv_vv")
        _empty(group, "blur", btf.blurs.maps.shape, None, axes)
        _put(group, "blur_of", btf.blurs.of.astype(np.int32), ("pair",), btf.blurs.of.shape)
    if btf.validity is not None:
        validity: NDArray[np.bool_] = btf.validity
        first = "pair" if len(validity) == len(btf) else "any_pair"
        axes = (first, *IMAGE_AXES[1:3])
        _put(group, "validity", validity, axes, (1, *validity.shape[1:]))


def _said_by_textures(btf: BTF) -> bool:
    """Whether what is valid is known only once a texture was made."""
    return btf.coverage is not None and btf.validity is None


def _empty(
    group: zarr.Group,
    name: str,
    shape: tuple[int, ...],
    shards: tuple[int, ...] | None,
    axes: tuple[str, ...],
) -> None:
    """An array of a chunk a map, to be written later."""
    group.create_array(
        name,
        shape=shape,
        chunks=(1, *shape[1:]),
        shards=shards,
        dtype="bool" if name == "validity" else "float32",
        compressors=_codecs(),
        dimension_names=axes,
        config={"write_empty_chunks": True},
    )


def _put(
    group: zarr.Group,
    name: str,
    value: NDArray[Any],
    axes: tuple[str, ...],
    chunks: tuple[int, ...],
) -> None:
    group.create_array(
        name,
        data=value,
        chunks=chunks,
        compressors=_codecs(),
        dimension_names=axes,
        config={"write_empty_chunks": True},
    )


def _codecs() -> list[Any]:
    # zstd 3 with bit shuffle: 1.5 times smaller on measured textures, 2 ms a 256 x 256 one.
    return [BloscCodec(cname="zstd", clevel=3, shuffle="bitshuffle"), Crc32cCodec()]
