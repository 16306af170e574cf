"""One image: bytes in, (h, w, c) float32 linear values out, row 0 on top, RGB."""

from __future__ import annotations

import os
import re
import struct
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit import colour
from btfkit.errors import FormatError

Array = NDArray[np.float32]
SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".exr", ".hdr", ".bmp"}
# A side that long, or that many values, is a damaged header.
_MOST_SIDE, _MOST_VALUES = 1 << 16, 1 << 30


def is_image(name: str) -> bool:
    """Whether a name ends like an image that can be read."""
    return PurePosixPath(name).suffix.lower() in SUFFIXES


def read(name: str, data: bytes, *, transfer: str) -> Array:
    """Decode one image.

    Args:
        name: for messages, and for its suffix.
        data: the bytes of the file.
        transfer: what integer code values mean: srgb, linear or an exponent; EXR and HDR
            are linear.

    Returns:
        (h, w, c) linear float32; c is 1 or 3 (alpha is left out), or what an EXR has.

    Raises:
        FormatError: not an image, damaged, or absurdly large.
    """
    suffix = PurePosixPath(name).suffix.lower()
    if suffix == ".exr":
        return read_exr(name, data)[0]
    if suffix == ".hdr" or data[:2] == b"#?":
        return read_hdr(name, data)
    return _read_codes(name, data, transfer)


def _read_codes(name: str, data: bytes, transfer: str) -> Array:
    import cv2

    _check_size(name, *size_of(name, data))
    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR
    try:
        codes = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise FormatError(name, f"not a readable image ({error})") from error
    if codes is None:
        raise FormatError(name, "not a readable image", remedy="copy it again")
    for magic, ending in ((b"\xff\xd8", b"\xff\xd9"), (b"\x89PNG", b"IEND")):
        # Decoders fill what a cut file lacks with grey and say nothing.
        if data.startswith(magic) and ending not in data[-4096:]:
            raise FormatError(name, "the image is cut short", remedy="copy it again")
    if codes.ndim == 2:
        codes = codes[..., None]
    if codes.shape[2] == 3:
        codes = codes[..., ::-1]
    if codes.dtype in (np.uint8, np.uint16):
        return colour.table(transfer, codes.itemsize * 8)[codes]
    if codes.dtype == np.float32:
        return np.ascontiguousarray(codes)
    raise FormatError(name, f"pixels are {codes.dtype}; expected 8 or 16 bit, or float32")


def size_of(name: str, data: bytes) -> tuple[int, int]:
    """(h, w) that the header of a PNG, JPEG, TIFF or BMP declares; nothing is decoded."""
    from io import BytesIO

    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(BytesIO(data)) as image:
            return image.height, image.width
    except Image.DecompressionBombError as error:
        raise FormatError(name, f"declares too many pixels ({error})") from error
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError, struct.error) as error:
        raise FormatError(
            name, f"not a readable image ({error})", remedy="copy it again"
        ) from error


def _check_size(name: str, h: int, w: int, channels: int = 3) -> None:
    if not (0 < h <= _MOST_SIDE and 0 < w <= _MOST_SIDE) or h * w * channels > _MOST_VALUES:
        raise FormatError(name, f"declares {h} x {w} x {channels} values")


def read_exr(name: str, data: bytes) -> tuple[Array, tuple[str, ...], dict[str, Any]]:
    """An EXR: (h, w, c) float32, channel names (R, G, B first), and its attributes.

    Raises:
        FormatError: not an EXR, damaged, or absurdly large.
    """
    import OpenImageIO as oiio

    if data[:4] != b"v/1\x01":
        raise FormatError(name, "not an EXR: the magic number is missing")
    # OpenImageIO's Python face opens names only.
    with tempfile.NamedTemporaryFile(suffix=".exr") as file:
        file.write(data)
        file.flush()
        source = oiio.ImageInput.open(file.name)
        if source is None:
            raise FormatError(name, f"the EXR cannot be opened ({oiio.geterror()})")
        try:
            spec = source.spec()
            _check_size(name, spec.height, spec.width, spec.nchannels)
            pixels = source.read_image(oiio.FLOAT)
            fault = source.geterror()
        finally:
            source.close()
    if pixels is None or fault:
        raise FormatError(name, f"the EXR cannot be decoded ({fault})", remedy="copy it again")
    names = tuple(spec.channelnames)
    order = sorted(range(len(names)), key=lambda i: (_RGB.get(names[i], 3), i))
    values = np.asarray(pixels, np.float32).reshape(spec.height, spec.width, -1)[..., order]
    attributes = {attribute.name: attribute.value for attribute in spec.extra_attribs}
    return np.ascontiguousarray(values), tuple(names[i] for i in order), attributes


_RGB = {"R": 0, "G": 1, "B": 2}
_RESOLUTION = re.compile(rb"([-+])([XY]) +(\d+) +([-+])([XY]) +(\d+)")


