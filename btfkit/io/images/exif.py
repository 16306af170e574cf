"""What an EXIF block says of a picture: how it lies, and in which colour space it was written."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

_ORIENTATION, _EXIF, _INTEROP, _COLOUR_SPACE, _INTEROP_INDEX = 274, 0x8769, 0xA005, 0xA001, 1
_MOST_ENTRIES = 4096


def orientation_of(block: bytes) -> int:
    """EXIF orientation, 1 to 8, of a block that starts with its byte order; 1 where it is silent.

    A damaged block says nothing: cameras and editors leave many.
    """
    value = _first_directory(block).get(_ORIENTATION, 1)
    return value if value in range(1, 9) else 1


def is_adobe_rgb(block: bytes) -> bool:
    """Whether a block says Adobe RGB (1998), as DCF's option files do: uncalibrated, index R03."""
    order = _order(block)
    within = _directory(block, order, _first_directory(block).get(_EXIF, 0))
    interop = _directory(block, order, within.get(_INTEROP, 0))
    index = struct.pack((order or "<") + "I", interop.get(_INTEROP_INDEX, 0))
    return within.get(_COLOUR_SPACE) == 0xFFFF and index[:3] == b"R03"


def upright(pixels: NDArray[Any], orientation: int) -> NDArray[Any]:
    """(h, w, ...) stored pixels as they are to be seen, row 0 on top.

    Source: EXIF 2.3, tag 0112H: where the first row and column of the stored data belong.
    """
    if orientation >= 5:
        pixels = np.swapaxes(pixels, 0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return pixels


def _order(block: bytes) -> str | None:
    return {b"II": "<", b"MM": ">"}.get(block[:2])


def _first_directory(block: bytes) -> dict[int, int]:
    order = _order(block)
    if order is None or len(block) < 8:
        return {}
    return _directory(block, order, struct.unpack_from(order + "I", block, 4)[0])


def _directory(block: bytes, order: str | None, at: int) -> dict[int, int]:
    """Entries of one directory: SHORTs as they are, anything else as its four bytes."""
    entries: dict[int, int] = {}
    if order is None or at < 8:
        return entries
    try:
        (count,) = struct.unpack_from(order + "H", block, at)
        for i in range(min(count, _MOST_ENTRIES)):
            tag, kind = struct.unpack_from(order + "HH", block, at + 2 + 12 * i)
            form = "H" if kind == 3 else "I"
            entries[tag] = struct.unpack_from(order + form, block, at + 10 + 12 * i)[0]
    except struct.error:
        pass
    return entries
