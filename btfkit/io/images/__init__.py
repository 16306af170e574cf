"""One image: bytes in, (h, w, c) float32 linear values out, row 0 on top, RGB."""

from __future__ import annotations

import functools
import os
import tempfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from btfkit import colour
from btfkit.errors import FormatError
from btfkit.io.images import headers, radiance
from btfkit.io.images.radiance import check_size

Array = NDArray[np.float32]
T = TypeVar("T")
_MOST_SCANS = 100
SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".exr", ".hdr", ".bmp"}


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
        return radiance.read(name, data)
    return _read_codes(name, data, transfer)


def _read_codes(name: str, data: bytes, transfer: str) -> Array:
    check_size(name, *headers.size_of(name, data), coded=len(data))
    _check_whole(name, data)
    cv2 = _opencv()
    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR
    try:
        codes = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise FormatError(name, f"not a readable image ({error})") from error
    if codes is None:
        raise FormatError(name, "not a readable image", remedy="copy it again")
    if codes.ndim == 2:
        codes = codes[..., None]
    if codes.shape[2] == 3:
        codes = cv2.cvtColor(codes, cv2.COLOR_BGR2RGB)
    if codes.dtype == np.uint8:
        linear = cv2.LUT(np.ascontiguousarray(codes), colour.table(transfer, 8))
        return np.asarray(linear, np.float32).reshape(codes.shape)
    if codes.dtype == np.uint16:
        return _looked_up(codes, colour.table(transfer, 16))
    if codes.dtype == np.float32:
        return np.ascontiguousarray(codes)
    raise FormatError(name, f"pixels are {codes.dtype}; expected 8 or 16 bit, or float32")


@functools.cache
def _opencv() -> Any:
    """OpenCV, which writes no errors of its own beside ours."""
    import cv2

    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    return cv2


def _looked_up(codes: NDArray[np.uint16], table: Array) -> Array:
    """`table[codes]` row by row: numpy makes an index of eight bytes a value."""
    out = np.empty(codes.shape, np.float32)
    for row, line in zip(out, codes, strict=True):
        row[...] = table[line]
    return out


def _check_whole(name: str, data: bytes) -> None:
    """Refuse what decoders fill with grey or noise without a word: cut files, damaged chunks."""
    if data.startswith(b"\xff\xd8"):
        if b"\xff\xd9" not in data[-4096:]:
            raise FormatError(name, "the image is cut short", remedy="copy it again")
        # Each scan of a progressive JPEG goes over the whole picture; encoders write ten.
        if data.count(b"\xff\xda") > _MOST_SCANS:
            raise FormatError(name, f"the JPEG has more than {_MOST_SCANS} scans")
    if not data.startswith(b"\x89PNG"):
        return
    at, kind = 8, b""
    while kind != b"IEND":
        size = int.from_bytes(data[at : at + 4], "big")
        kind = data[at + 4 : at + 8]
        end = at + 8 + size
        if end + 4 > len(data):
            raise FormatError(name, "the image is cut short", remedy="copy it again")
        if zlib.crc32(data[at + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            raise FormatError(name, f"chunk {kind!r} of the PNG is damaged", remedy="copy it again")
        at = end + 4


def exr_channels(name: str, data: bytes) -> tuple[str, ...]:
    """Channel names of an EXR as they stand in its header, which alone is decoded."""
    return _with_exr(name, data, lambda source: tuple(source.spec().channelnames))


def read_exr(name: str, data: bytes) -> tuple[Array, tuple[str, ...], dict[str, Any]]:
    """An EXR: (h, w, c) float32, channel names (R, G, B first), and its attributes.

    Raises:
        FormatError: not an EXR, damaged, deep, or absurdly large.
    """
    import OpenImageIO as oiio

    def decode(source: Any) -> tuple[Array, tuple[str, ...], dict[str, Any]]:
        spec = source.spec()
        if spec.deep:
            raise FormatError(name, "the EXR is deep; expected flat pixels")
        check_size(name, spec.height, spec.width, spec.nchannels, coded=len(data))
        pixels = source.read_image(oiio.FLOAT)
        fault = _fault(source.geterror)
        if pixels is None or fault:
            raise FormatError(name, f"the EXR cannot be decoded ({fault})", remedy="copy it again")
        values = _in_display_window(name, np.asarray(pixels, np.float32), spec, len(data))
        attributes = {attribute.name: attribute.value for attribute in spec.extra_attribs}
        return values, tuple(spec.channelnames), attributes

    values, names, attributes = _with_exr(name, data, decode)
    order = sorted(range(len(names)), key=lambda i: (_RGB.get(names[i], 3), i))
    return np.ascontiguousarray(values[..., order]), tuple(names[i] for i in order), attributes


def _with_exr(name: str, data: bytes, use: Callable[[Any], T]) -> T:
    """What `use` makes of the opened EXR."""
    import OpenImageIO as oiio

    if data[:4] != b"v/1\x01":
        raise FormatError(name, "not an EXR: the magic number is missing")
    # OpenImageIO's Python face opens names only.
    with tempfile.NamedTemporaryFile(suffix=".exr") as file:
        file.write(data)
        file.flush()
        source = oiio.ImageInput.open(file.name)
        if source is None:
            raise FormatError(name, f"the EXR cannot be opened ({_fault(oiio.geterror)})")
        try:
            return use(source)
        except UnicodeDecodeError as error:
            raise FormatError(name, "a name in the EXR is not UTF-8") from error
        finally:
            source.close()


def _fault(said: Callable[[], str]) -> str:
    """What the library says is wrong, in short: it cites a damaged file at length."""
    try:
        return " ".join(said().split())[:200]
    except UnicodeDecodeError:
        return "it holds names that are not UTF-8"


def _in_display_window(name: str, pixels: Array, spec: Any, coded: int) -> Array:
    """The whole picture of an EXR that stores a part of it; NaN where it stores nothing."""
    data_window = (spec.y, spec.x, spec.height, spec.width)
    display = (spec.full_y, spec.full_x, spec.full_height, spec.full_width)
    values = pixels.reshape(spec.height, spec.width, -1)
    if data_window == display:
        return values
    check_size(name, spec.full_height, spec.full_width, spec.nchannels, coded=coded)
    row, col = spec.y - spec.full_y, spec.x - spec.full_x
    out = np.full((spec.full_height, spec.full_width, spec.nchannels), np.nan, np.float32)
    top, left = max(row, 0), max(col, 0)
    bottom, right = (
        max(spec.full_height - row, 0),
        max(spec.full_width - col, 0),
    )
    inside = values[top - row : bottom, left - col : right]
    if inside.size:
        out[top : top + inside.shape[0], left : left + inside.shape[1]] = inside
    return out


_RGB = {"R": 0, "G": 1, "B": 2}


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
