"""The engine: carries out a plan, recovers from what can be recovered, refuses the rest.

A group of frames (one pose) counts once all of it is on the disk. Whatever goes wrong within it,
it is taken again as a whole; what cannot be put right ends the run with a reason, and `resume`
goes on from the groups that count.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit.devices.base import Exposure, FrameLostError, PositionError, Rig
from btfkit.devices.capture.aim import Aim
from btfkit.devices.capture.drift import Drift, compared
from btfkit.devices.capture.journal import Record
from btfkit.devices.capture.lamp import LampError, Lighting
from btfkit.devices.capture.metering import metered, on_grid
from btfkit.devices.capture.plan import Plan
from btfkit.devices.capture.progress import Observer, Progress
from btfkit.devices.capture.steps import FRAME, HIGHLIGHT, WHITE, Step, steps_of
from btfkit.devices.capture.store import FRAMES, Store, finished_groups
from btfkit.errors import DeviceError

_TRIES = 4
# A pose whose exposures lie further from what was asked than this is not that pose.
_OFF_RAD = 4e-4
_GUESS_S = 0.02


@final
class Engine:
    """One session of a run.

    Args:
        rig: open. plan: to carry out. store: what keeps frames and records.
        observer: told after each group.
        watch: told each step before it begins.

    Attributes:
        steps: all of the run. frames, retries: counted over the session.
    """

    def __init__(
        self,
        rig: Rig,
        plan: Plan,
        store: Store,
        *,
        observer: Observer | None = None,
        watch: Callable[[Step], None] | None = None,
    ) -> None:
        self._rig, self._plan, self._store = rig, plan, store
        self._observer, self._watch = observer, watch
        axes = [rig.stage.axes[name] for name in rig.stage.axes]
        self._aim = Aim(rig.description)
        self.steps = steps_of(plan, rig.description, axes)
        self._check_plan()
        self.frames = self.retries = 0
        self._lighting = Lighting(rig, plan.warm_s)
        self._rehomed = False
        self._guesses: dict[str, float] = {}
        self._offset_s = 0.0
        self._drift: Drift | None = None
        self._first: Record | None = None
        self._sees: bool | None = None
        self._image = np.zeros((0, 0), np.uint16)
        self._windows: dict[tuple[str, tuple[float, ...]], NDArray[np.bool_]] = {}

    def run(self) -> None:
        """Take all groups that are not there yet.

        Raises:
            DeviceError: what cannot be put right; what is finished stays.
        """
        done = finished_groups(self._store.records)
        references = [
            frames for _, frames in sorted(done.items()) if frames[0]["kind"] == "reference"
        ]
        self._first = references[0][0] if references else None
        self._begin_session()
        self._home()
        # With frames of earlier sessions there, the first thing is to see whether they mix.
        self._rehomed = True
        for step in self.steps:
            if step.index not in done:
                self._take(step)
            self._tell(step)
        self._rig.light.switch(None)
        self._store.note({"record": "done", "frames": self.frames, "retries": self.retries})

    def _begin_session(self) -> None:
        """Note the session; times go on from the one before."""
        earlier = [r for r in self._store.records if r["record"] == "session"]
        if earlier and earlier[0]["serial"] != self._rig.serial:
            raise DeviceError(
                f"the run was begun on rig {earlier[0]['serial']}; this is {self._rig.serial}",
                remedy="resume it on its own rig",
            )
        times = [r["time_s"] for r in self._store.records if "time_s" in r]
        now = self._rig.now()
        self._offset_s = max(0.0, max(times, default=now) + 1 - now) if times else -now
        self._store.note(
            {
                "record": "session",
                "number": len(earlier),
                "serial": self._rig.serial,
                "plan": self._plan.hash,
                "time_s": now + self._offset_s,
            }
        )

    def _check_plan(self) -> None:
        """Refuse before anything moves what the rig cannot do."""
        limits = self._rig.camera.limits
        if self._plan.iso not in limits.isos:
            raise DeviceError(
                f"the plan asks for ISO {self._plan.iso:g}; the camera has {limits.isos}"
            )
        for step in self.steps:
            self._rig.stage.check(step.places)
            for time_s in step.bracket.times_s or ():
                if not limits.shortest_s <= time_s <= limits.longest_s:
                    raise DeviceError(
                        f"the plan asks for {step.kind} frames of {time_s:g} s; the camera takes "
                        f"{limits.shortest_s:g} to {limits.longest_s:g}"
                    )

    def _take(self, step: Step) -> None:
        """A group, again if need be."""
        last: DeviceError | None = None
        for attempt in range(_TRIES):
            try:
                if self._watch is not None:
                    self._watch(step)
                if self._rehomed:
                    self._look_again()
                self._attempt(step, attempt)
                return
            except PositionError as error:
                last = error
                self._again(step, attempt, error)
                self._home()
                self._rehomed = True
            except LampError as error:
                last = error
                self._again(step, attempt, error)
                self._lighting.relight()
            except FrameLostError as error:
                last = error
                self._again(step, attempt, error)
        raise DeviceError(
            f"{step.kind} frames of group {step.index} failed {_TRIES} times; the last: {last}",
            remedy="look at the rig, then start again with --resume",
        )

    def _again(self, step: Step, attempt: int, error: DeviceError) -> None:
        self.retries += 1
        self._store.note(
            {"record": "retry", "group": step.index, "attempt": attempt, "why": str(error)}
        )

    def _attempt(self, step: Step, attempt: int) -> None:
        self._lighting.use(step.source)
        if step.places:
            self._rig.stage.move_to(**step.places)
            self._rig.wait(self._plan.settle_s)
        times = self._times(step)
        self._store.note(
            {"record": "pose", "group": step.index, "kind": step.kind, "requested": step.places,
             "attempt": attempt}
        )  # fmt: skip
        for number, time_s in enumerate(times):
            exposure = self._exposed(step, time_s)
            name = f"{FRAMES}/{step.index:06d}-{number}.png"
            record = self._record(step, attempt, exposure)
            self._store.frame(name, exposure.counts, record)
            self.frames += 1
            self._image = exposure.counts
        self._store.note({"record": "group", "group": step.index, "frames": len(times)})
        if step.kind == "reference":
            last = {**record, "file": name}
            self._first = self._first or last
            if self._first is not last:
                self._judge(step, self._first, exposure.counts, exposure.lamp, exposure.exposure_s)

    def _record(self, step: Step, attempt: int, exposure: Exposure) -> Record:
        return {
            "record": "frame",
            "group": step.index,
            "kind": step.kind,
            "pair": step.pair,
            "requested": step.places,
            "axes": dict(exposure.axes),
            "commanded": dict(exposure.commanded),
            "exposure_s": exposure.exposure_s,
            "iso": exposure.iso,
            "lamp": exposure.lamp,
            "temperature_c": exposure.temperature_c,
            "time_s": exposure.time_s + self._offset_s,
            "serial": list(exposure.serial),
            "retries": attempt,
        }

    def _exposed(self, step: Step, time_s: float) -> Exposure:
        """A frame that is what was asked for."""
        exposure = self._rig.camera.expose(time_s, iso=self._plan.iso)
        for name, place in step.places.items():
            if abs(exposure.axes[name] - place) > _OFF_RAD:
                raise PositionError(
                    f"{name} stood at {exposure.axes[name]:.6g} instead of {place:.6g} during the "
                    "exposure"
                )
        self._lighting.check(step.source, exposure)
        return exposure

    def _times(self, step: Step) -> tuple[float, ...]:
        """Exposures of a step: fixed, those of the first reference, or metered."""
        if step.bracket.times_s is not None:
            return step.bracket.times_s
        if step.kind == "reference" and self._first is not None:
            return (self._first["exposure_s"],)
        guess = self._guesses.get(step.kind, _GUESS_S)
        if self._blind(step, guess):
            times = [
                min(on_grid(_GUESS_S) * step.bracket.ratio**k, step.bracket.longest_s)
                for k in range(step.bracket.count)
            ]
            return tuple(dict.fromkeys(times))
        found = metered(
            lambda time_s: self._exposed(step, time_s).counts,
            guess,
            step.bracket,
            sensor=self._rig.description["sensor"],
            window=self._window(step),
        )
        self._guesses[step.kind] = found[0]
        return found

    def _blind(self, step: Step, guess_s: float) -> bool:
        """Whether the rig's camera gives no pixels; asked once."""
        if self._sees is None:
            self._sees = self._exposed(step, on_grid(guess_s)).counts.size > 0
        return not self._sees

    def _window(self, step: Step) -> NDArray[np.bool_] | None:
        target = self._rig.description.get("target", {})
        if step.meter == HIGHLIGHT:
            return None
        area = target.get("white" if step.meter == WHITE else "sample")
        if step.meter == FRAME or area is None or not step.places:
            return np.ones(self._shape(), bool)
        # The lamp's axes do not move the picture.
        key = (step.meter, (step.places["turntable"], step.places["camera_arm"]))
        if key not in self._windows:
            self._windows = {key: self._aim.window(step.places, area)}
        return self._windows[key]

    def _shape(self) -> tuple[int, int]:
        sensor = self._rig.description["sensor"]
        return int(sensor["height"]), int(sensor["width"])

    def _home(self) -> None:
        for attempt in range(_TRIES):
            try:
                self._rig.stage.home()
            except PositionError:
                if attempt == _TRIES - 1:
                    raise
            else:
                return

    def _look_again(self) -> None:
        """After homing within a run: are the poses still those of before?"""
        if self._first is not None:
            self._check_reference(self._first)
        self._rehomed = False

    def _check_reference(self, first: Record) -> None:
        """Take the reference pose anew, keeping nothing, and compare.

        Raises:
            DeviceError: it moved, or its level changed, by more than the plan allows.
        """
        step = next(step for step in self.steps if step.kind == "reference")
        self._lighting.use(step.source)
        self._rig.stage.move_to(**step.places)
        self._rig.wait(self._plan.settle_s)
        exposure = self._exposed(step, first["exposure_s"])
        self._judge(step, first, exposure.counts, exposure.lamp, exposure.exposure_s)

    def _judge(
        self, step: Step, first: Record, image: NDArray[np.uint16], lamp: float, exposure_s: float
    ) -> None:
        if not image.size:
            return
        window = self._window(step)
        drift = compared(
            np.asarray(self._store.image(first["file"])),
            image,
            black=float(self._rig.description["sensor"]["black"]),
            scale=lamp * exposure_s / (first["lamp"] * first["exposure_s"]),
            window=np.ones(self._shape(), bool) if window is None else window,
        )
        self._drift = drift
        self._store.note(
            {"record": "drift", "level": drift.level, "shift_px": drift.shift_px,
             "time_s": self._rig.now() + self._offset_s}
        )  # fmt: skip
        if (
            abs(drift.level) > self._plan.reference_level
            or drift.shift_px > self._plan.reference_px
        ):
            raise DeviceError(
                f"the reference has changed by {100 * drift.level:.2f} % and moved by "
                f"{drift.shift_px:.2f} px since the run began; the plan allows "
                f"{100 * self._plan.reference_level:g} % and {self._plan.reference_px:g} px",
                remedy="find what moved; frames before and after do not mix: begin a new run",
            )

    def _tell(self, step: Step) -> None:
        if self._observer is not None:
            self._observer(
                Progress(step.index + 1, len(self.steps), step.kind, self.frames, self.retries,
                         self._drift, self._image)
            )  # fmt: skip
