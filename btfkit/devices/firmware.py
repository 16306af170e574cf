"""The firmware's end of the wire: bytes in, bytes out, over the twin's world."""

from __future__ import annotations

import heapq
import struct
import zlib
from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import Any, final

import numpy as np

from btfkit.devices.faults import Faults
from btfkit.devices.twin.lamp import NONE
from btfkit.devices.twin.world import World
from btfkit.devices.wire import messages
from btfkit.devices.wire.messages import (
    Command,
    Event,
    Exposed,
    Hello,
    Refusal,
    State,
    Status,
)
from btfkit.devices.wire.packets import Kind, Packet, Parser

_REPLY_S = 5e-4
_LATE_S = 2.5
# Replies by sequence number: a repeated request is answered, not obeyed twice.
_REMEMBERED = 16
# The range is a little wider than what is promised: targets are approached from below.
_BELOW = {"rotary": 0.02, "linear": 1.0}
# Share of its way after which an axis meets its switch, where that fault strikes.
_SWITCH = 0.4

Log = Callable[[Mapping[str, Any]], None]


class _RefusedError(Exception):
    def __init__(self, refusal: Refusal, text: str) -> None:
        super().__init__(text)
        self.refusal = refusal


@final
class Firmware:
    """A rig's microcontroller.

    Args:
        world: what it drives. faults: what goes wrong on its side of the wire.
        log: told what really was at each exposure, and when axes are homed.
    """

    def __init__(self, world: World, faults: Faults, log: Log | None = None) -> None:
        self.world = world
        self._faults = faults
        self._log = log
        self._parser = Parser()
        self._description = messages.description(world.nominal)
        self._boot = zlib.crc32(struct.pack("<qq", world.setup.seed, world.setup.session))
        self._out: list[tuple[float, int, bytes]] = []
        self._order = 0
        self._replies: OrderedDict[int, bytes] = OrderedDict()
        self._state = State(0)
        self._motion: Event | None = None
        self._frame = 0
        self._exposing: tuple[int, float, float, float] | None = None
        self._buffer = b""
        self._buffered = -1

    def receive(self, data: bytes) -> None:
        """Bytes from the computer."""
        for packet in self._parser.feed(data):
            if packet.kind is Kind.REQUEST:
                self._answer(packet)

    def take(self, timeout_s: float) -> bytes:
        """The next bytes for the computer; b"" once `timeout_s` have passed without any."""
        clock = self.world.clock
        end = clock.now() + timeout_s
        while True:
            due = self._out[0][0] if self._out else np.inf
            happens = self._happens_s()
            if min(due, happens) > end:
                clock.until(end)
                return b""
            if happens <= due:
                clock.until(happens)
                self._happen()
                continue
            clock.until(due)
            return heapq.heappop(self._out)[2]

    def drop(self) -> None:
        """Forget what is not sent yet: the endpoint was reset."""
        self._out.clear()

    def _answer(self, packet: Packet) -> None:
        known = self._replies.get(packet.sequence) if packet.sequence else None
        if known is not None:
            self._send(known)
            return
        try:
            payload = self._obeyed(packet.code, packet.payload)
            kind = Kind.DATA if packet.code == Command.READ else Kind.ACK
            reply = Packet(kind, packet.code, packet.sequence, payload)
        except _RefusedError as error:
            refused = messages.nak(error.refusal, str(error))
            reply = Packet(Kind.NAK, packet.code, packet.sequence, refused)
        except struct.error as error:
            refused = messages.nak(Refusal.MALFORMED, str(error))
            reply = Packet(Kind.NAK, packet.code, packet.sequence, refused)
        encoded = reply.encoded()
        if packet.sequence:
            self._replies[packet.sequence] = encoded
            if len(self._replies) > _REMEMBERED:
                self._replies.popitem(last=False)
        self._send(encoded)

    def _send(self, encoded: bytes) -> None:
        """Queue a reply, with what the wire may do to it."""
        delay, faults = _REPLY_S, self._faults
        if faults.strikes("no-reply"):
            return
        if faults.strikes("late-reply"):
            delay = _LATE_S
        if faults.strikes("truncated"):
            encoded = encoded[: len(encoded) // 2]
        if faults.strikes("bad-crc"):
            encoded = encoded[:-1] + bytes([encoded[-1] ^ 4])
        self._queue(encoded, delay)
        if faults.strikes("duplicate"):
            self._queue(encoded, delay)

    def _queue(self, encoded: bytes, delay_s: float = 0.0) -> None:
        self._order += 1
        heapq.heappush(self._out, (self.world.clock.now() + delay_s, self._order, encoded))

    def _event(self, event: Event, payload: bytes = b"") -> None:
        self._queue(Packet(Kind.EVENT, event, 0, payload).encoded())

    def _obeyed(self, code: int, payload: bytes) -> bytes:
        obey = {
            Command.HELLO: self._hello,
            Command.STATUS: self._status,
            Command.HOME: self._home,
            Command.MOVE: self._move,
            Command.STOP: self._stop,
            Command.ABORT: self._abort,
            Command.EMERGENCY_STOP: self._emergency_stop,
            Command.LAMP: self._lamp,
            Command.EXPOSE: self._expose,
            Command.READ: self._read,
        }
        if code not in obey:
            raise _RefusedError(Refusal.UNKNOWN, f"command {code}")
        return obey[Command(code)](payload)

    def _hello(self, _: bytes) -> bytes:
        axes = len(self.world.motors)
        return Hello(messages.PROTOCOL, axes, self._boot, len(self._description)).packed()

    def _status(self, _: bytes) -> bytes:
        now = self.world.clock.now()
        moving = any(motor.moving(now) for motor in self.world.motors)
        state = self._state | (State.MOVING if moving else State(0))
        state |= State.EXPOSING if self._exposing else State(0)
        return Status(
            state, self.world.lamp.source, now,
            self.world.lamp.monitor(now), self.world.temperature_c(now),
            tuple(motor.encoder(now) for motor in self.world.motors),
            tuple(motor.counter(now) for motor in self.world.motors),
        ).packed()  # fmt: skip

    def _home(self, _: bytes) -> bytes:
        self._refuse_busy()
        self._state &= ~(State.STOPPED | State.LIMIT)
        if self._log is not None:
            self._log({"homed": self._boot, "time_s": self.world.clock.now()})
        for motor in self.world.motors:
            motor.home(self.world.clock.now())
        self._motion = Event.HOMED
        return b""

    def _move(self, payload: bytes) -> bytes:
        targets = messages.parse_move(payload)
        self._refuse_busy()
        if State.HOMED not in self._state:
            raise _RefusedError(Refusal.NOT_HOMED, "positions are not known")
        if State.LIMIT in self._state:
            raise _RefusedError(Refusal.LIMIT, "an axis stands on its switch")
        for index, target in targets.items():
            if index >= len(self.world.motors):
                raise _RefusedError(Refusal.MALFORMED, f"axis {index}")
            axis = self.world.motors[index].axis
            if not axis.low - _BELOW[axis.kind] <= target <= axis.high + 1e-6:
                raise _RefusedError(Refusal.OUT_OF_RANGE, f"axis {index} to {target:g}")
        now = self.world.clock.now()
        for index, target in targets.items():
            self.world.motors[index].start(target, now)
        self._motion = Event.MOVED
        if targets and self._faults.strikes("lost-steps"):
            self.world.motors[next(iter(targets))].slip()
        if targets and self._faults.strikes("limit-switch"):
            self._motion = Event.LIMIT
            self.world.clock.until(now + _SWITCH * (self._rests_s() - now))
            self._slow()
        return b""

    def _stop(self, _: bytes) -> bytes:
        moving = self._motion is not None
        self._slow()
        self._motion = None
        if moving:
            self._event(Event.STOPPED)
        return b""

    def _abort(self, _: bytes) -> bytes:
        exposing, self._exposing = self._exposing is not None, None
        self._stop(b"")
        if exposing:
            self._event(Event.STOPPED)
        return b""

    def _emergency_stop(self, _: bytes) -> bytes:
        now = self.world.clock.now()
        self.world.lamp.switch(NONE, now)
        for motor in self.world.motors:
            motor.freeze(now)
        self._exposing, self._motion = None, None
        self._state = State.STOPPED
        self._event(Event.STOPPED)
        return b""

    def _lamp(self, payload: bytes) -> bytes:
        source = messages.parse_lamp(payload)
        if source > len(self.world.nominal["sources"]):
            raise _RefusedError(Refusal.OUT_OF_RANGE, f"light {source}")
        if State.STOPPED in self._state and source:
            raise _RefusedError(Refusal.STOPPED, "the emergency stop holds until homing")
        self.world.lamp.switch(source, self.world.clock.now())
        return b""

    def _expose(self, payload: bytes) -> bytes:
        exposure_s, iso = messages.parse_expose(payload)
        self._refuse_busy()
        sensor = self.world.nominal["sensor"]
        low, high = sensor["exposure_s"]
        if not low * (1 - 1e-6) <= exposure_s <= high * (1 + 1e-6) or iso not in sensor["isos"]:
            raise _RefusedError(Refusal.OUT_OF_RANGE, f"{exposure_s:g} s at ISO {iso:g}")
        if State.HOMED not in self._state:
            raise _RefusedError(Refusal.NOT_HOMED, "positions are not known")
        self._frame += 1
        if self._faults.strikes("lamp-off"):
            self.world.lamp.fail()
        began = self.world.clock.now()
        ends = began + exposure_s + sensor["readout_s"]
        self._exposing = (self._frame, exposure_s, iso, began)
        self._exposed_s = ends
        return messages.STAMP.pack(self._boot, self._frame)

    def _read(self, payload: bytes) -> bytes:
        frame, offset, size = messages.parse_read(payload)
        if frame == messages.DESCRIPTION:
            return self._description[offset : offset + size]
        if frame != self._buffered:
            raise _RefusedError(Refusal.NO_FRAME, f"frame {frame}")
        return self._buffer[offset : offset + size]

    def _refuse_busy(self) -> None:
        now = self.world.clock.now()
        if self._exposing or any(motor.moving(now) for motor in self.world.motors):
            raise _RefusedError(Refusal.BUSY, "moving or exposing")

    def _slow(self) -> None:
        for motor in self.world.motors:
            motor.stop(self.world.clock.now())

    def _rests_s(self) -> float:
        return max(motor.ends_s for motor in self.world.motors)

    def _happens_s(self) -> float:
        """When the next thing happens by itself."""
        times = [np.inf]
        if self._motion is not None:
            times.append(self._rests_s())
        if self._exposing is not None:
            times.append(self._exposed_s)
        return float(min(times))

    def _happen(self) -> None:
        now = self.world.clock.now()
        if self._motion is not None and self._rests_s() <= now:
            event, self._motion = self._motion, None
            if event is Event.HOMED:
                self._state |= State.HOMED
            if event is Event.LIMIT:
                self._state |= State.LIMIT
            self._event(event)
        if self._exposing is not None and self._exposed_s <= now:
            frame, exposure_s, iso, began = self._exposing
            self._exposing = None
            self._finish(frame, exposure_s, iso, began)

    def _finish(self, frame: int, exposure_s: float, iso: float, began: float) -> None:
        """Fill the buffer and say so."""
        stamp = messages.STAMP.pack(self._boot, frame)
        if self._faults.strikes("dropped-frame"):
            self._event(Event.FRAME_LOST, stamp)
            return
        world, middle = self.world, began + exposure_s / 2
        counts = world.counts(exposure_s, iso, began)
        if not (self._buffer and self._faults.strikes("repeated-frame")):
            self._buffer = stamp + counts.astype("<u2").tobytes()
        self._buffered = frame
        if self._log is not None:
            self._log({"serial": [self._boot, frame], "time_s": middle, **world.record(middle)})
        h, w = counts.shape[:2]
        self._event(
            Event.EXPOSED,
            Exposed(
                self._boot, frame, w, h, 1 if counts.ndim == 2 else counts.shape[2],
                len(self._buffer), zlib.crc32(self._buffer), exposure_s, iso, middle,
                world.lamp.monitor(middle), world.temperature_c(middle),
                tuple(motor.encoder(middle) for motor in world.motors),
                tuple(motor.counter(middle) for motor in world.motors),
            ).packed(),
        )  # fmt: skip
