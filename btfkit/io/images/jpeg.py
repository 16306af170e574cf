"""The structure of a JPEG: its frame, what it declares, and where it ends."""

from __future__ import annotations

import re
import struct

from btfkit.errors import FormatError
from btfkit.io.images import exif, icc
from btfkit.io.images.header import Header
from btfkit.io.images.profiles import ADOBE_RGB, Declared

# Markers that start a frame (SOF0 to SOF15, not DHT, JPG, DAC), and those without a body.
FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
# Baseline, extended and progressive with Huffman codes; extended and progressive arithmetic.
_ARITHMETIC = 0xC9
_DECODED = {0xC0, 0xC1, 0xC2, 0xC9, 0xCA}
_BARE = {0x01, *range(0xD0, 0xD8)}
_SCAN, _END, _EXIF, _ICC = 0xDA, 0xD9, 0xE1, 0xE2
# Within coded data 0xFF is followed by 0, by a restart, or by the marker that ends them.
_MARKER = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]")
_MOST_SCANS = 100


def size(data: bytes) -> tuple[int, int]:
    """(h, w) of the frame. Raises ValueError or struct.error where there is none."""
    at = 2
    while True:
        marker, at = _next(data, at)
        if marker in FRAMES:
            h, w = struct.unpack_from(">HH", data, at + 3)
            return h, w
        at = _behind(data, marker, at)


def describe(name: str, data: bytes) -> Header:
    """What the segments say; what lies behind the end of the picture is left alone.

    Phones append films, cameras notes and further pictures: the picture before them is whole.

    Raises:
        FormatError: cut short, of a kind that is not decoded, or declaring what is not understood.
    """
    at, scans, frame = 2, 0, (0, 0, 0, 0)
    blocks: list[tuple[int, bytes]] = []
    try:
        while True:
            marker, at = _next(data, at)
            if marker == _END:
                break
            if marker in FRAMES:
                precision, h, w, components = struct.unpack_from(">BHHB", data, at + 2)
                frame = (h, w, components, precision)
                _check_kind(name, marker, precision, components)
                # Huffman's codes take a bit at least, of each 8 x 8 pixels; twice that is left for
                # components of odd shapes. Decoders fill what is missing with grey.
                if marker < _ARITHMETIC and h * w > 1024 * len(data):
                    raise ValueError("blocks without a code")
            elif marker in (_EXIF, _ICC):
                blocks.append((marker, data[at + 2 : _behind(data, marker, at)]))
            at = _behind(data, marker, at)
            if marker == _SCAN:
                scans += 1
                found = _MARKER.search(data, at)
                if found is None:
                    raise ValueError("no end")
                at = found.start()
            # Each scan of a progressive JPEG goes over the whole picture; encoders write ten.
            if scans > _MOST_SCANS:
                raise FormatError(name, f"the JPEG has more than {_MOST_SCANS} scans")
    except (struct.error, ValueError) as error:
        raise FormatError(name, "the image is cut short", remedy="copy it again") from error
    h, w, components, _ = frame
    meta = [block[6:] for marker, block in blocks if marker == _EXIF and block[:6] == b"Exif\0\0"]
    return Header(
        h, w, colours=1 if components == 1 else 3, bits=8,
        orientation=exif.orientation_of(meta[0]) if meta else 1,
        declared=_declared(name, blocks, meta, components), end=at,
        doubt="inks (CMYK) are mixed without a profile" if components == 4 else "",
    )  # fmt: skip


def _check_kind(name: str, marker: int, precision: int, components: int) -> None:
    if marker not in _DECODED:
        raise FormatError(
            name,
            f"the JPEG is lossless or hierarchical (SOF{marker - 0xC0})",
            remedy="save it as PNG or TIFF",
        )
    if precision != 8 or components not in (1, 3, 4):
        raise FormatError(
            name,
            f"the JPEG has {components} components of {precision} bits; expected 1, 3 or 4 of 8",
            remedy="save it as PNG or TIFF",
        )


def _declared(
    name: str, blocks: list[tuple[int, bytes]], meta: list[bytes], components: int
) -> Declared | None:
    parts = [
        block[12:] for kind, block in blocks if kind == _ICC and block[:12] == b"ICC_PROFILE\0"
    ]
    if parts:
        numbers = [tuple(part[:2]) for part in parts]
        if sorted(numbers) != [(i + 1, len(parts)) for i in range(len(parts))]:
            raise FormatError(
                name, "the ICC profile lacks a part", remedy="save it again with its profile"
            )
        profile = b"".join(part[2:] for part in sorted(parts))
        return icc.parse(name, profile, colours=components)
    return ADOBE_RGB if meta and exif.is_adobe_rgb(meta[0]) else None


def _next(data: bytes, at: int) -> tuple[int, int]:
    """The next marker from `at` on, and where its body starts; bytes that are none are padding."""
    at = data.index(b"\xff", at)
    (marker,) = struct.unpack_from("B", data, at + 1)
    while marker == 0xFF:
        at += 1
        (marker,) = struct.unpack_from("B", data, at + 1)
    return marker, at + 2


def _behind(data: bytes, marker: int, at: int) -> int:
    """Where the body that starts at `at` ends."""
    if marker in _BARE:
        return at
    (length,) = struct.unpack_from(">H", data, at)
    if length < 2:
        raise ValueError("no length")
    return int(at + length)
