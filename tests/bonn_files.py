"""Bonn `.btf` files put together byte by byte, apart from the code that reads them."""

from __future__ import annotations

import bz2
import struct
from dataclasses import dataclass, field

import numpy as np

DTYPES = {2: "<f2", 4: "<f4", 8: "<f8"}
VIEW = np.array([[0.0, 0.0], [0.5, -2.0], [1.1, 3.0]])
LIGHT = np.array([[0.2, 0.3], [0.9, -1.2]])


@dataclass
class Made:
    """What a file is to say; every block follows from it.

    Attributes:
        view, light: (v, 2) and (l, 2) or (v, l, 2) theta and phi.
        size: width, height.
    """

    version: int = 4
    cosine: int = 1
    channels: tuple[str, ...] = ("R", "G", "B")
    ppmm: float = 0.0
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    xml: bytes = b""
    view: np.ndarray = field(default_factory=lambda: VIEW)
    light: np.ndarray = field(default_factory=lambda: LIGHT)
    size: tuple[int, int] = (5, 4)
    rotations: bytes = struct.pack("<I", 0)
    setup: bytes = b"Dome 1"

    @property
    def nl(self) -> int:
        return self.light.shape[-2]

    @property
    def nv(self) -> int:
        return len(self.view)

    @property
    def nc(self) -> int:
        return len(self.channels)

    @property
    def texels(self) -> int:
        return self.size[0] * self.size[1]

    def meta(self) -> bytes:
        body = (
            self.setup.ljust(80, b"\0") + bytes(160) + struct.pack("<f3f", self.ppmm, *self.scale)
        )
        if self.version > 1:
            body += struct.pack("<I", self.cosine)
        if self.version > 2:
            body += struct.pack("<I", len(self.xml)) + self.xml
        if self.version > 3:
            body += struct.pack("<I", len(self.channels))
            for name in self.channels:
                body += struct.pack("<I", len(name)) + name.encode()
        return struct.pack("<II", len(body) + 8, self.version) + body

    def directions(self) -> bytes:
        lights = np.broadcast_to(self.light, (self.nv, self.nl, 2))
        out = struct.pack("<I", self.nv)
        for view, light in zip(self.view, lights, strict=True):
            out += struct.pack("<ffI", *view, self.nl) + light.astype("<f4").tobytes()
        return out

    def head(self, magic: bytes) -> bytes:
        rotations = self.rotations if magic.endswith(b"R") else b""
        return magic + self.meta() + self.directions() + struct.pack("<II", *self.size) + rotations


def matrices(left: np.ndarray, right: np.ndarray, scalar: int = 4) -> bytes:
    """K, R, C, S, U and S x V with their scalar size."""
    dtype, k = DTYPES[scalar], left.shape[1]
    out = struct.pack("<BIII", scalar, k, len(left), len(right)) + np.ones(k, dtype).tobytes()
    return out + left.astype(dtype).tobytes() + right.astype(dtype).tobytes()


def fmf(
    made: Made,
    left: np.ndarray,
    right: np.ndarray,
    *,
    magic: bytes = b"!FMF12FCER",
    log: int = 0,
    scalar: int = 4,
    heights: np.ndarray | None = None,
) -> bytes:
    out = made.head(magic)
    if magic.startswith(b"!FMF12"):
        out += struct.pack("<BI", 1 if heights is None else 2, log)
        if heights is not None:
            out += struct.pack("<II", *heights.shape[::-1]) + heights.astype("<f2").tobytes()
    return out + struct.pack("<I", left.shape[1]) + matrices(left, right, scalar)


def dfmf(
    made: Made,
    model: int,
    parts: list[tuple[np.ndarray, np.ndarray, int]],
    *,
    mean: tuple[float, ...] = (0, 0, 0),
    transform: np.ndarray | None = None,
) -> bytes:
    transform = np.eye(3) if transform is None else transform
    out = made.head(b"!DFMF08FCR") + struct.pack("<Ii3f", 99, model, *mean)
    out += transform.astype("<f4").tobytes()
    return out + b"".join(matrices(*part) for part in parts)


def pvf(
    made: Made, slots: list[tuple[np.ndarray, np.ndarray, np.ndarray]], *, legacy: bool = False
) -> bytes:
    """Slots: mean (dim,), C (dim, k), Wt (rows, k) of each view."""
    if legacy:
        out = (
            b"!PVF06FC"
            + struct.pack("<iIIII", 301074, 9, *made.size, len(slots))
            + made.directions()
        )
    else:
        out = made.head(b"!PVF06FCR") + struct.pack("<II", 9, len(slots))
    for mean, basis, weights in slots:
        k = basis.shape[1]
        out += struct.pack("<BIII", 4, k, len(weights), len(mean))
        for part in (np.ones(k), mean, basis, weights):
            out += np.asarray(part, "<f4").tobytes()
    return out


def bdi(
    made: Made,
    abrdf: np.ndarray,
    *,
    compression: int,
    rows: int = 3,
    mask: np.ndarray | None = None,
) -> bytes:
    """abrdf: (h, w, v, l, c)."""
    w, h = made.size
    mask = np.ones((h, w), bool) if mask is None else mask
    out = b"!BDI06R2!" + made.meta() + made.directions()
    out += struct.pack("<IIIB", w, h, rows, compression) + mask.astype("u1").tobytes()
    out += made.rotations
    for start in range(0, h, rows):
        part = abrdf[start : start + rows]
        if compression == 2:
            part = part[mask[start : start + rows]]
        data = part.astype("<f2").tobytes()
        data = bz2.compress(data) if compression == 1 else data
        out += struct.pack("<I", len(data)) + data
    return out


def random_factors(made: Made, k: int, *, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """U and S x V of FMF that are exact in half precision."""
    rng = np.random.default_rng(seed)
    left = rng.integers(-8, 9, (made.nc * made.nl * made.nv, k)) / 16
    return left, rng.integers(-8, 9, (made.texels, k)) / 16


def product(made: Made, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(n, h, w, c) values of FMF factors, index by index as the layout says."""
    w, h = made.size
    out = np.empty((made.nl * made.nv, h, w, made.nc))
    for v, i, c, y, x in np.ndindex(made.nv, made.nl, made.nc, h, w):
        row = c + made.nc * (i + made.nl * v)
        out[i + made.nl * v, y, x, c] = left[row] @ right[x + w * y]
    return out
