"""The size that the header of a PNG, JPEG, BMP or TIFF declares, before anything is decoded."""

from __future__ import annotations

import struct

from btfkit.errors import FormatError

# JPEG markers that start a frame (SOF0 to SOF15, not DHT, JPG, DAC), and those without a body.
_FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
_BARE = {0x01, *range(0xD0, 0xD8)}
_TIFF_WIDTH, _TIFF_HEIGHT = 256, 257


def size_of(name: str, data: bytes) -> tuple[int, int]:
    """(h, w) that a header declares.

    Raises:
        FormatError: none of the four formats, or cut before its size.
    """
    readers = (
        (b"\x89PNG\r\n\x1a\n", _png),
        (b"\xff\xd8", _jpeg),
        (b"BM", _bmp),
        (b"II", _tiff),
        (b"MM", _tiff),
    )
    for magic, reader in readers:
        if data.startswith(magic):
            try:
                return reader(data)
            except (struct.error, ValueError, KeyError) as error:
                raise FormatError(
                    name, "not a readable image: the header is damaged", remedy="copy it again"
                ) from error
    raise FormatError(
        name, "not a readable image: neither PNG, JPEG, BMP nor TIFF", remedy="copy it again"
    )


def _png(data: bytes) -> tuple[int, int]:
    w, h = struct.unpack_from(">II", data, 16)
    return h, w


def _jpeg(data: bytes) -> tuple[int, int]:
    at = 2
    while True:
        fill, marker = struct.unpack_from("BB", data, at)
        if fill != 0xFF:
            raise ValueError("no marker")
        if marker == 0xFF:
            at += 1
        elif marker in _BARE:
            at += 2
        elif marker in _FRAMES:
            h, w = struct.unpack_from(">HH", data, at + 5)
            return h, w
        else:
            at += 2 + struct.unpack_from(">H", data, at + 2)[0]


def _bmp(data: bytes) -> tuple[int, int]:
    if struct.unpack_from("<I", data, 14)[0] == 12:
        w, h = struct.unpack_from("<HH", data, 18)
    else:
        w, h = struct.unpack_from("<ii", data, 18)
    # A negative height says that the rows run from the top.
    return abs(h), w


def _tiff(data: bytes) -> tuple[int, int]:
    order = "<" if data[:2] == b"II" else ">"
    magic = struct.unpack_from(order + "H", data, 2)[0]
    if magic == 42:
        (at,) = struct.unpack_from(order + "I", data, 4)
        (count,) = struct.unpack_from(order + "H", data, at)
        start, entry, value_at = at + 2, 12, 8
    elif magic == 43:
        (at,) = struct.unpack_from(order + "Q", data, 8)
        (count,) = struct.unpack_from(order + "Q", data, at)
        start, entry, value_at = at + 8, 20, 12
    else:
        raise ValueError("no TIFF")
    sizes: dict[int, int] = {}
    for i in range(min(count, 4096)):
        tag, kind = struct.unpack_from(order + "HH", data, start + entry * i)
        if tag in (_TIFF_WIDTH, _TIFF_HEIGHT):
            form = {3: "H", 4: "I", 16: "Q"}[kind]
            sizes[tag] = struct.unpack_from(order + form, data, start + entry * i + value_at)[0]
    return sizes[_TIFF_HEIGHT], sizes[_TIFF_WIDTH]
