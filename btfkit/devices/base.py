"""Camera, stage, light and rig: the public method checks, a hook drives.

A refused call changes nothing. Every blocking call has a deadline. Three ways to end a motion:

    stop            decelerate; positions stay known; the run may go on
    abort           drop the exposure and every pending command, then stop
    emergency_stop  lamp and motor drivers off at once; positions are lost until the rig is homed
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self, final

import numpy as np
from numpy.typing import NDArray

from btfkit.devices.deadline import Watchdog
from btfkit.devices.owner import Owner
from btfkit.errors import DeviceError

# Added to what a command should take: USB, settling and a busy machine.
_SLACK_S = 10.0
_STOP_S = 6.0


@final
@dataclass(frozen=True)
class Found:
    """A rig that could be opened: its serial number, what it calls itself, the driver's handle."""

    serial: str
    name: str
    device: Any = None


class PositionError(DeviceError):
    """An axis is not where it should be; homing may help."""


class FrameLostError(DeviceError):
    """A frame did not come, or is another than the one asked for; taking it again may help."""


class UnpluggedError(DeviceError):
    """The rig is gone from the bus."""


@final
@dataclass(frozen=True)
class Axis:
    """What is known of one axis.

    Attributes:
        name: as in plans and tables. kind: "rotary" (radians) or "linear" (mm).
        low, high: limits. velocity, acceleration: largest, a second.
        direction, point_mm: of the line it turns about or slides along, lab frame at zero.
        resolution: of the encoder.
    """

    name: str
    low: float
    high: float
    velocity: float
    acceleration: float
    kind: str = "rotary"
    direction: tuple[float, float, float] = (0.0, 0.0, 1.0)
    point_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    resolution: float = 1e-5

    def travel_s(self, distance: float) -> float:
        """Seconds of a move from rest to rest."""
        way = abs(distance)
        ramp = self.velocity**2 / self.acceleration
        if way < ramp:
            return 2 * math.sqrt(way / self.acceleration)
        return way / self.velocity + self.velocity / self.acceleration


@final
@dataclass(frozen=True, eq=False)
class Exposure:
    """One frame as the camera gave it, and what the rig measured meanwhile.

    Attributes:
        counts: (h, w) or (h, w, 3) uint16; empty where the rig's camera is off.
        serial: (boot, frame) numbers, which no two exposures of a rig share.
        exposure_s, iso: as the camera set them.
        axes: measured positions half-way, radians or mm.
        commanded: what the step counters said.
        lamp: reading of the monitor over the exposure, relative to nominal power.
        temperature_c: of the sensor. time_s: of the rig's clock, half-way.
    """

    counts: NDArray[np.uint16]
    serial: tuple[int, int]
    exposure_s: float
    iso: float
    axes: Mapping[str, float]
    commanded: Mapping[str, float]
    lamp: float
    temperature_c: float
    time_s: float


class Stage(ABC):
    """Any number of axes that are moved together."""

    def __init__(self, axes: Mapping[str, Axis], watchdog: Watchdog) -> None:
        self.axes = dict(axes)
        self._watchdog = watchdog

    def home(self) -> None:
        """Find the switches of all axes; from then on positions are known.

        Raises:
            DeviceError: an axis did not find its switch.
        """
        ways = [axis.travel_s(axis.high - axis.low) for axis in self.axes.values()]
        deadline = 3 * max(ways, default=0.0) + _SLACK_S
        self._watchdog.run("homing", self._home, deadline_s=deadline)

    def move_to(self, **targets: float) -> None:
        """Move the named axes, radians or mm, and return once all of them rest.

        Raises:
            DeviceError: unknown axis or target outside its limits: then no axis has moved; or a
                motion that did not end where it should.
        """
        self.check(targets)
        now = self.position()
        times = [self.axes[n].travel_s(target - now[n]) for n, target in targets.items()]
        deadline = 2 * max(times, default=0.0) + _SLACK_S
        self._watchdog.run("a move", lambda: self._move(targets), deadline_s=deadline)

    def check(self, targets: Mapping[str, float]) -> None:
        """Refuse targets that the stage cannot reach; nothing moves.

        Raises:
            DeviceError: unknown axis, or a target that is outside its limits or no number.
        """
        for name, target in targets.items():
            axis = self.axes.get(name)
            if axis is None:
                raise DeviceError(f"no axis {name!r}; this stage has {', '.join(self.axes)}")
            # Rounding of degrees must not refuse the limit itself.
            slack = 1e-9 * max(1.0, abs(axis.low), abs(axis.high))
            if not axis.low - slack <= target <= axis.high + slack:
                raise DeviceError(
                    f"{name} to {_shown(axis, target)}; its limits are {_shown(axis, axis.low)} to "
                    f"{_shown(axis, axis.high)}, and no axis has moved",
                    remedy="change the plan",
                )

    def position(self) -> dict[str, float]:
        """Measured positions, radians or mm.

        Raises:
            DeviceError: positions are not known: the rig is not homed.
        """
        return self._watchdog.run("reading positions", self._position, deadline_s=_SLACK_S)

    @abstractmethod
    def _home(self) -> None: ...

    @abstractmethod
    def _move(self, targets: Mapping[str, float]) -> None: ...

    @abstractmethod
    def _position(self) -> dict[str, float]: ...


