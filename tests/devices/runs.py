"""Small runs of the twin, and whether each of their frames is what the twin's log says."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np

from btfkit.devices import mock
from btfkit.devices.capture import plan as plans
from btfkit.devices.capture.journal import read
from btfkit.devices.capture.run import Report, measure
from btfkit.devices.capture.steps import Step
from btfkit.devices.capture.store import finished_groups
from btfkit.devices.faults import Faults
from btfkit.devices.twin.lamp import LAMP, NONE, PANEL
from btfkit.devices.twin.log import Twin, TwinLog
from btfkit.devices.twin.world import World
from btfkit.sequence import Sequence

# Without noise a frame is a function of pose, power, exposure and temperature: it can be made
# again, count for count.
QUIET = Twin("print", 64, 48, seed=5, without=("shot-noise", "read-noise", "monitor"))

SMALL = {
    "version": 1, "name": "small", "views": [[0, 0], [40, 90]], "lights": [[20, 0], [60, 200]],
    "exposures": {"count": 2}, "darks": {"times_s": [0.01, 0.5], "count": 1},
    "flats": {"times_s": [0.01], "count": 2}, "whites": 1, "colours": 1, "targets": 1,
    "spheres": 1, "reference_every": 2,
}  # fmt: skip


class Killed(BaseException):
    """Nothing of the program runs on after it."""


def killed() -> None:
    raise Killed


def run(
    folder: Path,
    *,
    twin: Twin | None = QUIET,
    faults: Faults | None = None,
    resume: bool = False,
    watch: Callable[[Step], None] | None = None,
    document: dict[str, object] = SMALL,
) -> Report:
    """A session of the small plan."""
    log = TwinLog(folder, None if resume else twin)
    rig = mock.open_rig(log.begin(), faults=faults, log=log)
    plan = plans.from_document("small", document)
    return measure(
        rig, plan, folder, resume=resume, faults=faults, watch=watch, kill=killed, synthetic=True
    )


def check_every_frame(folder: Path) -> int:
    """Make each listed frame again from what really was; the number of frames.

    Serial numbers say which exposure the rig counted a frame as; the file must hold just that one.
    """
    log = TwinLog(folder)
    world = _world(log.twin)
    sequence = Sequence.open(folder)
    records = [
        r for group in finished_groups(read(folder / "journal.jsonl")[0]).values() for r in group
    ]
    by_file = {record["file"]: record for record in records}
    assert len(sequence) == len(records)
    for index, frame in enumerate(sequence.frames):
        record = by_file[frame.file]
        entry = log.entries[tuple(record["serial"])]
        for name, angle in entry["angles"].items():
            # Eccentricity 5e-5, three times homing's 3.5e-5, and rounding 1e-5.
            assert abs(frame.axes[name] - angle) < 2e-4, (frame.file, name)
            if record["requested"]:
                assert abs(frame.axes[name] - record["requested"][name]) <= 4e-4
        assert frame.lamp is not None
        assert abs(frame.lamp - entry["power"]) < 1e-12
        np.testing.assert_array_equal(sequence.image(index), _made_again(world, entry, record))
    return len(sequence)


@functools.cache
def _world(twin: Twin) -> World:
    return World(twin.setup())


@functools.lru_cache(maxsize=64)
def _light(world: World, source: int, angles: tuple[tuple[str, float], ...]) -> np.ndarray:
    sensor, scene = world._sensor, world._scene
    if source == PANEL:
        return sensor.filtered(np.repeat(0.5 * scene.lens.flat()[..., None], 3, axis=-1))
    if source == NONE:
        return sensor.filtered(np.zeros((*sensor.size, 3), np.float32))
    return sensor.filtered(scene.image(world.truth.placed(dict(angles))))


def _made_again(world: World, entry: dict, record: dict) -> np.ndarray:
    source = {"dark": NONE, "flat": PANEL}.get(record["kind"], LAMP)
    # The dark does not know its pose.
    angles = tuple(entry["angles"].items()) if source == LAMP else ()
    return world._sensor.exposed(
        _light(world, source, angles) * np.float32(entry["power"]), record["exposure_s"],
        iso=record["iso"], temperature_c=record["temperature_c"], rng=np.random.default_rng(0),
    )  # fmt: skip
