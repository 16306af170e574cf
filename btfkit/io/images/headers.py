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


# What else lies under names of pictures: where its first bytes are, which, what it is, what to do.
_CONVERT = "save it as PNG or TIFF"
_FETCH = "fetch the picture itself"
_OTHERS: tuple[tuple[int, tuple[bytes, ...], str, str], ...] = (
    (8, (b"WEBP",), "a WebP picture", _CONVERT),
    (0, (b"GIF8",), "a GIF", _CONVERT),
    (8, (b"heic", b"heix", b"hevc", b"mif1", b"msf1"), "a HEIF picture", _CONVERT),
    (8, (b"avif", b"avis"), "an AVIF picture", _CONVERT),
    (8, (b"crx ",), "a camera's RAW file (CR3)", "develop it to a linear 16-bit TIFF"),
    (0, (b"FUJIFILM", b"\0MRM", b"FOVb"), "a camera's RAW file", "develop it to a linear TIFF"),
    (0, (b"\0\0\0\x0cjP  ", b"\xff\x4f\xff\x51"), "a JPEG 2000 picture", _CONVERT),
    (0, (b"\0\0\0\x0cJXL ", b"\xff\x0a"), "a JPEG XL picture", _CONVERT),
    (0, (b"8BPS",), "a Photoshop document", _CONVERT),
    (0, (b"DDS ",), "a DDS texture", _CONVERT),
    (0, (b"P1\n", b"P2\n", b"P3\n", b"P4\n", b"P5\n", b"P6\n"), "a Netpbm picture", _CONVERT),
    (0, (b"\x76\x2f\x31\x01",), "an OpenEXR picture", "let its name end in .exr"),
    (0, (b"#?RADIANCE", b"#?RGBE"), "a Radiance picture", "let its name end in .hdr"),
    (0, (b"PK\x03\x04", b"\x1f\x8b", b"7z\xbc\xaf", b"Rar!"), "an archive", "unpack it"),
    (0, (b"version https://git-lfs",), "a pointer of Git LFS", _FETCH + " (git lfs pull)"),
    (0, (b"/annex/objects/",), "a pointer of git-annex", _FETCH + " (git annex get)"),
    (0, (b"<!doctype html", b"<html"), "a web page", _FETCH),
    (0, (b"\0\5\x16\7",), "an AppleDouble companion", "remove it; the picture is elsewhere"),
)  # fmt: skip


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
    if not data.strip(b"\0"):
        what = f"holds nothing but {len(data)} zeros" if data else "is empty"
        raise FormatError(name, f"not a readable image: the file {what}", remedy="copy it again")
    for start, magics, what, remedy in _OTHERS:
        if data[start : start + 24].lower().startswith(tuple(magic.lower() for magic in magics)):
            raise FormatError(
                name, f"not a readable image: {what}, not PNG, JPEG, BMP or TIFF", remedy=remedy
            )
    raise FormatError(
        name, "not a readable image: neither PNG, JPEG, BMP nor TIFF", remedy="copy it again"
    )
