"""The head of Bonn's binary `.btf`: magic, meta block, directions, size, rotations.

Little-endian, unaligned, without padding or checksums. Layout and sources: docs/formats-bonn.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.errors import FormatError

Bytes = NDArray[np.uint8]
SCALARS = {2: "<f2", 4: "<f4", 8: "<f8"}
# In the place of the meta block of old files of one factorisation a view.
LEGACY = 301074
_VERSIONS = range(1, 5)
_MOST_CHANNELS = 1 << 16
_COPY = "download or copy the file again"
# Rounding of pi / 2 in float32, and tables that were made in degrees.
_BELOW_HORIZON = 1e-3


@final
@dataclass(frozen=True)
class Magic:
    """What the first bytes say: kind of body, and whether rotations follow the size."""

    text: bytes
    kind: str
    rotations: bool


MAGICS = (
    Magic(b"!DFMF08FCR", "dfmf", True),
    Magic(b"!DFMF08FC", "dfmf", False),
    Magic(b"!FMF12FCER", "fmf1", True),
    Magic(b"!FMF12FCE", "fmf1", False),
    Magic(b"!FMF06FCR", "fmf0", True),
    Magic(b"!FMF06FC", "fmf0", False),
    Magic(b"!PVF06FCR", "pvf", True),
    Magic(b"!PVF06FC", "pvf", False),
    Magic(b"!BDI06R2!", "bdi", True),
)
LONGEST = max(len(magic.text) for magic in MAGICS)


def magics(start: bytes) -> list[Magic]:
    """Every magic that a file may have, the longest first.

    The byte after a form without R is the low byte of a size, and may be an R.
    """
    return [magic for magic in MAGICS if start.startswith(magic.text)]


@final
class Cursor:
    """Reads the bytes of a file from front to back, refusing what the rest cannot hold.

    Args:
        path: for messages.
        data: all bytes, usually a memory map.
        at: where to start.
    """

    def __init__(self, path: Path, data: Bytes, at: int = 0) -> None:
        self.path, self.data, self.at = path, data, at

    @property
    def left(self) -> int:
        return len(self.data) - self.at

    def error(self, message: str, *, remedy: str = _COPY) -> FormatError:
        return FormatError(self.path, message, remedy=remedy)

    def take(self, count: int, what: str) -> Bytes:
        """The next `count` bytes, not copied."""
        if not 0 <= count <= self.left:
            raise self.error(f"{what} at byte {self.at} needs {count} bytes; {self.left} are left")
        self.at += count
        return self.data[self.at - count : self.at]

    def u8(self, what: str) -> int:
        return int(self.take(1, what)[0])

    def u32(self, what: str) -> int:
        return int.from_bytes(self.take(4, what).tobytes(), "little")

    def i32(self, what: str) -> int:
        return int.from_bytes(self.take(4, what).tobytes(), "little", signed=True)

    def array(self, dtype: str, shape: tuple[int, ...], what: str) -> NDArray[Any]:
        """An array that lies next, not copied and perhaps unaligned."""
        count = np.dtype(dtype).itemsize
        for size in shape:
            count *= size
        return self.take(count, what).view(dtype).reshape(shape)

    def text(self, count: int, what: str) -> str:
        """Characters up to the first NUL."""
        raw = self.take(count, what).tobytes().split(b"\0", 1)[0]
        return raw.decode("utf-8", "replace").strip()


@final
@dataclass(frozen=True)
class Meta:
    """What a file says of its measurement.

    Attributes:
        version: 1 to 4; 0 where the file has no meta block.
        setup, sensor, light_source, xml: text.
        ppmm: pixels a millimetre; 0 where unknown.
        rgb_scale: stored for each of three channels, applied by no reader.
        cosine: whether the cosine of the light is in the values; None where the file is silent.
        channels: names, of wavelengths in nm where they are not three.
    """

    version: int = 0
    setup: str = ""
    sensor: str = ""
    light_source: str = ""
    ppmm: float = 0.0
    rgb_scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    cosine: bool | None = None
    xml: str = ""
    channels: tuple[str, ...] = ("R", "G", "B")


def read_meta(cursor: Cursor) -> Meta:
    """The meta block at the cursor, which must end where it says."""
    start = cursor.at
    size = cursor.u32("size of the meta block")
    version = cursor.u32("version")
    if version not in _VERSIONS:
        raise cursor.error(f"version {version} of the meta block; expected 1 to 4")
    setup, sensor, light_source = (
        cursor.text(80, what) for what in ("measurement setup", "image sensor", "light source")
    )
    ppmm = float(cursor.array("<f4", (1,), "pixels per mm")[0])
    scale = cursor.array("<f4", (3,), "RGB scale").tolist()
    cosine = _cosine(cursor) if version > 1 else None
    xml = cursor.text(cursor.u32("length of the XML"), "measurement XML") if version > 2 else ""
    channels = _channels(cursor) if version > 3 else ("R", "G", "B")
    if cursor.at - start != size:
        raise cursor.error(f"the meta block says {size} bytes and has {cursor.at - start}")
    return Meta(
        version, setup, sensor, light_source, ppmm if np.isfinite(ppmm) and ppmm > 0 else 0.0,
        (scale[0], scale[1], scale[2]), cosine, xml, channels,
    )  # fmt: skip


def _cosine(cursor: Cursor) -> bool:
    flag = cursor.u32("cosine flag")
    if flag > 1:
        raise cursor.error(f"cosine flag {flag}; expected 0 or 1")
    return flag == 1


def _channels(cursor: Cursor) -> tuple[str, ...]:
    count = cursor.u32("number of channels")
    # Each name has at least its length.
    if not 1 <= count <= min(_MOST_CHANNELS, cursor.left // 4):
        raise cursor.error(
            f"{count} channels with {cursor.left} bytes left; expected 1 to {_MOST_CHANNELS}"
        )
    lengths = (cursor.u32("length of a channel name") for _ in range(count))
    return tuple(cursor.text(length, "channel name") for length in lengths)


@final
@dataclass(frozen=True, eq=False)
class Directions:
    """Polar angle and azimuth, radians, of views (v, 2) and of the lights of each (v, l, 2)."""

    view: NDArray[np.float64]
    light: NDArray[np.float64]

    @property
    def same_lights(self) -> bool:
        """Whether every view has the lights of the first."""
        return bool((self.light == self.light[:1]).all())


def read_directions(cursor: Cursor) -> Directions:
    """The block of directions at the cursor: each view is followed by its own list of lights."""
    views = cursor.u32("number of views")
    start = cursor.at
    cursor.take(8, "first view")
    lights = cursor.u32("number of lights")
    cursor.at = start
    if not (views and lights):
        raise cursor.error(f"{views} views with {lights} lights; expected at least one of each")
    what = f"directions of {views} views with {lights} lights each"
    records = cursor.array("u1", (views, 12 + 8 * lights), what)
    counts = np.ascontiguousarray(records[:, 8:12]).view("<u4")[:, 0]
    other = np.flatnonzero(counts != lights)
    if other.size:
        raise cursor.error(
            f"view {other[0]} has {counts[other[0]]} lights and the first view {lights}; "
            "expected the same number for every view"
        )
    view = np.ascontiguousarray(records[:, :8]).view("<f4")
    light = np.ascontiguousarray(records[:, 12:]).view("<f4").reshape(views, lights, 2)
    return Directions(_angles(cursor, view, "view"), _angles(cursor, light, "light"))


def _angles(cursor: Cursor, found: NDArray[np.float32], what: str) -> NDArray[np.float64]:
    # A signalling NaN complains when it is widened; it is refused below.
    with np.errstate(invalid="ignore"):
        angles = found.astype(np.float64)
    theta = angles[..., 0]
    # NaN compares as false.
    good = np.isfinite(angles[..., 1]) & (theta >= 0) & (theta <= np.pi / 2 + _BELOW_HORIZON)
    if not good.all():
        at = tuple(int(i) for i in np.argwhere(~good)[0])
        raise cursor.error(
            f"{what} {at} has theta {theta[at]:.6g} and phi {angles[at][1]:.6g}; "
            "expected radians, theta from 0 to pi/2"
        )
    theta[:] = np.minimum(theta, np.pi / 2)
    return angles


def read_size(cursor: Cursor) -> tuple[int, int]:
    """(width, height), texels."""
    width, height = cursor.u32("width"), cursor.u32("height")
    if not (width and height):
        raise cursor.error(f"images of {width} x {height} texels; expected at least one")
    return width, height


def read_rotations(cursor: Cursor, floats: int) -> NDArray[np.float32]:
    """(r, floats) local frames; no known file has any, and known readers disagree on 9 or 3."""
    count = cursor.u32("number of rotations")
    return cursor.array("<f4", (count, floats), f"{count} rotations")
