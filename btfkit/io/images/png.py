"""The chunks of a PNG: all are checked, and what they declare of layout and colour is kept.

Source: PNG specification, third edition, 2025; cICP code points by ITU-T H.273.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator

import numpy as np

from btfkit import colour
from btfkit.errors import FormatError
from btfkit.io.images import exif, icc
from btfkit.io.images.header import Header
from btfkit.io.images.profiles import (
    BT709,
    D65,
    SRGB,
    Chromaticities,
    Curve,
    Declared,
    Floats,
    from_primaries,
    gamma,
)  # fmt: skip

MAGIC = b"\x89PNG\r\n\x1a\n"
# Colour type: colours once a palette is looked up, and whether alpha follows.
_TYPES = {0: (1, False), 2: (3, False), 3: (3, False), 4: (1, True), 6: (3, True)}
_CRITICAL = {b"IHDR", b"PLTE", b"IDAT", b"IEND"}
_KEPT = {b"IHDR", b"cICP", b"iCCP", b"sRGB", b"gAMA", b"cHRM", b"eXIf", b"acTL", b"tRNS"}
_MOST_PROFILE = 1 << 24
# H.273 table 2. 5 and 6 are those of 525 and 625 lines, 11 and 12 P3 under DCI white and D65.
_PRIMARIES: dict[int, Chromaticities] = {
    1: BT709,
    5: (0.64, 0.33, 0.29, 0.60, 0.15, 0.06, *D65),
    6: (0.63, 0.34, 0.31, 0.595, 0.155, 0.07, *D65),
    9: (0.708, 0.292, 0.17, 0.797, 0.131, 0.046, *D65),
    11: (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.314, 0.351),
    12: (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, *D65),
}


def size(data: bytes) -> tuple[int, int]:
    """(h, w). Raises struct.error where it is cut."""
    w, h = struct.unpack_from(">II", data, 16)
    return h, w


def describe(name: str, data: bytes) -> Header:
    """What the chunks say.

    Raises:
        FormatError: cut, damaged, animated, or declaring what is not understood.
    """
    kept: dict[bytes, bytes] = {}
    for kind, body in _chunks(name, data):
        if kind in _KEPT:
            kept.setdefault(kind, body)
        elif kind not in _CRITICAL and not kind[0] & 32:
            raise FormatError(
                name, f"the PNG needs chunk {kind!r} to be understood", remedy="save it again"
            )
    try:
        w, h, bits, sort = struct.unpack_from(">IIBB", kept[b"IHDR"])
        colours, alpha = _TYPES[sort]
        frames = struct.unpack_from(">I", kept[b"acTL"])[0] if b"acTL" in kept else 1
        declared = _declared(name, kept, colours)
    except (struct.error, KeyError, ValueError) as error:
        raise FormatError(
            name, "not a readable image: the header is damaged", remedy="copy it again"
        ) from error
    if frames > 1:
        raise FormatError(
            name, f"the PNG is animated, of {frames} pictures; expected one", remedy="split it"
        )
    return Header(
        h, w, colours=colours, bits=16 if bits == 16 else 8, alpha=alpha or b"tRNS" in kept,
        orientation=exif.orientation_of(kept.get(b"eXIf", b"")), declared=declared,
    )  # fmt: skip


def _chunks(name: str, data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Kinds and bodies, pixels left out; each is checked by its CRC."""
    at, kind = len(MAGIC), b""
    while kind != b"IEND":
        length = int.from_bytes(data[at : at + 4], "big")
        kind = data[at + 4 : at + 8]
        end = at + 8 + length
        if end + 4 > len(data):
            raise FormatError(name, "the image is cut short", remedy="copy it again")
        if zlib.crc32(memoryview(data)[at + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            raise FormatError(name, f"chunk {kind!r} of the PNG is damaged", remedy="copy it again")
        yield kind, b"" if kind == b"IDAT" else data[at + 8 : end]
        at = end + 4


def _declared(name: str, kept: dict[bytes, bytes], colours: int) -> Declared | None:
    """The most binding of the chunks that speak of colour: cICP, iCCP, sRGB, gAMA and cHRM."""
    if b"cICP" in kept:
        return _coded(name, *struct.unpack_from("4B", kept[b"cICP"]))
    if b"iCCP" in kept:
        _, ended, profile = kept[b"iCCP"].partition(b"\0")
        if not ended:
            raise ValueError("no name of a profile")
        unpacker = zlib.decompressobj()
        try:
            whole = unpacker.decompress(profile[1:], _MOST_PROFILE)
        except zlib.error as error:
            raise FormatError(name, "its ICC profile is damaged", remedy="save it again") from error
        return icc.parse(name, whole, colours=colours)
    if b"sRGB" in kept:
        return SRGB
    exponent = struct.unpack_from(">I", kept[b"gAMA"])[0] / 1e5 if b"gAMA" in kept else None
    if exponent is not None and not 0.05 <= exponent <= 20:
        raise ValueError("no gamma")
    curves = None if exponent is None else (gamma(1 / exponent),)
    said = "" if exponent is None else f"gamma {1 / exponent:.4g}"
    if b"cHRM" not in kept:
        return None if curves is None else Declared(f"PNG {said}", curves)
    wx, wy, *rgb = (value / 1e5 for value in struct.unpack_from(">8I", kept[b"cHRM"]))
    matrix = from_primaries((*rgb, wx, wy)) if colours == 3 else None
    return Declared(f"PNG chromaticities {said}".rstrip(), curves, matrix)


def _coded(name: str, primaries: int, transfer: int, matrix: int, full: int) -> Declared:
    """Coding-independent code points."""
    transfers: dict[int, Curve] = {
        1: _from_bt709, 4: gamma(2.2), 5: gamma(2.8), 6: _from_bt709, 8: gamma(1.0),
        13: colour.from_srgb, 14: _from_bt709, 15: _from_bt709,
    }  # fmt: skip
    if primaries not in _PRIMARIES or transfer not in transfers or matrix != 0 or full != 1:
        raise FormatError(
            name,
            f"declares colour by code points {primaries}, {transfer}, {matrix}, {full} (cICP); "
            f"expected primaries {', '.join(map(str, _PRIMARIES))}, transfer "
            f"{', '.join(map(str, transfers))}, matrix 0, full range",
            remedy="convert it to sRGB or linear",
        )
    return Declared(
        f"PNG code points {primaries}, {transfer}",
        (transfers[transfer],),
        from_primaries(_PRIMARIES[primaries]),
    )


def _from_bt709(encoded: Floats) -> Floats:
    """Linear values of BT.709's camera curve, inverted. Source: ITU-R BT.709-6, item 1.2."""
    power = (np.maximum(encoded, 0.081) + 0.099) / 1.099
    return np.where(encoded < 0.081, encoded / 4.5, power ** (1 / 0.45))
