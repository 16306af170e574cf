"""One raw frame: counts of a sensor in a file, neither scaled nor converted."""

from __future__ import annotations

import importlib
import io
import tempfile
import zlib
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit.errors import FormatError

Counts = NDArray[Any]

CODED = {".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp"}
FLOATING = {".exr", ".hdr"}
RAW = {".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw", ".raw"}
SUFFIXES = CODED | FLOATING | RAW


def is_frame(name: str) -> bool:
    """Whether a name ends like a frame that `read` takes."""
    return PurePosixPath(name).suffix.lower() in SUFFIXES


def read(name: str, data: bytes) -> Counts:
    """Decode one frame.

    Args:
        name: for messages, and for its suffix.
        data: the bytes of the file.

    Returns:
        (h, w) or (h, w, 3) counts as the file has them: uint8, uint16 or float32, RGB, row 0 on
        top. RAW files give the mosaic of their visible area, black level not subtracted.

    Raises:
        FormatError: not an image, damaged, or a RAW file without rawpy.
    """
    suffix = PurePosixPath(name).suffix.lower()
    if suffix in FLOATING:
        return _read_floats(name, data)
    if suffix in RAW:
        return _read_raw(name, data)
    if suffix not in CODED:
        raise FormatError(
            name, f"ends in {suffix!r}; expected one of {', '.join(sorted(SUFFIXES))}"
        )
    return _read_codes(name, data)


def encode_png(counts: NDArray[np.uint16]) -> bytes:
    """A (h, w) or (h, w, 3) frame as a PNG of 16 bits; the same counts give the same bytes."""
    import cv2

    if counts.dtype != np.uint16 or counts.shape[2:] not in ((), (3,)) or counts.ndim < 2:
        raise ValueError(f"counts are {counts.dtype} {counts.shape}; expected uint16 (h, w[, 3])")
    if counts.ndim == 3:
        counts = np.ascontiguousarray(counts[..., ::-1])
    # Level 1: noise does not shrink further, and the camera waits for the disk.
    done, data = cv2.imencode(".png", counts, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not done:
        raise ValueError("the frame cannot be encoded")
    return bytes(data.tobytes())


def _read_codes(name: str, data: bytes) -> Counts:
    import cv2

    check_whole(name, data)
    # Without IGNORE_ORIENTATION a camera that was held upright would turn some of the frames.
    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        codes = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise FormatError(name, f"not a readable image ({error})") from error
    if codes is None:
        raise FormatError(name, "not a readable image", remedy="copy it again")
    if codes.dtype not in (np.uint8, np.uint16, np.float32):
        raise FormatError(name, f"pixels are {codes.dtype}; expected 8 or 16 bit, or float32")
    if codes.ndim == 3 and codes.shape[2] == 3:
        codes = np.ascontiguousarray(codes[..., ::-1])
    return np.asarray(codes)


def _read_floats(name: str, data: bytes) -> Counts:
    import OpenImageIO as oiio

    suffix = PurePosixPath(name).suffix.lower()
    # OpenImageIO's Python face opens names only.
    with tempfile.NamedTemporaryFile(suffix=suffix) as file:
        file.write(data)
        file.flush()
        source = oiio.ImageInput.open(file.name)
        pixels = None if source is None else source.read_image(oiio.FLOAT)
        # Asked for, or the library prints it at exit.
        fault = oiio.geterror() if source is None else source.geterror()
        if source is None or pixels is None or fault:
            raise FormatError(name, f"not a readable {suffix} image", remedy="copy it again")
        values = np.asarray(pixels, np.float32)
        source.close()
    return values[..., 0] if values.shape[2] == 1 else np.ascontiguousarray(values[..., :3])


def _read_raw(name: str, data: bytes) -> Counts:
    try:
        rawpy = importlib.import_module("rawpy")
    except ImportError as error:
        raise FormatError(
            name, "a RAW file, which rawpy reads", remedy='pip install "btfkit[raw]"'
        ) from error
    try:
        with rawpy.imread(io.BytesIO(data)) as raw:
            return np.array(raw.raw_image_visible, np.uint16)
    except rawpy.LibRawError as error:
        raise FormatError(name, f"not a readable RAW file ({error})") from error


def check_whole(name: str, data: bytes) -> None:
    """Refuse what decoders fill with grey or noise without a word: cut files, damaged chunks."""
    if data.startswith(b"\xff\xd8") and b"\xff\xd9" not in data[-4096:]:
        raise FormatError(name, "the image is cut short", remedy="copy it again")
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
