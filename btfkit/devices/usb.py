"""The driver: a rig that speaks the wire protocol over two USB bulk endpoints.

The same class drives real hardware, through libusb, and the twin, through a backend in this
process; a recording of either can stand in for both.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable, Mapping
from typing import Any, TypeVar, final

import numpy as np
import usb.core

from btfkit.devices.base import (
    Axis,
    Camera,
    CameraLimits,
    Exposure,
    Found,
    FrameLostError,
    Light,
    PositionError,
    Rig,
    Stage,
    UnpluggedError,
)
from btfkit.devices.bulk import Bulk, libusb
from btfkit.devices.clock import Clock, WallClock
from btfkit.devices.deadline import Watchdog
from btfkit.devices.wire import messages
from btfkit.devices.wire.link import Link, RefusedError
from btfkit.devices.wire.messages import Command, Event, Exposed, Hello, Refusal, State, Status
from btfkit.devices.wire.packets import Packet
from btfkit.errors import DeviceError

T = TypeVar("T")

# pid.codes' number for tests: firmware for a product takes one of its own.
VENDOR, PRODUCT = 0x1209, 0x0001
_NO_LIBUSB = 'libusb is missing: pip install "btfkit[usb]"'
# An axis that rests further from its target than this is not where the frame would say it is.
_OFF_RAD, _OFF_MM = 4e-4, 0.02
# Approach every target from below by so much, and backlash is always taken up on the same side.
APPROACH_RAD, APPROACH_MM = 5e-3, 0.2
_MOST_DESCRIPTION = 1 << 20


def find(backend: Any = None) -> list[Found]:
    """The rigs on the bus; empty where there is none, or no libusb.

    Raises:
        DeviceError: the bus cannot be read.
    """
    try:
        devices = list(
            usb.core.find(
                find_all=True, idVendor=VENDOR, idProduct=PRODUCT, backend=backend or libusb()
            )
        )
    except usb.core.NoBackendError:
        return []
    except usb.core.USBError as error:
        raise DeviceError(f"the USB bus cannot be read ({error})") from error
    found = []
    for device in devices:
        try:
            found.append(Found(str(device.serial_number), str(device.product), device))
        except (usb.core.USBError, ValueError):  # what udev does not let us open has no strings
            found.append(Found("?", "a rig that may not be opened (see docs/capture.md)", device))
    return found


def open_rig(serial: str | None = None, *, backend: Any = None, clock: Clock | None = None) -> Rig:
    """The rig of a serial number, or the only one there is; not opened yet.

    Raises:
        DeviceError: none, several, or not that one.
    """
    rigs = find(backend)
    if not rigs:
        remedy = "plug it in and switch it on" if backend or libusb() else _NO_LIBUSB
        raise DeviceError("no rig on the USB bus", remedy=remedy)
    listing = ", ".join(rig.serial for rig in rigs)
    chosen = [rig for rig in rigs if serial in (None, rig.serial)]
    if len(chosen) != 1:
        asked = "no serial number was named" if serial is None else f"{serial!r} is not there"
        raise DeviceError(f"rigs on the bus: {listing}; {asked}", remedy="--device usb:SERIAL")
    return UsbRig(chosen[0], clock or WallClock(), here=backend is not None)


@final
class UsbRig(Rig):
    """A rig behind two bulk endpoints; its parts are there once it is open."""

    def __init__(self, found: Found, clock: Clock, *, here: bool) -> None:
        super().__init__(found.serial, Watchdog(f"rig {found.serial}"), here=here)
        self._transport = Bulk(found.device, clock)
        self._clock = clock
        self.link = Link(self._transport)

    def wait(self, seconds: float) -> None:
        self._clock.wait(seconds)

    def now(self) -> float:
        return self._clock.now()

    def _stop(self) -> None:
        self.link.send(Command.STOP)

    def _abort(self) -> None:
        self.link.send(Command.ABORT)

    def _emergency_stop(self) -> None:
        self.link.send(Command.EMERGENCY_STOP)

    def _begin(self) -> None:
        self._transport.claim()
        hello = _parsed(Hello.parsed, self.link.request(Command.HELLO))
        if hello.protocol != messages.PROTOCOL:
            raise DeviceError(
                f"rig {self.serial} speaks protocol {hello.protocol}; expected {messages.PROTOCOL}",
                remedy="update its firmware, or btfkit",
            )
        if hello.description > _MOST_DESCRIPTION:
            raise DeviceError(f"rig {self.serial} describes itself in {hello.description} bytes")
        text = self.link.description(hello.description)
        self.description = _described(self.serial, text, hello.axes)
        axes = {each["name"]: _axis(each) for each in self.description["axes"]}
        sensor = self.description["sensor"]
        shortest, longest = sensor["exposure_s"]
        limits = CameraLimits(float(shortest), float(longest), tuple(map(float, sensor["isos"])))
        self.stage = UsbStage(self.link, axes, self._watchdog)
        self.camera = UsbCamera(self.link, tuple(axes), sensor, limits, self._watchdog)
        self.light = UsbLight(self.link, tuple(self.description["sources"]), self._watchdog)

    def _end(self) -> None:
        try:
            self.link.request(Command.LAMP, messages.lamp(0))
            self.link.request(Command.STOP)
        except UnpluggedError:
            pass
        finally:
            self._transport.release()


@final
class UsbStage(Stage):
    """Axes behind the wire."""

    def __init__(self, link: Link, axes: Mapping[str, Axis], watchdog: Watchdog) -> None:
        super().__init__(axes, watchdog)
        self._link = link
        self._names = tuple(axes)

    def _home(self) -> None:
        self._link.forget_events()
        self._link.request(Command.HOME)
        ways = [axis.travel_s(axis.high - axis.low) for axis in self.axes.values()]
        self._settled(Event.HOMED, 3 * max(ways) + 5)

    def _move(self, targets: Mapping[str, float]) -> None:
        now = self._position()
        # Only from below, so that backlash is taken up on the same side everywhere.
        below = {
            name: target - self._margin(name)
            for name, target in targets.items()
            if target < now[name] - self.axes[name].resolution
        }
        self._go({**targets, **below})
        if below:
            self._go({name: targets[name] for name in below})
        status = self._status()
        for name, target in targets.items():
            index = self._names.index(name)
            measured, counted = status.encoder[index], status.counter[index]
            off = _OFF_MM if self.axes[name].kind == "linear" else _OFF_RAD
            if abs(measured - target) > off:
                raise PositionError(
                    f"{name} rests at {measured:.6g} instead of {target:.6g}; its step counter "
                    f"says {counted:.6g}",
                    remedy="home the rig; if it happens again, look for what holds the axis",
                )

    def _go(self, targets: Mapping[str, float]) -> None:
        start = self._position()
        way = max(self.axes[n].travel_s(target - start[n]) for n, target in targets.items())
        self._link.forget_events()
        self._link.request(
            Command.MOVE, messages.move({self._names.index(n): t for n, t in targets.items()})
        )
        self._settled(Event.MOVED, 1.5 * way + 2)

    def _settled(self, event: Event, timeout_s: float) -> None:
        ends = (event, Event.LIMIT)
        packet = self._link.event(lambda p: p.code in ends, timeout_s=timeout_s)
        status = self._status()
        if (packet is not None and packet.code == Event.LIMIT) or State.LIMIT in status.state:
            raise PositionError("an axis ran into its limit switch", remedy="home the rig")
        # An event may be lost on the way; the status then tells that the motion is over.
        if packet is None and State.MOVING in status.state:
            raise PositionError(f"the motion has not ended within {timeout_s:.3g} s")

    def _position(self) -> dict[str, float]:
        return dict(zip(self._names, self._status().encoder, strict=True))

    def _status(self) -> Status:
        status = _parsed(Status.parsed, self._link.request(Command.STATUS))
        if State.HOMED not in status.state:
            raise PositionError("the rig does not know its positions", remedy="home it")
        return status

    def _margin(self, name: str) -> float:
        return APPROACH_MM if self.axes[name].kind == "linear" else APPROACH_RAD


@final
class UsbCamera(Camera):
    """A camera behind the wire."""

    def __init__(
        self,
        link: Link,
        axes: tuple[str, ...],
        sensor: Mapping[str, Any],
        limits: CameraLimits,
        watchdog: Watchdog,
    ) -> None:
        super().__init__(sensor, limits, watchdog)
        self._link = link
        self._axes = axes

    def _expose(self, exposure_s: float, iso: float) -> Exposure:
        self._link.forget_events()
        reply = self._link.request(Command.EXPOSE, messages.expose(exposure_s, iso))
        boot, frame = _parsed(messages.STAMP.unpack, reply)

        def of_this(packet: Packet) -> bool:
            stamp = packet.payload[: messages.STAMP.size]
            ends = packet.code in (Event.EXPOSED, Event.FRAME_LOST)
            return ends and messages.STAMP.unpack(stamp) == (boot, frame)

        packet = self._link.event(of_this, timeout_s=exposure_s + 3)
        if packet is None or packet.code == Event.FRAME_LOST:
            raise FrameLostError(f"frame {frame} of {exposure_s:g} s did not come")
        exposed = _parsed(Exposed.parsed, packet.payload)
        data = self._fetch(exposed)
        if zlib.crc32(data) != exposed.crc:
            raise FrameLostError(f"frame {frame} has another CRC than the camera says")
        stamp = messages.STAMP.unpack_from(data) if len(data) >= messages.STAMP.size else None
        if stamp != (boot, frame):
            raise FrameLostError(f"the camera gave exposure {stamp} instead of {(boot, frame)}")
        return self._exposure(exposed, data[messages.STAMP.size :])

    def _fetch(self, exposed: Exposed) -> bytes:
        most = messages.STAMP.size + 2 * 3 * int(self.sensor["width"]) * int(self.sensor["height"])
        if exposed.size > most:
            raise FrameLostError(f"a frame of {exposed.size} bytes; the sensor has {most}")
        try:
            return self._link.fetch(exposed.frame, exposed.size)
        except RefusedError as error:
            if error.refusal is Refusal.NO_FRAME:
                raise FrameLostError(f"frame {exposed.frame} is gone ({error})") from error
            raise

    def _exposure(self, exposed: Exposed, data: bytes) -> Exposure:
        shape = (exposed.height, exposed.width, exposed.channels)
        if len(data) != 2 * shape[0] * shape[1] * shape[2]:
            raise FrameLostError(f"{len(data)} bytes of counts for {shape}")
        counts = np.frombuffer(data, "<u2").reshape(shape)
        return Exposure(
            counts=counts[..., 0] if shape[2] == 1 else counts,
            serial=(exposed.boot, exposed.frame),
            exposure_s=exposed.exposure_s,
            iso=exposed.iso,
            axes=dict(zip(self._axes, exposed.encoder, strict=True)),
            commanded=dict(zip(self._axes, exposed.counter, strict=True)),
            lamp=exposed.lamp,
            temperature_c=exposed.temperature_c,
            time_s=exposed.clock_s,
        )


@final
class UsbLight(Light):
    """Lamp and panel behind the wire."""

    def __init__(self, link: Link, sources: tuple[str, ...], watchdog: Watchdog) -> None:
        super().__init__(sources, watchdog)
        self._link = link

    def _switch(self, source: str | None) -> None:
        code = 0 if source is None else 1 + self.sources.index(source)
        self._link.request(Command.LAMP, messages.lamp(code))

    def _reading(self) -> float:
        return _parsed(Status.parsed, self._link.request(Command.STATUS)).lamp


def _parsed(parse: Callable[[bytes], T], payload: bytes) -> T:
    try:
        return parse(payload)
    except (struct.error, ValueError) as error:
        raise DeviceError(f"a reply of {len(payload)} bytes does not parse ({error})") from error


def _described(serial: str, text: bytes, axes: int) -> dict[str, Any]:
    try:
        document = json.loads(text)
        for name in ("axes", "carries", "camera", "light", "sensor", "sources"):
            document[name]
        if len(document["axes"]) != axes:
            raise ValueError(f"{len(document['axes'])} axes; the firmware has {axes}")
    except (ValueError, KeyError, TypeError) as error:
        raise DeviceError(f"rig {serial} describes itself wrongly ({error!r})") from error
    described: dict[str, Any] = document
    return described


def _axis(entry: Mapping[str, Any]) -> Axis:
    low, high = entry["limits"]
    return Axis(
        name=entry["name"],
        low=low,
        high=high,
        velocity=entry["velocity"],
        acceleration=entry["acceleration"],
        kind=entry["kind"],
        direction=tuple(entry["direction"]),
        point_mm=tuple(entry["point_mm"]),
        resolution=entry["resolution"],
    )
