"""The computer's end of the wire: requests that are answered, refused or repeated, and events."""

from __future__ import annotations

import struct
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from typing import final

from btfkit.devices.wire.messages import DESCRIPTION, Command, Event, Refusal, parse_nak, read
from btfkit.devices.wire.packets import MOST_PAYLOAD, Kind, Packet, Parser
from btfkit.errors import DeviceError

# A reply takes a few ms; a request is sent again with its own sequence number, which the
# firmware answers from memory instead of obeying twice.
_REPLY_S = 1.0
_TRIES = 4
_PIECE_S = 0.5


class Transport(ABC):
    """Bytes to and from the rig."""

    @abstractmethod
    def write(self, data: bytes) -> None:
        """Send all of `data`, or raise DeviceError."""

    @abstractmethod
    def read(self, timeout_s: float) -> bytes:
        """What is there, at most some kB; b"" after `timeout_s` without a byte."""

    @abstractmethod
    def recover(self) -> None:
        """After a lost reply: clear halted endpoints and drop what is half sent."""

    @abstractmethod
    def now(self) -> float:
        """The clock that time-outs are counted by, seconds."""


class RefusedError(DeviceError):
    """The firmware said no."""

    def __init__(self, what: str, refusal: Refusal, text: str) -> None:
        super().__init__(f"the rig refused {what}: {text} ({refusal.name.lower()})")
        self.refusal = refusal


@final
class Link:
    """Requests and events over a transport.

    Attributes:
        repeats: requests that had to be sent again, over the life of the link.
    """

    def __init__(self, transport: Transport) -> None:
        self._transport = transport
        self._parser = Parser()
        self._sequence = 0
        self._events: deque[Packet] = deque(maxlen=64)
        self._turn = threading.Lock()
        self.repeats = 0

    def request(self, command: Command, payload: bytes = b"") -> bytes:
        """The payload of the reply.

        Raises:
            RefusedError: the firmware does not do it.
            DeviceError: no reply, in several tries.
        """
        with self._turn:
            self._sequence = self._sequence % 0xFFFF + 1
            packet = Packet(Kind.REQUEST, command, self._sequence, payload)
            for attempt in range(_TRIES):
                self.repeats += attempt > 0
                self._transport.write(packet.encoded())
                reply = self._reply(packet)
                if reply is not None:
                    return reply
                self._transport.recover()
                self._parser.reset()
        raise DeviceError(
            f"no answer to {command.name.lower()} in {_TRIES} tries of {_REPLY_S:g} s",
            remedy="check that the rig is switched on, then start again with --resume",
        )

    def send(self, command: Command) -> None:
        """Send a request whose reply nobody waits for: a stop, from any thread."""
        if self._turn.acquire(timeout=0.05):
            self._turn.release()
            self.request(command)
        else:
            # Another thread waits for an answer; it passes over the reply to this.
            self._transport.write(Packet(Kind.REQUEST, command, 0).encoded())

    def event(
        self, wanted: Callable[[Packet], bool], *, timeout_s: float, abandon: Event = Event.STOPPED
    ) -> Packet | None:
        """The next event that is `wanted`; None after `timeout_s`.

        Raises:
            DeviceError: the rig was stopped meanwhile.
        """
        end = self._transport.now() + timeout_s
        while True:
            with self._turn:
                found = self._taken(wanted, abandon)
                if found is not None:
                    return found
                left = end - self._transport.now()
                if left <= 0:
                    return None
                data = self._transport.read(min(left, _PIECE_S) if left > 1e-3 else 1e-3)
                self._keep(self._parser.feed(data))

    def forget_events(self) -> None:
        """Drop events of what is over."""
        with self._turn:
            self._events.clear()

    def fetch(self, frame: int, size: int) -> bytes:
        """`size` bytes of a frame buffer, or of the description."""
        parts = []
        for offset in range(0, size, MOST_PAYLOAD):
            part = self.request(Command.READ, read(frame, offset, min(MOST_PAYLOAD, size - offset)))
            if len(part) != min(MOST_PAYLOAD, size - offset):
                raise DeviceError(
                    f"{len(part)} bytes came at offset {offset} of a frame of {size}; "
                    f"expected {min(MOST_PAYLOAD, size - offset)}"
                )
            parts.append(part)
        return b"".join(parts)

    def description(self, size: int) -> bytes:
        """The rig's own description."""
        return self.fetch(DESCRIPTION, size)

    def _reply(self, asked: Packet) -> bytes | None:
        end = self._transport.now() + _REPLY_S
        while (left := end - self._transport.now()) > 0:
            data = self._transport.read(max(left, 1e-3))
            packets = self._parser.feed(data)
            self._keep(packets)
            for packet in packets:
                # Replies to earlier requests arrive late or twice; only this one's counts.
                if packet.kind is Kind.EVENT or packet.sequence != asked.sequence:
                    continue
                if packet.code != asked.code:
                    continue
                if packet.kind is Kind.NAK:
                    raise RefusedError(Command(asked.code).name.lower(), *parse_nak(packet.payload))
                if packet.kind in (Kind.ACK, Kind.DATA):
                    return packet.payload
            if not data:
                break
        return None

    def _keep(self, packets: list[Packet]) -> None:
        self._events.extend(packet for packet in packets if packet.kind is Kind.EVENT)

    def _taken(self, wanted: Callable[[Packet], bool], abandon: Event) -> Packet | None:
        while self._events:
            packet = self._events.popleft()
            if packet.code == abandon:
                raise DeviceError("the rig was stopped", remedy="start again with --resume")
            try:
                if wanted(packet):
                    return packet
            except struct.error as error:
                raise DeviceError(f"an event that does not parse ({error})") from error
        return None
