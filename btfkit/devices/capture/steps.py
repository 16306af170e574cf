"""A plan as steps: one pose each, with what is exposed there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from btfkit import directions
from btfkit.devices.base import Axis
from btfkit.devices.capture.aim import Aim
from btfkit.devices.capture.order import ordered, travel_s
from btfkit.devices.capture.plan import Bracket, Plan, Ramp
from btfkit.devices.poses import Floats

# What a metered bracket is metered on: an area of the target, the whole frame, or its highlights.
SAMPLE, WHITE, FRAME, HIGHLIGHT = "sample", "white", "frame", "highlight"
_STEEPEST_TARGET_DEG, _TARGET_LIGHT_DEG, _SPHERE_TILT_DEG = 72.0, 20.0, 40.0
# Guess at metered times, for estimates alone.
_GUESS_S = 0.02


@final
@dataclass(frozen=True)
class Step:
    """One pose.

    Attributes:
        index: its place in the run, and the group of its frames.
        kind: as in `btfkit.frametable.KINDS`.
        places: of the axes, radians or mm; empty where the pose does not matter.
        source: "lamp", "panel" or None.
        bracket: metered or fixed exposures. meter: what it is metered on.
        pair: row of the plan's pairs, for samples.
    """

    index: int
    kind: str
    places: Mapping[str, float]
    source: str | None
    bracket: Bracket
    meter: str = SAMPLE
    pair: int | None = None

    @property
    def frames(self) -> int:
        """How many it gives at most."""
        return len(self.bracket.times_s) if self.bracket.times_s else self.bracket.count


def steps_of(plan: Plan, description: Mapping[str, Any], axes: Sequence[Axis]) -> tuple[Step, ...]:
    """All steps of a plan, in the order of the run; the same for the same plan and rig.

    Darks and flats come before the lamp is lit and once more at the end; the references for
    white, colour, board and spheres frame the sample's poses; the reference pose is looked at
    first, last, and every so many poses.
    """
    aim = Aim(description)
    build = _Builder(aim, axes)
    for kind, source, ramp in (("dark", None, plan.darks), ("flat", "panel", plan.flats)):
        build.ramp(kind, source, ramp)
    build.reference(plan)
    build.poses("white", *_whites(plan.whites), plan.bracket, WHITE)
    build.poses("colour", *_whites(plan.colours), plan.bracket, WHITE)
    build.poses("target", *_targets(plan.targets), plan.bracket, WHITE)
    build.poses(
        "sphere", *_spheres(plan.spheres), Bracket(2, 64.0, plan.bracket.longest_s), HIGHLIGHT
    )
    places = aim.axes(plan.views[plan.pairs[:, 0]], plan.lights[plan.pairs[:, 1]])
    order = ordered(places, axes)
    for number, row in enumerate(order):
        if plan.reference_every and number and number % plan.reference_every == 0:
            build.reference(plan)
        build.add("sample", places[row], "lamp", plan.bracket, SAMPLE, pair=int(row))
    build.reference(plan)
    build.ramp("dark", None, plan.darks)
    return tuple(build.steps)


def estimate(
    steps: Sequence[Step], plan: Plan, description: Mapping[str, Any], axes: Sequence[Axis]
) -> dict[str, float]:
    """What a run takes: poses, frames, seconds, seconds of travel, and bytes at most.

    Metered exposures are taken for a guess of 20 ms and its multiples.
    """
    names = [axis.name for axis in axes]
    posed = np.array([[s.places[n] for n in names] for s in steps if s.places])
    travel = float(travel_s(posed, axes).sum()) if len(posed) else 0.0
    sensor = description["sensor"]
    exposing = 0.0
    for step in steps:
        times = step.bracket.times_s or [
            min(_GUESS_S * step.bracket.ratio**k, step.bracket.longest_s)
            for k in range(step.bracket.count)
        ]
        metering = 0 if step.bracket.times_s else _GUESS_S + sensor["readout_s"]
        exposing += sum(times) + len(times) * sensor["readout_s"] + metering
        exposing += plan.settle_s if step.places else 0
    frames = sum(step.frames for step in steps)
    channels = 1 if sensor["cfa"] != "none" else 3
    return {
        "poses": len(steps),
        "frames": frames,
        "seconds": travel + exposing,
        "travel_s": travel,
        # PNG of noise saves a quarter of 16 bits; counting none of it errs on the safe side.
        "bytes": float(frames * 2 * channels * sensor["width"] * sensor["height"]),
    }


def reference_step(index: int, aim: Aim, plan: Plan) -> Step:
    """The pose and exposures that are repeated."""
    view, light = _degrees([0.0], [0.0]), _degrees([30.0], [60.0])
    bracket = Bracket(
        1, 2.0, plan.bracket.longest_s, plan.bracket.times_s and (plan.bracket.times_s[0],)
    )
    return Step(index, "reference", _named(aim.axes(view, light)[0]), "lamp", bracket, WHITE)


@final
class _Builder:
    def __init__(self, aim: Aim, axes: Sequence[Axis]) -> None:
        self._aim, self._axes = aim, axes
        self.steps: list[Step] = []

    def add(
        self,
        kind: str,
        places: Floats | None,
        source: str | None,
        bracket: Bracket,
        meter: str,
        *,
        pair: int | None = None,
    ) -> None:
        named = {} if places is None else _named(places)
        self.steps.append(Step(len(self.steps), kind, named, source, bracket, meter, pair))

    def ramp(self, kind: str, source: str | None, ramp: Ramp) -> None:
        for time_s in ramp.times_s:
            if ramp.count:
                self.add(
                    kind,
                    None,
                    source,
                    Bracket(ramp.count, 2.0, time_s, (time_s,) * ramp.count),
                    FRAME,
                )

    def reference(self, plan: Plan) -> None:
        if plan.reference_every:
            self.steps.append(reference_step(len(self.steps), self._aim, plan))

    def poses(self, kind: str, view: Floats, light: Floats, bracket: Bracket, meter: str) -> None:
        places = self._aim.axes(view, light)
        for row in ordered(places, self._axes) if len(places) else ():
            self.add(kind, places[row], "lamp", bracket, meter)


def _named(places: Floats) -> dict[str, float]:
    names = ("turntable", "camera_arm", "light_turn", "light_arm")
    return {name: float(place) for name, place in zip(names, places, strict=True)}


def _degrees(theta: Sequence[float], phi: Sequence[float]) -> Floats:
    return np.asarray(directions.from_angles(np.radians(theta), np.radians(phi)), np.float64)


def _whites(count: int) -> tuple[Floats, Floats]:
    """From above, the lamp at 45 degrees all around."""
    around = 360 * np.arange(count) / max(count, 1)
    return _degrees([0.0] * count, [0.0] * count), _degrees([45.0] * count, around.tolist())


def _targets(count: int) -> tuple[Floats, Floats]:
    """Views spread evenly in tilt and by the golden angle around; the lamp high, and aside."""
    tilt = _STEEPEST_TARGET_DEG * np.arange(count) / max(count - 1, 1)
    around = np.arange(count) * 360 * (2 - (1 + 5**0.5) / 2) % 360
    light = _degrees([_TARGET_LIGHT_DEG] * count, ((around + 90) % 360).tolist())
    return _degrees(tilt.tolist(), around.tolist()), light


def _spheres(count: int) -> tuple[Floats, Floats]:
    """From above and tilted in turn, lamps from straight above to as low as spheres show them.

    From above alone a sphere's height and the lamp's distance would move the highlights alike. Of
    what was tried, lamps by turns high and low tell most of how the lamp's axes lie.
    """
    number = np.arange(count)
    theta = np.array([0.0, 70.0, 40.0, 75.0])[number % 4]
    lights = _degrees(theta.tolist(), (137.5 * number % 360).tolist())
    tilt = np.where(number % 2 == 1, _SPHERE_TILT_DEG, 0.0)
    # About the shorter side of the frame, which keeps all spheres within it.
    around = np.where(number % 4 == 3, 180.0, 0.0)
    return _degrees(tilt.tolist(), around.tolist()), lights
