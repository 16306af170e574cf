"""The header of a BMP, up to version 5 with its colour space.

Source: Microsoft, BITMAPV5HEADER.
"""

from __future__ import annotations

import struct

import numpy as np

from btfkit.errors import FormatError
from btfkit.io.images import icc
from btfkit.io.images.header import Header
from btfkit.io.images.profiles import SRGB, Declared

_CORE, _V4, _V5 = 12, 108, 124
_SRGB, _WINDOWS, _CALIBRATED, _EMBEDDED = b"BGRs", b" niW", b"\0\0\0\0", b"DEBM"


def size(data: bytes) -> tuple[int, int]:
    """(h, w). Raises struct.error where it is cut."""
    if struct.unpack_from("<I", data, 14)[0] == _CORE:
        w, h = struct.unpack_from("<HH", data, 18)
    else:
        w, h = struct.unpack_from("<ii", data, 18)
    # A negative height says that the rows run from the top.
    return abs(h), w


def describe(name: str, data: bytes) -> Header:
    """What the header says; the fourth byte of 32-bit pixels is no colour and is left out.

    Raises:
        FormatError: a colour space that is not understood, or pixels that lie in the header:
            decoders read those from wherever they please.
    """
    h, w = size(data)
    (pixels,), (length,) = struct.unpack_from("<I", data, 10), struct.unpack_from("<I", data, 14)
    least = 14 + length + _palette_bytes(data, length)
    if not least <= pixels < len(data):
        raise FormatError(
            name, f"pixels at byte {pixels} of {len(data)}; expected {least} or later",
            remedy="copy it again, or save it as PNG",
        )  # fmt: skip
    _check_indices(name, data, (h, w), pixels)
    return Header(h, w, colours=3, bits=8, declared=_declared(name, data))


def _check_indices(name: str, data: bytes, size: tuple[int, int], pixels: int) -> None:
    """Raise a FormatError where pixels name colours that the palette does not have.

    Decoders make of those what they please. Runs are not unpacked for it: beside them the palette
    has to be whole.
    """
    if struct.unpack_from("<I", data, 14)[0] == _CORE:
        return
    bits, coding = struct.unpack_from("<HI", data, 28)
    (used,) = struct.unpack_from("<I", data, 46)
    if bits not in (1, 4, 8) or not used or used >= 1 << bits:
        return
    most = (1 << bits) - 1
    if not coding:
        h, w = size
        stride = (w * bits + 31) // 32 * 4
        rows = np.frombuffer(data, np.uint8, offset=pixels)[: h * stride]
        rows = rows[: len(rows) // stride * stride].reshape(-1, stride)
        codes = np.unpackbits(rows, axis=1).reshape(len(rows), -1, bits)[:, :w]
        most = int(np.packbits(codes, axis=-1).max(initial=0)) >> (8 - bits)
    if most >= used:
        raise FormatError(
            name, f"a palette of {used} colours for pixels up to {most}",
            remedy="copy it again, or save it as PNG",
        )  # fmt: skip


def _palette_bytes(data: bytes, length: int) -> int:
    """Size of the colours that pixels of 8 bits or fewer stand for."""
    if length == _CORE:
        (bits,) = struct.unpack_from("<H", data, 24)
        return 3 << bits if bits <= 8 else 0
    (bits,), (used,) = struct.unpack_from("<H", data, 28), struct.unpack_from("<I", data, 46)
    return 4 * (used or 1 << bits) if bits <= 8 else 0


def _declared(name: str, data: bytes) -> Declared | None:
    length = struct.unpack_from("<I", data, 14)[0]
    if length < _V4:
        return None
    space = data[70:74]
    if space in (_SRGB, _WINDOWS):
        return SRGB
    if space == _CALIBRATED and not any(data[74:122]):
        return None
    if space == _EMBEDDED and length >= _V5:
        at, count = struct.unpack_from("<II", data, 126)
        return icc.parse(name, data[14 + at : 14 + at + count], colours=3)
    raise FormatError(
        name, f"declares colour space {space[::-1]!r}; expected sRGB or an embedded profile",
        remedy="save it as PNG",
    )  # fmt: skip