def read_hdr(name: str, data: bytes, *, orientation: str = "standard") -> Array:
    """A Radiance picture (RGBE) in any of the eight orientations its resolution line can say.

    Args:
        name: for messages.
        data: the bytes of the file.
        orientation: "standard" follows the resolution line; "btf_extractor" takes the values as
            rows from the bottom up whatever the line says, as that reader of ATRIUM does.

    Returns:
        (h, w, 3) linear float32, row 0 on top.

    Raises:
        FormatError: not a Radiance picture, damaged, or absurdly large.
    """
    blank = data.find(b"\n\n")
    end = data.find(b"\n", blank + 2)
    match = _RESOLUTION.fullmatch(data[blank + 2 : end].strip()) if 0 <= blank < end else None
    if data[:2] != b"#?" or match is None:
        raise FormatError(name, "not a Radiance picture: no resolution line after the header")
    if b"FORMAT=32-bit_rle_xyze" in data[:blank]:
        raise FormatError(name, "the Radiance picture holds XYZ; expected RGB")
    first_sign, first, count, second_sign, second, length = match.groups()
    scanlines, pixels = int(count), int(length)
    if first == second:
        raise FormatError(name, f"resolution line {match[0].decode()!r} names one axis twice")
    _check_size(name, scanlines, pixels)
    rgbe = _scanlines(name, data, end + 1, scanlines, pixels)
    # Ward: the value of a mantissa m with exponent e is (m + 0.5) 2^(e - 136), black where e = 0.
    exponent = rgbe[..., 3].astype(np.int32)
    scale = np.where(exponent > 0, np.ldexp(np.float32(1), exponent - 136), np.float32(0))
    image = (rgbe[..., :3] + np.float32(0.5)) * scale[..., None]
    if orientation == "btf_extractor":
        return np.ascontiguousarray(image[::-1], np.float32)
    if orientation != "standard":
        raise ValueError(f"orientation {orientation!r}; expected standard or btf_extractor")
    # -Y runs down the rows, +X along the columns; the first axis counts scanlines.
    if (first_sign == b"-") == (first == b"X"):
        image = image[::-1]
    if (second_sign == b"-") == (second == b"X"):
        image = image[:, ::-1]
    if first == b"X":
        image = image.transpose(1, 0, 2)
    return np.ascontiguousarray(image, np.float32)


def _scanlines(name: str, data: bytes, at: int, count: int, length: int) -> NDArray[np.uint8]:
    """(count, length, 4) RGBE of flat or new-style run-length encoded scanlines."""
    flat = 4 * count * length
    if data[at : at + 2] != b"\x02\x02" or not 8 <= length < 32768:
        if len(data) - at < flat:
            raise FormatError(name, f"{len(data) - at} bytes of pixels; expected {flat}")
        return np.frombuffer(data, np.uint8, flat, at).reshape(count, length, 4)
    if len(data) - at < 4 * count:
        raise FormatError(name, f"cut short: {len(data) - at} bytes for {count} scanlines")
    out = np.empty((count, 4, length), np.uint8)
    for line in range(count):
        if data[at : at + 2] != b"\x02\x02" or data[at + 2] << 8 | data[at + 3] != length:
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


def encode_jpeg(linear: Array, *, quality: int = 100) -> bytes:
    """8-bit sRGB JPEG bytes of a linear (h, w, 1 or 3) picture, full chroma resolution."""
    import cv2

    codes = _codes(linear)
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x111111]
    return _encoded(cv2.imencode(".jpg", codes, options))


def encode_png(linear: Array) -> bytes:
    """8-bit sRGB PNG bytes of a linear (h, w, 1 or 3) picture."""
    import cv2

    return _encoded(cv2.imencode(".png", _codes(linear)))


def _codes(linear: Array) -> NDArray[np.uint8]:
    codes = np.rint(255 * colour.to_srgb(np.clip(np.nan_to_num(linear), 0, 1))).astype(np.uint8)
    return np.ascontiguousarray(codes[..., ::-1])


def _encoded(result: tuple[bool, NDArray[np.uint8]]) -> bytes:
    done, data = result
    if not done:
        raise ValueError("the picture cannot be encoded")
    return data.tobytes()


def write_exr(
    path: str | os.PathLike[str],
    values: NDArray[Any],
    channels: Sequence[str],
    attributes: Mapping[str, Any] | None = None,
) -> None:
    """Write (h, w, c) as an EXR, half or float32 by the dtype of `values`, compressed losslessly.

    Raises:
        OSError: the file cannot be written.
    """
    import OpenImageIO as oiio

    half = values.dtype == np.float16
    h, w, c = values.shape
    spec = oiio.ImageSpec(w, h, c, oiio.HALF if half else oiio.FLOAT)
    spec.channelnames = tuple(channels)
    spec.attribute("compression", "zip")
    for key, value in (attributes or {}).items():
        spec.attribute(key, value)
    out = oiio.ImageOutput.create(os.fspath(path))
    if out is None or not out.open(os.fspath(path), spec):
        raise OSError(f"{os.fspath(path)}: cannot be written ({oiio.geterror()})")
    done = out.write_image(np.ascontiguousarray(values))
    fault = out.geterror()
    # Closing writes the line offsets: a full disk shows here at the latest.
    if not (out.close() and done):
        raise OSError(f"{os.fspath(path)}: cannot be written ({fault or oiio.geterror()})")
