"""One axis of the twin: motor, gear with play, encoder; velocity and acceleration are finite."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final

import numpy as np

from btfkit.devices.base import Axis
from btfkit.devices.twin.imperfections import Imperfections

_BACKLASH = {"rotary": math.radians(0.05), "linear": 0.02}
_ECCENTRICITY = math.radians(0.003)
_HOMING = {"rotary": math.radians(0.002), "linear": 0.002}
# What a motor slips by when it loses steps.
_SLIP = {"rotary": math.radians(0.5), "linear": 0.3}


@final
@dataclass(frozen=True)
class Profile:
    """A motion along one line from rest: up to speed, along, and down to rest; or braking."""

    start: float
    way: float
    began_s: float
    velocity: float
    acceleration: float
    braking: bool = False

    @property
    def ends_s(self) -> float:
        """When it rests."""
        if self.braking:
            return self.began_s + self.velocity / self.acceleration
        ramp, peak = self._ramp()
        return self.began_s + 2 * ramp + max(abs(self.way) - peak * ramp, 0) / peak

    def at(self, time_s: float) -> float:
        """Position; the end position from `ends_s` on."""
        if time_s >= self.ends_s:
            return self.start + self.way
        t = max(time_s - self.began_s, 0.0)
        sign = math.copysign(1.0, self.way)
        if self.braking:
            return self.start + sign * (self.velocity * t - self.acceleration * t * t / 2)
        ramp, peak = self._ramp()
        if t < ramp:
            return self.start + sign * self.acceleration * t * t / 2
        left = self.ends_s - time_s
        if left < ramp:
            return self.start + self.way - sign * self.acceleration * left * left / 2
        return self.start + sign * peak * (t - ramp / 2)

    def speed(self, time_s: float) -> float:
        """Absolute velocity."""
        if not self.began_s <= time_s < self.ends_s:
            return 0.0
        if self.braking:
            return self.velocity - self.acceleration * (time_s - self.began_s)
        _, peak = self._ramp()
        since, left = time_s - self.began_s, self.ends_s - time_s
        return min(peak, self.acceleration * since, self.acceleration * left)

    def braked(self, time_s: float) -> Profile:
        """The same, slowed down from now on."""
        speed = self.speed(time_s)
        way = math.copysign(speed**2 / (2 * self.acceleration), self.way)
        return Profile(self.at(time_s), way, time_s, speed, self.acceleration, braking=True)

    def _ramp(self) -> tuple[float, float]:
        """Seconds to full speed, and that speed."""
        peak = min(self.velocity, math.sqrt(abs(self.way) * self.acceleration))
        return peak / self.acceleration, max(peak, 1e-12)


@final
class Motor:
    """One axis that moves in time.

    The counter says what was commanded, the shaft where the axis is, the encoder what is measured.
    """

    def __init__(self, axis: Axis, imperfections: Imperfections, rng: np.random.Generator) -> None:
        self.axis = axis
        self._backlash = imperfections.of("backlash", _BACKLASH[axis.kind])
        self._homing = imperfections.of("homing", _HOMING[axis.kind])
        rotary = axis.kind == "rotary"
        self._eccentricity = imperfections.of("eccentricity", _ECCENTRICITY) if rotary else 0.0
        self._step = imperfections.of("eccentricity", axis.resolution)
        self._phase = rng.uniform(0, 2 * math.pi)
        self._rng = rng
        self._slipped = 0.0
        self._zero = 0.0
        self._switched: float | None = None
        # Where a rig stands when it is switched on is nobody's plan.
        rest = axis.low + (axis.high - axis.low) * rng.uniform(0.3, 0.6)
        self._profile = Profile(rest, 0.0, 0.0, axis.velocity, axis.acceleration)
        self._shaft = rest

    def counter(self, time_s: float) -> float:
        """Position by the steps that were sent."""
        return self._profile.at(time_s)

    def shaft(self, time_s: float) -> float:
        """Where the axis really is."""
        return self._followed(self._motor(time_s))

    def encoder(self, time_s: float) -> float:
        """Where it is measured to be."""
        shaft = self.shaft(time_s)
        measured = shaft + self._eccentricity * math.sin(shaft + self._phase) - self._zero
        return round(measured / self._step) * self._step if self._step else measured

    def moving(self, time_s: float) -> bool:
        """Whether steps are still being sent."""
        return time_s < self._profile.ends_s

    @property
    def ends_s(self) -> float:
        """When the motion is over."""
        return self._profile.ends_s

    def start(self, target: float, time_s: float) -> None:
        """Begin to move there."""
        now = self._settle(time_s)
        self._profile = Profile(
            now, target - now, time_s, self.axis.velocity, self.axis.acceleration
        )

    def stop(self, time_s: float) -> None:
        """Slow down; where it then rests is known."""
        if self.moving(time_s):
            self._shaft = self.shaft(time_s)
            self._profile = self._profile.braked(time_s)

    def freeze(self, time_s: float) -> None:
        """Cut the current: the axis stays, and steps that were under way are lost."""
        self._shaft = self.shaft(time_s)
        here = self._profile.at(time_s)
        self._profile = Profile(here, 0.0, time_s, self.axis.velocity, self.axis.acceleration)

    def slip(self) -> None:
        """Lose steps in the present motion."""
        self._slipped += math.copysign(_SLIP[self.axis.kind], self._profile.way)

    def home(self, time_s: float) -> None:
        """Begin to look for the switch at the lower end, and count from there."""
        self._slipped, self._zero = 0.0, self._homing * self._rng.standard_normal()
        self.start(self.axis.low, time_s)

    def _motor(self, time_s: float) -> float:
        return self._profile.at(time_s) - self._slipped

    def _followed(self, motor: float) -> float:
        """The shaft lies within the play above the motor: going up it is pushed without any."""
        return min(max(self._shaft, motor), motor + self._backlash)

    def _settle(self, time_s: float) -> float:
        self._shaft = self.shaft(time_s)
        return self._profile.at(time_s)
