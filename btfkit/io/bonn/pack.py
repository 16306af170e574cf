"""The bytes of a Bonn `.btf`, block by block: what `header` and `body` take apart."""

from __future__ import annotations

import struct
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from btfkit.io.bonn.header import SCALARS, Meta

Floats = NDArray[np.floating]
_AT_ONCE = 1 << 24


def u32(*values: int) -> bytes:
    """Little-endian 32-bit numbers without sign."""
    return struct.pack(f"<{len(values)}I", *values)


def meta_block(meta: Meta) -> bytes:
    """The meta block in the form of its own version; what that form lacks is left out."""
    texts = [
        text.encode()[:80].ljust(80, b"\0") for text in (meta.setup, meta.sensor, meta.light_source)
    ]
    body = b"".join(texts) + struct.pack("<f3f", meta.ppmm, *meta.rgb_scale)
    if meta.version > 1:
        body += u32(bool(meta.cosine))
    if meta.version > 2:
        body += u32(len(meta.xml.encode())) + meta.xml.encode()
    if meta.version > 3:
        names = [name.encode() for name in meta.channels]
        body += u32(len(names)) + b"".join(u32(len(name)) + name for name in names)
    return u32(8 + len(body), meta.version) + body


def directions_block(view: Floats, light: Floats) -> bytes:
    """Views and the lights of each.

    Args:
        view: (v, 2) polar angle and azimuth, radians.
        light: (l, 2) of every view, or (v, l, 2).
    """
    lights = np.broadcast_to(light, (len(view), *light.shape[-2:])).astype("<f4")
    head = np.asarray(view, "<f4")
    return u32(len(view)) + b"".join(
        head[i].tobytes() + u32(lights.shape[1]) + lights[i].tobytes() for i in range(len(view))
    )


def head(magic: bytes, meta: Meta, view: Floats, light: Floats, size: tuple[int, int]) -> bytes:
    """Everything before the body of FMF, DFMF and PVF; no rotations. size: (width, height)."""
    rotations = u32(0) if magic.endswith(b"R") else b""
    return magic + meta_block(meta) + directions_block(view, light) + u32(*size) + rotations


def fmf_head(*, log: bool, most: int, version: int = 1) -> bytes:
    """What FMF 1 has before its factors; most: the greatest number of components."""
    return bytes([version]) + (u32(log) if version else b"") + u32(most)


def dfmf_head(
    *, model: int, most: int, mean: Floats | None = None, transform: Floats | None = None
) -> bytes:
    """What DFMF has before its factors."""
    mean = np.zeros(3) if mean is None else mean
    transform = np.eye(3) if transform is None else transform
    numbers = np.asarray(mean, "<f4").tobytes() + np.asarray(transform, "<f4").tobytes()
    return u32(most) + struct.pack("<i", model) + numbers


def write_factors(
    file: BinaryIO, left: Floats, singular: Floats, right: Floats, *, scalar: int
) -> None:
    """Append U (r, k), S (k,) and S x V (c, k) with numbers of 2, 4 or 8 bytes.

    Raises:
        ValueError: a value that does not fit into the numbers.
    """
    dtype = np.dtype(SCALARS[scalar])
    file.write(bytes([scalar]) + u32(len(singular), len(left), len(right)))
    largest = np.finfo(dtype).max
    file.write(np.minimum(singular, largest).astype(dtype).tobytes())
    rows = max(1, _AT_ONCE // (8 * len(singular)))
    for matrix in (left, right):
        for start in range(0, len(matrix), rows):
            part = matrix[start : start + rows]
            if not (np.abs(part) <= largest).all():
                raise ValueError(
                    f"factors reach {np.abs(part).max():.3g}; {scalar}-byte numbers hold up to "
                    f"{largest:.3g}: write them with scalar=4"
                )
            file.write(part.astype(dtype).tobytes())
