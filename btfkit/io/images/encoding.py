"""Pictures to files: 8-bit sRGB JPEG and PNG, EXR, TIFF, and profiles put into what is encoded."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit import colour
from btfkit.io.images.image import Array
from btfkit.io.images.libraries import opencv, openimageio
from btfkit.io.images.profiles import Chromaticities

_MOST_SEGMENT = 65535 - 2 - 14


def encode_jpeg(linear: Array, *, quality: int = 100) -> bytes:
    """8-bit sRGB JPEG bytes of a linear (h, w, 1 or 3) picture, full chroma resolution."""
    cv2 = opencv()
    codes = _codes(linear)
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x111111]
    return _encoded(cv2.imencode(".jpg", codes, options))


def encode_png(linear: Array) -> bytes:
    """8-bit sRGB PNG bytes of a linear (h, w, 1 or 3) picture."""
    cv2 = opencv()
    return _encoded(cv2.imencode(".png", _codes(linear)))


def encode_png_numbers(values: Array) -> bytes:
    """16-bit PNG bytes of numbers (h, w, 1 or 3) from 0 to 1 that are no colours."""
    cv2 = opencv()
    codes = np.rint(np.clip(values, 0, 1) * 65535).astype(np.uint16)
    return _encoded(cv2.imencode(".png", codes[..., ::-1] if codes.shape[2] == 3 else codes))


def png_with_profile(data: bytes, profile: bytes) -> bytes:
    """A PNG with an ICC profile behind its header."""
    body = b"iCCPICC profile\0\0" + zlib.compress(profile)
    chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
    # Signature and header are 8 + 25 bytes, always.
    return data[:33] + chunk + data[33:]


def jpeg_with_profile(data: bytes, profile: bytes) -> bytes:
    """A JPEG with an ICC profile right behind its start, or behind JFIF's segment."""
    parts = [profile[i : i + _MOST_SEGMENT] for i in range(0, len(profile), _MOST_SEGMENT)]
    segments = b"".join(
        b"\xff\xe2" + struct.pack(">H", len(part) + 16) + b"ICC_PROFILE\0"
        + bytes([number, len(parts)]) + part
        for number, part in enumerate(parts, 1)
    )  # fmt: skip
    at = 2
    if data[2:4] == b"\xff\xe0":
        at = 4 + struct.unpack_from(">H", data, 4)[0]
    return data[:at] + segments + data[at:]


def write_exr(
    path: str | os.PathLike[str],
    values: NDArray[Any],
    channels: Sequence[str],
    attributes: Mapping[str, Any] | None = None,
    *,
    chromaticities: Chromaticities | None = None,
) -> None:
    """Write (h, w, c) as an EXR, half or float32 by the dtype of `values`, compressed losslessly.

    Args:
        path: of the file.
        values: (h, w, c).
        channels: their names.
        attributes: numbers and texts.
        chromaticities: of R, G and B, so that other programs need not guess; None says nothing.

    Raises:
        OSError: the file cannot be written.
    """
    oiio = openimageio()
    half = values.dtype == np.float16
    h, w, c = values.shape
    spec = oiio.ImageSpec(w, h, c, oiio.HALF if half else oiio.FLOAT)
    spec.channelnames = tuple(channels)
    spec.attribute("compression", "zip")
    if chromaticities is not None:
        spec.attribute("chromaticities", oiio.TypeDesc("float[8]"), chromaticities)
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


def write_tiff(
    path: Path, pixels: NDArray[Any], *, alpha: bool, profile: bytes | None = None
) -> None:
    """Write (h, w, c) codes or floats as a TIFF, as they are.

    Args:
        path: of the file.
        pixels: RGB or grey, alpha last.
        alpha: whether there is alpha; colours are not multiplied by it.
        profile: an ICC profile.

    Raises:
        OSError: the file cannot be written.
    """
    oiio = openimageio()
    kinds = {"uint8": oiio.UINT8, "uint16": oiio.UINT16, "float16": oiio.HALF}
    h, w, c = pixels.shape
    spec = oiio.ImageSpec(w, h, c, kinds.get(str(pixels.dtype), oiio.FLOAT))
    spec.attribute("compression", "lzw")
    if alpha:
        spec.alpha_channel = c - 1
        spec.attribute("oiio:UnassociatedAlpha", 1)
    if profile is not None:
        form = oiio.TypeDesc(f"uint8[{len(profile)}]")
        spec.attribute("ICCProfile", form, np.frombuffer(profile, np.uint8))
    out = oiio.ImageOutput.create(str(path))
    if out is None or not out.open(str(path), spec):
        raise OSError(f"{path}: cannot be written ({oiio.geterror()})")
    if not (out.write_image(np.ascontiguousarray(pixels)) and out.close()):
        raise OSError(f"{path}: cannot be written ({out.geterror()})")


def _codes(linear: Array) -> NDArray[np.uint8]:
    codes = np.rint(255 * colour.to_srgb(np.clip(np.nan_to_num(linear), 0, 1))).astype(np.uint8)
    return np.ascontiguousarray(codes[..., ::-1])


def _encoded(result: tuple[bool, NDArray[np.uint8]]) -> bytes:
    done, data = result
    if not done:
        raise ValueError("the picture cannot be encoded")
    return data.tobytes()
