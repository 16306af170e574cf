"""A whole run: folder, engine and table, from a plan to a sequence."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import final

from btfkit.devices.base import Rig
from btfkit.devices.capture.engine import Engine
from btfkit.devices.capture.plan import Plan
from btfkit.devices.capture.progress import Observer
from btfkit.devices.capture.steps import Step, estimate, steps_of
from btfkit.devices.capture.store import Folder, begin, finished_groups
from btfkit.devices.faults import Faults


@final
@dataclass(frozen=True)
class Report:
    """What a run came to: groups and frames that are there, and what this session did."""

    groups: int
    frames: int
    taken: int
    retries: int
    seconds: float


def measure(
    rig: Rig,
    plan: Plan,
    path: Path,
    *,
    resume: bool = False,
    faults: Faults | None = None,
    observer: Observer | None = None,
    watch: Callable[[Step], None] | None = None,
    kill: Callable[[], None] | None = None,
    synthetic: bool = False,
) -> Report:
    """Carry out a plan into a sequence folder.

    Args:
        rig: opened and closed here. plan: to carry out. path: of the folder.
        resume: go on with the run that is there.
        faults, kill: put in on purpose. observer, watch: told of groups done, and begun.
        synthetic: whether the rig is a twin; the sequence then says so.

    Raises:
        DeviceError: what cannot be put right; finished groups are kept and listed.
    """
    with rig:
        axes = list(rig.stage.axes.values())
        storage = estimate(steps_of(plan, rig.description, axes), plan, rig.description, axes)
        begin(path, plan.document, resume=resume, storage=storage["bytes"])
        folder = Folder(path, faults=faults, kill=kill)
        began = rig.now()
        try:
            folder.check_frames()
            engine = Engine(rig, plan, folder, observer=observer, watch=watch)
            try:
                engine.run()
            except (Exception, KeyboardInterrupt):
                # The first error is the one to tell, also where the disk is full.
                with suppress(OSError):
                    folder.finish(rig.description, complete=False, synthetic=synthetic)
                raise
            folder.finish(rig.description, complete=True, synthetic=synthetic)
            groups = finished_groups(folder.records)
            frames = sum(len(each) for each in groups.values())
            return Report(len(groups), frames, engine.frames, engine.retries, rig.now() - began)
        finally:
            folder.close()