@final
@dataclass(frozen=True)
class CameraLimits:
    """What a camera can be asked for: shutter times in seconds, and its speeds."""

    shortest_s: float
    longest_s: float
    isos: tuple[float, ...] = (100.0,)


class Camera(ABC):
    """Takes one frame at a time, counts as the sensor gives them."""

    def __init__(self, sensor: Mapping[str, Any], limits: CameraLimits, watchdog: Watchdog) -> None:
        self.sensor = dict(sensor)
        self.limits = limits
        self._watchdog = watchdog

    def expose(self, exposure_s: float, *, iso: float = 100.0) -> Exposure:
        """Take a frame.

        Raises:
            DeviceError: a time or speed that the camera does not have (then nothing happens), or
                a frame that was lost or is another than the one asked for.
        """
        low, high = self.limits.shortest_s, self.limits.longest_s
        # Sums of powers of two end a rounding beyond a limit.
        if not low * (1 - 1e-9) <= exposure_s <= high * (1 + 1e-9):
            raise DeviceError(f"exposure of {exposure_s:g} s; the camera takes {low:g} to {high:g}")
        if iso not in self.limits.isos:
            listing = ", ".join(f"{each:g}" for each in self.limits.isos)
            raise DeviceError(f"ISO {iso:g}; the camera has {listing}")
        return self._watchdog.run(
            "an exposure",
            lambda: self._expose(exposure_s, iso),
            deadline_s=2 * exposure_s + 6 * _SLACK_S,
        )

    @abstractmethod
    def _expose(self, exposure_s: float, iso: float) -> Exposure: ...


class Light(ABC):
    """The lamp, and where there is one a panel that lights the sensor evenly."""

    def __init__(self, sources: tuple[str, ...], watchdog: Watchdog) -> None:
        self.sources = sources
        self._watchdog = watchdog

    def switch(self, source: str | None) -> None:
        """Light one source alone, or none.

        Raises:
            DeviceError: there is no such source.
        """
        if source is not None and source not in self.sources:
            raise DeviceError(f"no light {source!r}; this rig has {', '.join(self.sources)}")
        self._watchdog.run("switching the light", lambda: self._switch(source), deadline_s=_SLACK_S)

    def reading(self) -> float:
        """Of the monitor, relative to nominal power; about 0 when dark."""
        return self._watchdog.run("reading the lamp", self._reading, deadline_s=_SLACK_S)

    @abstractmethod
    def _switch(self, source: str | None) -> None: ...

    @abstractmethod
    def _reading(self) -> float: ...


class Rig(ABC):
    """Camera, stage and light of one instrument, with one owner.

    Attributes:
        serial: of the instrument.
        stage, camera, light: its parts.
        description: sections "rig" and "target" of sequence.json, nominal.
    """

    def __init__(self, serial: str, watchdog: Watchdog, *, here: bool = False) -> None:
        self.serial = serial
        self._watchdog = watchdog
        # Stops do not wait behind the call that they are to stop.
        self._stops = Watchdog(f"stops of {serial}")
        self._owner = Owner(serial, here=here)
        self._open = False

    stage: Stage
    camera: Camera
    light: Light
    description: Mapping[str, Any]

    def open(self) -> Self:
        """Take the rig: nobody else drives it until `close`. Nothing moves.

        Raises:
            DeviceError: in use, not there, or not what it should be.
        """
        self._owner.take()
        try:
            self._watchdog.run("opening", self._begin, deadline_s=_SLACK_S)
        except BaseException:
            self._owner.release()
            raise
        self._open = True
        return self

    def close(self) -> None:
        """Light off, motion stopped, rig released; also after an error, and twice."""
        if not self._open:
            return
        self._open = False
        try:
            self._watchdog.run("closing", self._end, deadline_s=_SLACK_S)
        finally:
            self._watchdog.close()
            self._stops.close()
            self._owner.release()

    def __enter__(self) -> Self:
        return self if self._open else self.open()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is not None:
            # Whatever was going on, interrupted or failed, does not go on alone.
            with suppress(DeviceError):
                self.abort()
        try:
            self.close()
        except DeviceError:
            # The first error tells more than that a lost rig cannot be told good-bye.
            if error is None:
                raise

    @abstractmethod
    def wait(self, seconds: float) -> None:
        """Let time pass on the rig's clock."""

    @abstractmethod
    def now(self) -> float:
        """The rig's clock, seconds."""

    def stop(self) -> None:
        """Decelerate all axes; positions stay known. May be called from another thread."""
        self._stops.run("a stop", self._stop, deadline_s=_STOP_S)

    def abort(self) -> None:
        """Drop the exposure and all pending commands, then stop. From any thread."""
        self._stops.run("an abort", self._abort, deadline_s=_STOP_S)

    def emergency_stop(self) -> None:
        """Lamp and drivers off at once; the rig must be homed before it moves. From any thread."""
        self._stops.run("an emergency stop", self._emergency_stop, deadline_s=_STOP_S)

    @abstractmethod
    def _stop(self) -> None: ...

    @abstractmethod
    def _abort(self) -> None: ...

    @abstractmethod
    def _emergency_stop(self) -> None: ...

    @abstractmethod
    def _begin(self) -> None: ...

    @abstractmethod
    def _end(self) -> None: ...


def _shown(axis: Axis, value: float) -> str:
    return f"{value:g} mm" if axis.kind == "linear" else f"{math.degrees(value):g}°"
