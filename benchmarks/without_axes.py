"""The loop on frames of somebody else's rig: no axes, a board in view, places as a table has them.

    python benchmarks/without_axes.py [--seed 8] [--small]

A run of the twin with everything wrong with it loses its axes: each line of the table keeps where
lamp and camera would be if the rig were as drawn (the lamp is up to 2 mm off, axes 0.1 degrees).
Poses come from the board in view. Beside it the same frames with their axes. About 180 CPU seconds.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from loop import PLAN, SMALL

from btfkit.bench.loop import Looped, compare
from btfkit.calibration.calibration import NAME
from btfkit.calibration.nominal import LAMP, nominal
from btfkit.calibration.stages import calibrate
from btfkit.devices import mock
from btfkit.devices.capture.plan import from_document
from btfkit.devices.capture.run import measure
from btfkit.devices.twin.log import Twin, TwinLog
from btfkit.sequence import DOCUMENT, Frame, Sequence, save


def stripped(run: Path, to: Path) -> Path:
    """A copy of a run as another program would have written it."""
    shutil.copytree(run, to)
    sequence = Sequence.open(run)
    drawn = nominal(sequence)

    def told(frame: Frame) -> Frame:
        if not frame.axes:
            return frame
        lamp = drawn.light_position(LAMP, frame.axes)
        view = drawn.view_position(frame.axes)
        x, y, z = (float(v) for v in view / np.linalg.norm(view))
        places = {f"light_{c}_mm": repr(float(v)) for c, v in zip("xyz", lamp, strict=True)}
        return replace(frame, axes={}, view=(x, y, z), extra={**frame.extra, **places})

    document = json.loads((run / DOCUMENT).read_text())
    document["rig"] = {}
    save(to, map(told, sequence.frames), document, force=True)
    return to


def looped(run: Path) -> Looped:
    """A run against its truth."""
    found, _ = calibrate(Sequence.open(run))
    found.save(run / NAME)
    print(f"missing: {dict(found.missing)}")
    return compare(run)


def main() -> None:
    """A line with axes and one without."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=8)
    parser.add_argument("--small", action="store_true")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        size = (320, 240) if given.small else (640, 480)
        log = TwinLog(run, Twin(width=size[0], height=size[1], seed=given.seed))
        plan = from_document("loop", SMALL if given.small else PLAN)
        measure(mock.open_rig(log.begin(), log=log), plan, run, synthetic=True)
        other = stripped(run, Path(folder) / "other")
        for name, where in (("axes", run), ("no axes", other)):
            found = looped(where)
            print(
                f"{name}: {found.psnr():.1f} dB, views {found.view.max():.3f} degrees off, lights "
                f"{found.light.max():.3f}, scale {abs(found.scale - 1).max():.4f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
