"""Commands, replies and events: the payloads of packets. Angles are radians, places mm."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from enum import IntEnum, IntFlag
from typing import Any, NamedTuple

PROTOCOL = 1


class Command(IntEnum):
    """Codes of requests."""

    HELLO = 1
    DESCRIBE = 2
    STATUS = 3
    HOME = 4
    MOVE = 5
    STOP = 6
    ABORT = 7
    EMERGENCY_STOP = 8
    LAMP = 9
    EXPOSE = 10
    READ = 11


class Event(IntEnum):
    """Codes of events."""

    HOMED = 1
    MOVED = 2
    EXPOSED = 3
    LIMIT = 4
    STOPPED = 5
    FRAME_LOST = 6


class Refusal(IntEnum):
    """First byte of a nak; text follows."""

    UNKNOWN = 1
    MALFORMED = 2
    OUT_OF_RANGE = 3
    BUSY = 4
    NOT_HOMED = 5
    STOPPED = 6
    NO_FRAME = 7
    LIMIT = 8


class State(IntFlag):
    """Flags of a status."""

    HOMED = 1
    MOVING = 2
    EXPOSING = 4
    STOPPED = 8
    LIMIT = 16


class Hello(NamedTuple):
    """protocol u16, axes u8, pad, boot u32, description length u32."""

    protocol: int
    axes: int
    boot: int
    description: int

    def packed(self) -> bytes:
        return _HELLO.pack(*self)

    @staticmethod
    def parsed(payload: bytes) -> Hello:
        protocol, axes, boot, description = _HELLO.unpack(payload)
        return Hello(protocol, axes, boot, description)


class Status(NamedTuple):
    """flags u32, source u32, clock f64, lamp f64, temperature f64; an axis: encoder, counter."""

    state: State
    source: int
    clock_s: float
    lamp: float
    temperature_c: float
    encoder: tuple[float, ...]
    counter: tuple[float, ...]

    def packed(self) -> bytes:
        head = _STATUS.pack(self.state, self.source, self.clock_s, self.lamp, self.temperature_c)
        return head + _places(self.encoder, self.counter)

    @staticmethod
    def parsed(payload: bytes) -> Status:
        state, source, clock_s, lamp, temperature_c = _STATUS.unpack_from(payload)
        encoder, counter = _two_places(payload, _STATUS.size)
        return Status(State(state), source, clock_s, lamp, temperature_c, encoder, counter)


class Exposed(NamedTuple):
    """What comes with a frame: numbers u32, sizes, CRC and what was measured half-way."""

    boot: int
    frame: int
    width: int
    height: int
    channels: int
    size: int
    crc: int
    exposure_s: float
    iso: float
    clock_s: float
    lamp: float
    temperature_c: float
    encoder: tuple[float, ...]
    counter: tuple[float, ...]

    def packed(self) -> bytes:
        return _EXPOSED.pack(*self[:12]) + _places(self.encoder, self.counter)

    @staticmethod
    def parsed(payload: bytes) -> Exposed:
        numbers = _EXPOSED.unpack_from(payload)
        places = _two_places(payload, _EXPOSED.size)
        return Exposed._make((*numbers, *places))


_HELLO = struct.Struct("<HBxII")
_STATUS = struct.Struct("<IIddd")
_EXPOSED = struct.Struct("<IIHHHxxIIddddd")
# What stands before the counts in a frame buffer: the numbers of the exposure that filled it.
STAMP = struct.Struct("<II")
_TARGET = struct.Struct("<Bxxxxxxxd")
_EXPOSE = struct.Struct("<dd")
_READ = struct.Struct("<III")
_SOURCE = struct.Struct("<I")


def move(targets: Mapping[int, float]) -> bytes:
    """Payload of MOVE: (axis u8, 7 pad, target f64) a moved axis."""
    return b"".join(_TARGET.pack(axis, target) for axis, target in targets.items())


def parse_move(payload: bytes) -> dict[int, float]:
    """Targets by axis.

    Raises:
        struct.error: not a whole number of targets.
    """
    return dict(_TARGET.iter_unpack(payload))


def expose(exposure_s: float, iso: float) -> bytes:
    """Payload of EXPOSE: seconds f64, ISO f64."""
    return _EXPOSE.pack(exposure_s, iso)


def parse_expose(payload: bytes) -> tuple[float, float]:
    """Seconds and ISO of an EXPOSE."""
    exposure_s, iso = _EXPOSE.unpack(payload)
    return exposure_s, iso


def read(frame: int, offset: int, size: int) -> bytes:
    """Payload of READ (frame 0xFFFFFFFF is the description): frame, offset, size, u32 each."""
    return _READ.pack(frame, offset, size)


def parse_read(payload: bytes) -> tuple[int, int, int]:
    """Frame, offset and size of a READ."""
    frame, offset, size = _READ.unpack(payload)
    return frame, offset, size


def lamp(source: int) -> bytes:
    """Payload of LAMP: source u32, 0 none."""
    return _SOURCE.pack(source)


def parse_lamp(payload: bytes) -> int:
    """Source of a LAMP."""
    return int(_SOURCE.unpack(payload)[0])


def nak(refusal: Refusal, text: str) -> bytes:
    """Payload of a nak: a code, then UTF-8 text."""
    return bytes([refusal]) + text.encode()


def parse_nak(payload: bytes) -> tuple[Refusal, str]:
    """Why, and in words; a code that this version does not know is UNKNOWN."""
    code = payload[0] if payload else 0
    known = code in {int(each) for each in Refusal}
    return Refusal(code) if known else Refusal.UNKNOWN, payload[1:].decode("utf-8", "replace")


def description(document: Mapping[str, Any]) -> bytes:
    """The rig's description as its firmware holds it: a constant UTF-8 JSON text."""
    return json.dumps(document, allow_nan=False).encode()


DESCRIPTION = 0xFFFFFFFF


def _places(encoder: tuple[float, ...], counter: tuple[float, ...]) -> bytes:
    both = [value for pair in zip(encoder, counter, strict=True) for value in pair]
    return struct.pack(f"<{len(both)}d", *both)


def _two_places(payload: bytes, at: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
    count, rest = divmod(len(payload) - at, 16)
    if rest:
        raise struct.error(f"{len(payload)} bytes do not hold whole axes")
    both = struct.unpack_from(f"<{2 * count}d", payload, at)
    return both[0::2], both[1::2]
