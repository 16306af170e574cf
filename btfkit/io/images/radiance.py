"""Radiance pictures (RGBE), in each of the eight orientations that their header can say."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from btfkit.errors import FormatError
from btfkit.io.images.image import Array, Image
from btfkit.io.images.profiles import Chromaticities, Declared, from_primaries

# A side that long, or that many values, is a damaged header.
_MOST_SIDE, _MOST_VALUES = 1 << 16, 1 << 30
# Beyond so many values a picture has to bring some bytes: the best codes shrink noise-free areas
# a thousand times, photographs thirty times.
_FREE_VALUES, _VALUES_PER_BYTE = 1 << 28, 200
_RESOLUTION = re.compile(rb"([-+])([XY]) +(\d+) +([-+])([XY]) +(\d+)")


def read(name: str, data: bytes, *, orientation: str = "standard") -> Array:
    """The colours of a Radiance picture, as `decode` gives them."""
    return decode(name, data, orientation=orientation).linear


def decode(name: str, data: bytes, *, orientation: str = "standard") -> Image:
    """A Radiance picture (RGBE) in any of the eight orientations its resolution line can say.

    Args:
        name: for messages.
        data: the bytes of the file.
        orientation: "standard" follows the resolution line; "btf_extractor" takes the values as
            rows from the bottom up whatever the line says, as that reader of ATRIUM does.

    Returns:
        The picture, (h, w, 3), row 0 on top; EXPOSURE and COLORCORR are divided out, PRIMARIES
        converted.

    Raises:
        FormatError: not a Radiance picture, damaged, or absurdly large.
    """
    blank = data.find(b"\n\n")
    end = data.find(b"\n", blank + 2)
    match = _RESOLUTION.fullmatch(data[blank + 2 : end].strip()) if 0 <= blank < end else None
    if data[:2] != b"#?" or match is None:
        raise FormatError(name, "not a Radiance picture: no resolution line after the header")
    if b"FORMAT=32-bit_rle_xyze" in data[:blank]:
        raise FormatError(
            name, "the Radiance picture holds XYZ; expected RGB", remedy="convert it: ra_xyze -r"
        )
    first_sign, first, count, second_sign, second, length = match.groups()
    scanlines, pixels = int(count), int(length)
    gains = _gains(name, data[:blank])
    declared = _declared(name, data[:blank])
    if first == second:
        raise FormatError(name, f"resolution line {match[0].decode()!r} names one axis twice")
    check_size(name, scanlines, pixels)
    rgbe = _scanlines(name, data, end + 1, scanlines, pixels)
    # Ward: the value of a mantissa m with exponent e is (m + 0.5) 2^(e - 136), black where e = 0.
    exponent = rgbe[..., 3].astype(np.int32)
    scale = np.where(exponent > 0, np.ldexp(np.float32(1), exponent - 136), np.float32(0))
    image = np.asarray(
        (rgbe[..., :3] + np.float32(0.5)) * scale[..., None] / gains.astype(np.float32), np.float32
    )
    if declared is not None:
        image = np.asarray(declared.converted(image), np.float32)
    depth = np.dtype(np.float32)
    if orientation == "btf_extractor":
        return Image(np.ascontiguousarray(image[::-1], np.float32), None, depth, declared)
    if orientation != "standard":
        raise ValueError(f"orientation {orientation!r}; expected standard or btf_extractor")
    # -Y runs down the rows, +X along the columns; the first axis counts scanlines.
    if (first_sign == b"-") == (first == b"X"):
        image = image[::-1]
    if (second_sign == b"-") == (second == b"X"):
        image = image[:, ::-1]
    if first == b"X":
        image = image.transpose(1, 0, 2)
    return Image(np.ascontiguousarray(image, np.float32), None, depth, declared)


def _gains(name: str, header: bytes) -> NDArray[np.float64]:
    """(3,) by what values were multiplied when written: all EXPOSUREs and COLORCORRs together."""
    total = np.ones(3)
    for key, count in ((b"EXPOSURE", 1), (b"COLORCORR", 3)):
        for line in _lines(header, key):
            numbers = _numbers(line)
            total = total * (numbers if len(numbers) == count else 0.0)
        if not ((total > 1e-20) & (total < 1e20)).all():
            said = "is no positive number" if count == 1 else "is not three positive numbers"
            raise FormatError(name, f"the {key.decode()} of the Radiance picture {said}")
    return total


def _declared(name: str, header: bytes) -> Declared | None:
    """The primaries of the last PRIMARIES line, that of the last program that touched it."""
    lines = _lines(header, b"PRIMARIES")
    if not lines:
        return None
    values = tuple(_numbers(lines[-1]).tolist())
    try:
        if len(values) != 8:
            raise ValueError("not eight")
        chromaticities: Chromaticities = values
        matrix = from_primaries(chromaticities)
        return Declared("Radiance PRIMARIES", None, matrix, chromaticities=chromaticities)
    except ValueError as error:
        raise FormatError(
            name, f"PRIMARIES {lines[-1][:80].decode('latin-1')!r} are none; expected x and y of "
            "red, green, blue and white", remedy="take the line out",
        ) from error  # fmt: skip


def _lines(header: bytes, key: bytes) -> list[bytes]:
    """What stands behind a key, in all lines that have it."""
    return re.findall(rb"^" + key + rb"[ \t]*=(.*)$", header, re.MULTILINE)


def _numbers(line: bytes) -> NDArray[np.float64]:
    """The numbers of a line; none where one is no number."""
    try:
        return np.array([float(word) for word in line.split()])
    except ValueError:
        return np.empty(0)


def _scanlines(name: str, data: bytes, at: int, count: int, length: int) -> NDArray[np.uint8]:
    """(count, length, 4) RGBE of flat or new-style run-length encoded scanlines."""
    flat = 4 * count * length
    if data[at : at + 2] != b"\x02\x02" or not 8 <= length < 32768:
        if len(data) - at < flat:
            raise FormatError(
                name,
                f"{len(data) - at} bytes of flat pixels; expected {flat}",
                remedy="copy it again, or write it anew if its run-length code is that of 1991",
            )
        return np.frombuffer(data, np.uint8, flat, at).reshape(count, length, 4)
    if len(data) - at < 4 * count:
        raise FormatError(name, f"cut short: {len(data) - at} bytes for {count} scanlines")
    start = b"\x02\x02" + length.to_bytes(2, "big")
    out = np.empty((count, 4, length), np.uint8)
    for line in range(count):
        if data[at : at + 4] != start:
            raise FormatError(name, f"scanline {line} does not start with its length {length}")
        at += 4
        for channel in range(4):
            at = _runs(name, data, at, out[line, channel])
    return out.transpose(0, 2, 1)


def _runs(name: str, data: bytes, at: int, out: NDArray[np.uint8]) -> int:
    """Fill one channel of a scanline from runs; returns where the next begins."""
    filled = 0
    while filled < len(out):
        if at >= len(data):
            raise FormatError(name, "the run-length code is cut short")
        code = data[at]
        size = code - 128 if code > 128 else code
        needed = 2 if code > 128 else 1 + size
        if size == 0 or filled + size > len(out) or at + needed > len(data):
            raise FormatError(name, f"the run-length code is damaged at byte {at}")
        if code > 128:
            out[filled : filled + size] = data[at + 1]
        else:
            out[filled : filled + size] = np.frombuffer(data, np.uint8, size, at + 1)
        filled += size
        at += needed
    return at


def check_size(name: str, h: int, w: int, channels: int = 3, *, coded: int | None = None) -> None:
    """Refuse a size that only a damaged or hostile header declares.

    Args:
        name: for messages.
        h, w, channels: what the header declares.
        coded: bytes of the file; None where they need not be few.

    Raises:
        FormatError: no such picture.
    """
    values = h * w * channels
    if coded is not None and values > max(_FREE_VALUES, _VALUES_PER_BYTE * coded):
        raise FormatError(name, f"declares {h} x {w} x {channels} values in {coded} bytes")
    if not (0 < h <= _MOST_SIDE and 0 < w <= _MOST_SIDE) or values > _MOST_VALUES:
        raise FormatError(name, f"declares {h} x {w} x {channels} values")
