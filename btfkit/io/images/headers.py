"""What the header of a PNG, JPEG, BMP or TIFF declares, before anything is decoded."""

from __future__ import annotations

import struct
from types import ModuleType

from btfkit.errors import FormatError
from btfkit.io.images import bmp, jpeg, png, tiff
from btfkit.io.images.header import Header

_BY_MAGIC: dict[bytes, ModuleType] = {
    png.MAGIC: png,
    b"\xff\xd8": jpeg,
    b"BM": bmp,
    b"II": tiff,
    b"MM": tiff,
}


def size_of(name: str, data: bytes) -> tuple[int, int]:
    """(h, w) that a header declares.

    Raises:
        FormatError: none of the four formats, or cut before its size.
    """
    try:
        h, w = module_of(name, data).size(data)
    except (struct.error, ValueError, KeyError) as error:
        raise FormatError(
            name, "not a readable image: the header is damaged", remedy="copy it again"
        ) from error
    return h, w


def describe(name: str, data: bytes) -> Header:
    """All that a header declares.

    Raises:
        FormatError: damaged, or declaring what is not understood.
    """
    try:
        header: Header = module_of(name, data).describe(name, data)
    except (struct.error, ValueError, KeyError) as error:
        raise FormatError(
            name, "not a readable image: the header is damaged", remedy="copy it again"
        ) from error
    return header


def module_of(name: str, data: bytes) -> ModuleType:
    """The module that knows a format by its first bytes."""
    for magic, module in _BY_MAGIC.items():
        if data.startswith(magic):
            return module
    raise FormatError(
        name, "not a readable image: neither PNG, JPEG, BMP nor TIFF", remedy="copy it again"
    )
