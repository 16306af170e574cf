"""Packets: length, sequence number and CRC around a payload, and finding them in a byte stream.

    offset  size  field
    0       2     magic, B7 F1
    2       1     kind: 1 request, 2 ack, 3 nak, 4 event, 5 data
    3       1     code: the command, or the event
    4       2     sequence number; a reply has its request's
    6       2     0
    8       4     length of the payload, at most 65536
    12      n     payload
    12 + n  4     CRC-32 (IEEE 802.3) of everything before

All numbers are little-endian.
"""

from __future__ import annotations

import struct
import zlib
from enum import IntEnum
from typing import NamedTuple, final

MAGIC = b"\xb7\xf1"
HEAD = struct.Struct("<2sBBHHI")
TAIL = struct.Struct("<I")
MOST_PAYLOAD = 1 << 16
OVERHEAD = HEAD.size + TAIL.size


class Kind(IntEnum):
    """What a packet is."""

    REQUEST = 1
    ACK = 2
    NAK = 3
    EVENT = 4
    DATA = 5


class Packet(NamedTuple):
    """One packet, checked."""

    kind: Kind
    code: int
    sequence: int
    payload: bytes = b""

    def encoded(self) -> bytes:
        """The bytes on the wire.

        Raises:
            ValueError: a payload of more than 65536 bytes.
        """
        if len(self.payload) > MOST_PAYLOAD:
            raise ValueError(f"payload of {len(self.payload)} bytes; at most {MOST_PAYLOAD}")
        head = HEAD.pack(MAGIC, self.kind, self.code, self.sequence, 0, len(self.payload))
        body = head + self.payload
        return body + TAIL.pack(zlib.crc32(body))


@final
class Parser:
    """Packets out of a stream that arrives in pieces of any size.

    What is no packet, or has a wrong CRC, is skipped up to the next magic and counted: the reply
    that it was is asked for again by its sequence number.

    Attributes:
        damaged: packets whose CRC was wrong. skipped: bytes that were no packet.
    """

    def __init__(self) -> None:
        self._held = bytearray()
        self.damaged = 0
        self.skipped = 0

    def feed(self, data: bytes) -> list[Packet]:
        """The packets that are complete now."""
        self._held += data
        found = []
        while (packet := self._next()) is not None:
            found.append(packet)
        return found

    def reset(self) -> None:
        """Forget the beginning of a packet whose rest will not come."""
        self.skipped += len(self._held)
        self._held.clear()

    def _next(self) -> Packet | None:
        while True:
            self._to_magic()
            if len(self._held) < HEAD.size:
                return None
            _, kind, code, sequence, zero, length = HEAD.unpack_from(self._held)
            if length > MOST_PAYLOAD or kind not in _KINDS or zero:
                self._drop(1)
                continue
            end = HEAD.size + length
            if len(self._held) < end + TAIL.size:
                return None
            if zlib.crc32(self._held[:end]) != TAIL.unpack_from(self._held, end)[0]:
                self.damaged += 1
                # The length itself may be what is damaged: only the magic is passed over.
                self._drop(1)
                continue
            payload = bytes(self._held[HEAD.size : end])
            del self._held[: end + TAIL.size]
            return Packet(Kind(kind), code, sequence, payload)

    def _to_magic(self) -> None:
        at = self._held.find(MAGIC)
        if at < 0:
            # The last byte may be the first half of a magic.
            at = len(self._held) - (self._held[-1:] == MAGIC[:1])
        if at:
            self._drop(at)

    def _drop(self, count: int) -> None:
        del self._held[:count]
        self.skipped += count


_KINDS = frozenset(int(kind) for kind in Kind)
