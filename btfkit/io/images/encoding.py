"""Pictures to bytes: 8-bit sRGB JPEG and PNG, and profiles put into what others encoded."""

from __future__ import annotations

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

from btfkit import colour
from btfkit.io.images.image import Array

_MOST_SEGMENT = 65535 - 2 - 14


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


def _codes(linear: Array) -> NDArray[np.uint8]:
    codes = np.rint(255 * colour.to_srgb(np.clip(np.nan_to_num(linear), 0, 1))).astype(np.uint8)
    return np.ascontiguousarray(codes[..., ::-1])


def _encoded(result: tuple[bool, NDArray[np.uint8]]) -> bytes:
    done, data = result
    if not done:
        raise ValueError("the picture cannot be encoded")
    return data.tobytes()
