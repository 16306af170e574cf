"""The body of Bonn's binary `.btf`: factors of all images, of channels or of views, or values.

Nothing is copied: arrays are views of the file. Byte layout and sources: docs/formats-bonn.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.errors import FormatError
from btfkit.io.bonn import header as bonn_header
from btfkit.io.bonn.colour import NAMES
from btfkit.io.bonn.header import Bytes, Cursor, Directions, Magic, Meta

Floats = NDArray[np.floating]


@final
@dataclass(frozen=True, eq=False)
class Factors:
    """One factorisation: value = left[image row] . right[texel row].

    Attributes:
        left: (images * left_channels, k), a row an image and channel.
        right: (texels * right_channels, k); channels are fastest, then x, then y.
        left_channels, right_channels: the channels are on one side; the other has 1.
        mean: what is added: (images * left_channels,) or (texels * right_channels,), or None.
    """

    left: Floats
    right: Floats
    left_channels: int = 1
    right_channels: int = 1
    mean: Floats | None = None


@final
@dataclass(frozen=True, eq=False)
class Chunks:
    """Values texel by texel, some scan lines a chunk.

    Attributes:
        data: bytes of each chunk.
        rows: scan lines a chunk.
        compression: 0 none, 1 bzip2, 2 only the texels of the mask.
        mask: (h, w) bool.
    """

    data: tuple[Bytes, ...]
    rows: int
    compression: int
    mask: NDArray[np.bool_]


@final
@dataclass(frozen=True, eq=False)
class Layout:
    """A whole file, parsed.

    Attributes:
        kind: "fmf0", "fmf1", "dfmf", "pvf" or "bdi".
        factors: one, one a channel (dfmf) or one a view (pvf).
        log: whether values are exp(product) - 1e-5.
        heights: (hh, hw) height map of fmf1, or None.
        colour_model: code of dfmf, with its mean (3,) and transform (3, 3).
        chunks: of bdi.
        end: bytes used.
    """

    kind: str
    meta: Meta
    directions: Directions
    width: int
    height: int
    rotations: NDArray[np.float32]
    factors: tuple[Factors, ...] = ()
    log: bool = False
    heights: NDArray[np.float32] | None = None
    colour_model: int = 0
    colour_mean: tuple[float, ...] = (0.0, 0.0, 0.0)
    colour_transform: tuple[tuple[float, ...], ...] = ()
    chunks: Chunks | None = None
    end: int = 0

    @property
    def pairs(self) -> int:
        return int(np.prod(self.directions.light.shape[:2]))


def parse(path: Path, data: Bytes) -> Layout:
    """The layout of a file; where its first bytes can be read in two ways, the one that fits.

    Raises:
        FormatError: no magic, cut off, or sizes that contradict each other.
    """
    known = bonn_header.magics(data[: bonn_header.LONGEST].tobytes())
    if not known:
        raise FormatError(
            path,
            f"starts with {data[: bonn_header.LONGEST].tobytes()!r}; expected the magic of a "
            f"Bonn .btf, one of {', '.join(m.text.decode() for m in bonn_header.MAGICS)}",
        )
    found: list[Layout] = []
    failed: list[tuple[int, FormatError]] = []
    for floats in (9, 3):
        for magic in known:
            cursor = Cursor(path, data, len(magic.text))
            try:
                layout = _layout(cursor, magic, floats)
            except FormatError as error:
                failed.append((cursor.at, error))
                continue
            if layout.end == len(data):
                return layout
            found.append(layout)
    if found:
        return found[0]
    # Of several readings, the one that came furthest is the right one.
    raise max(failed, key=lambda entry: entry[0])[1]


def _layout(cursor: Cursor, magic: Magic, floats: int) -> Layout:
    none = np.zeros((0, 9), np.float32)
    if magic.kind == "pvf" and _legacy(cursor):
        cursor.take(8, "old header")
        width, height = bonn_header.read_size(cursor)
        slots = cursor.u32("number of views")
        directions = bonn_header.read_directions(cursor)
        head: dict[str, Any] = {
            "kind": "pvf", "meta": Meta(), "directions": directions,
            "width": width, "height": height, "rotations": none,
        }  # fmt: skip
        return _per_view(cursor, head, slots)
    meta = bonn_header.read_meta(cursor)
    directions = bonn_header.read_directions(cursor)
    width, height = bonn_header.read_size(cursor)
    head = {
        "kind": magic.kind, "meta": meta, "directions": directions,
        "width": width, "height": height,
    }  # fmt: skip
    if magic.kind == "bdi":
        return _values(cursor, head, floats)
    rotations = bonn_header.read_rotations(cursor, floats) if magic.rotations else none
    head["rotations"] = rotations
    if magic.kind == "pvf":
        cursor.u32("greatest number of components")
        return _per_view(cursor, head, cursor.u32("number of views"))
    if magic.kind == "dfmf":
        return _per_channel(cursor, head)
    return _whole(cursor, head)


def _legacy(cursor: Cursor) -> bool:
    start = cursor.at
    found = cursor.i32("size of the meta block")
    cursor.at = start
    return found == bonn_header.LEGACY


def _sizes(head: dict[str, Any]) -> tuple[int, int, int, int]:
    """(channels, lights, views, texels)."""
    views, lights = head["directions"].light.shape[:2]
    return len(head["meta"].channels), lights, views, head["width"] * head["height"]


def _whole(cursor: Cursor, head: dict[str, Any]) -> Layout:
    """FMF: one factorisation of all images."""
    log, heights = False, None
    if head["kind"] == "fmf1":
        version = cursor.u8("version of the FMF header")
        if version > 2:
            raise cursor.error(f"version {version} of the FMF header; expected 0 to 2")
        log = version >= 1 and cursor.u32("dynamic range reduction") != 0
        if version >= 2:
            wide, high = cursor.u32("width of the height map"), cursor.u32("its height")
            stored = cursor.array("<f2", (high, wide), f"height map of {wide} x {high}")
            heights = stored.astype(np.float32) if stored.size else None
    cursor.u32("greatest number of components")
    channels, lights, views, texels = _sizes(head)
    left, right = _matrices(cursor, "factors")
    images = lights * views
    if (len(left), len(right)) == (channels * images, texels):
        factors = Factors(left, right, left_channels=channels)
    elif (len(left), len(right)) == (channels * texels, images):
        factors = Factors(right, left, right_channels=channels)
    else:
        raise cursor.error(
            f"factors of {len(left)} x {len(right)} values; {channels} channels, {views} views, "
            f"{lights} lights and {texels} texels need {channels * images} x {texels} "
            f"or {channels * texels} x {images}"
        )
    return Layout(**head, factors=(factors,), log=log, heights=heights, end=cursor.at)


def _per_channel(cursor: Cursor, head: dict[str, Any]) -> Layout:
    """DFMF: one factorisation a channel, in a colour space that decorrelates them."""
    cursor.u32("greatest number of components")
    model = cursor.i32("colour model")
    if model not in NAMES:
        raise cursor.error(
            f"colour model {model}; known are {', '.join(f'{c} {n}' for c, n in NAMES.items())}",
            remedy="ask the publisher what it means",
        )
    mean = cursor.array("<f4", (3,), "colour mean").tolist()
    transform = cursor.array("<f4", (3, 3), "colour transform").tolist()
    channels, lights, views, texels = _sizes(head)
    if model in (1, 2, 3, 4, 9, 10, 11) and channels != 3:
        raise cursor.error(f"colour model {NAMES[model]} of {channels} channels; expected 3")
    factors = []
    for channel in range(channels):
        left, right = _matrices(cursor, f"factors of channel {channel}")
        if (len(left), len(right)) == (texels, lights * views) != (lights * views, texels):
            left, right = right, left
        if (len(left), len(right)) != (lights * views, texels):
            raise cursor.error(
                f"factors of channel {channel} of {len(left)} x {len(right)} values; {views} "
                f"views, {lights} lights and {texels} texels need {lights * views} x {texels}"
            )
        factors.append(Factors(left, right))
    return Layout(
        **head, factors=tuple(factors), colour_model=model, colour_mean=tuple(mean),
        colour_transform=tuple(map(tuple, transform)), end=cursor.at,
    )  # fmt: skip


def _per_view(cursor: Cursor, head: dict[str, Any], slots: int) -> Layout:
    """PVF: principal components of the images of each view."""
    channels, lights, views, texels = _sizes(head)
    if slots != views:
        raise cursor.error(f"{slots} factorisations for {views} views; expected one a view")
    factors = []
    for view in range(views):
        where = f"components of view {view}"
        dtype, count = _scalar(cursor, where)
        rows, dim = cursor.u32(where), cursor.u32(where)
        cursor.array(dtype, (count,), where)
        mean = cursor.array(dtype, (dim,), where)
        basis = cursor.array(dtype, (dim, count), where)
        weights = cursor.array(dtype, (rows, count), where)
        if (dim, rows) == (channels * lights, texels):
            factors.append(Factors(basis, weights, left_channels=channels, mean=mean))
        elif (dim, rows) == (channels * texels, lights):
            factors.append(Factors(weights, basis, right_channels=channels, mean=mean))
        else:
            raise cursor.error(
                f"{where} of {rows} x {dim} values; {channels} channels, {lights} lights and "
                f"{texels} texels need {texels} x {channels * lights} "
                f"or {lights} x {channels * texels}"
            )
    return Layout(**head, factors=tuple(factors), end=cursor.at)


def _values(cursor: Cursor, head: dict[str, Any], floats: int) -> Layout:
    """BDI: the values themselves."""
    rows = cursor.u32("scan lines a chunk")
    compression = cursor.u8("compression")
    if not rows or compression > 2:
        raise cursor.error(
            f"{rows} scan lines a chunk, compression {compression}; expected at least 1, and 0 to 2"
        )
    height, width = head["height"], head["width"]
    mask = cursor.array("u1", (height, width), f"mask of {width} x {height}") != 0
    rotations = bonn_header.read_rotations(cursor, floats)
    channels, lights, views, _ = _sizes(head)
    texel_bytes = 2 * channels * lights * views
    chunks = []
    for start in range(0, height, rows):
        where = f"chunk of scan line {start}"
        size = cursor.u32(where)
        inside = mask[start : start + rows]
        expected = texel_bytes * int(inside.sum() if compression == 2 else inside.size)
        if compression != 1 and size != expected:
            raise cursor.error(f"{where} has {size} bytes; expected {expected}")
        chunks.append(cursor.take(size, where))
    return Layout(
        **head, rotations=rotations, end=cursor.at,
        chunks=Chunks(tuple(chunks), rows, compression, mask),
    )  # fmt: skip


def _scalar(cursor: Cursor, where: str) -> tuple[str, int]:
    """dtype of the numbers that follow, and the number of components."""
    size, count = cursor.u8(where), cursor.u32(where)
    if size not in bonn_header.SCALARS:
        raise cursor.error(f"{where} of {size} bytes a number; expected 2, 4 or 8")
    if not count:
        raise cursor.error(f"{where} have no component; expected at least one")
    return bonn_header.SCALARS[size], count


def _matrices(cursor: Cursor, where: str) -> tuple[Floats, Floats]:
    """U (rows, k) and S x V (columns, k)."""
    dtype, count = _scalar(cursor, where)
    rows, columns = cursor.u32(where), cursor.u32(where)
    cursor.array(dtype, (count,), f"singular values of the {where}")
    left = cursor.array(dtype, (rows, count), where)
    return left, cursor.array(dtype, (columns, count), where)
