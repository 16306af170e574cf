"""The loop's error by view angle, and each imperfection's share of it.

    python benchmarks/loop.py                                  # a handful of imperfections
    python benchmarks/loop.py --without mosaic prnu --seed 3
    python benchmarks/loop.py --small --without every          # all of them, on a small sensor

Each row is a whole run of the twin: capture, calibrate, rectify, compare with the traced truth.
About 45 CPU seconds a row, 20 of the small one (320 x 240, four pairs, 32 x 32 texels).
"""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path
from typing import Any

from btfkit.bench.loop import Looped, compare
from btfkit.calibration.calibration import NAME
from btfkit.calibration.stages import calibrate
from btfkit.devices import mock
from btfkit.devices.capture.plan import from_document
from btfkit.devices.capture.run import measure
from btfkit.devices.twin.imperfections import IMPERFECTIONS
from btfkit.devices.twin.log import Twin, TwinLog, everything
from btfkit.sequence import Sequence

PLAN: dict[str, Any] = {
    "views": 4, "lights": 3, "reference_every": 30, "whites": 3, "colours": 1, "targets": 16,
    "spheres": 12,
}  # fmt: skip
SMALL: dict[str, Any] = {
    **PLAN, "views": [[0, 0], [60, 120]], "lights": [[30, 60], [60, 250]], "whites": 2,
    "targets": 7, "spheres": 8,
}  # fmt: skip
HANDFUL = ("mosaic", "defocus", "shot-noise")


def looped(folder: Path, twin: Twin, plan: dict[str, Any]) -> Looped:
    """One run of the twin against its truth."""
    run = folder / "run"
    log = TwinLog(run, twin)
    rig = mock.open_rig(log.begin(), log=log)
    measure(rig, from_document("loop", plan), run, synthetic=True)
    found, _ = calibrate(Sequence.open(run))
    found.save(run / NAME)
    return compare(run)


def main() -> None:
    """A row for all imperfections, for none, and without each alone."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--without", nargs="*", default=list(HANDFUL))
    parser.add_argument("--seed", type=int, default=8)
    parser.add_argument("--small", action="store_true")
    given = parser.parse_args()
    names = list(IMPERFECTIONS) if given.without == ["every"] else given.without
    rows: dict[str, tuple[str, ...]] = {"all": (), "none": everything()}
    rows |= {f"all but {name}": (name,) for name in names}
    size = {"width": 320, "height": 240} if given.small else {}
    first: float | None = None
    for name, without in rows.items():
        start = os.times()
        twin = Twin(seed=given.seed, without=without, **size)
        with tempfile.TemporaryDirectory() as folder:
            found = looped(Path(folder), twin, SMALL if given.small else PLAN)
        now = os.times()
        cpu = sum(now[:4]) - sum(start[:4])
        error = 10 ** (-found.psnr() / 10)
        first = error if first is None else first
        by_view = [found.psnr(tilt) for tilt in sorted(set(found.tilt.tolist()))]
        cells = [*(f"{value:.1f}" for value in (*by_view, found.psnr()))]
        cells += [f"{100 * (1 - error / first):.0f} %", f"{found.view.max():.3f}"]
        cells += [f"{found.light.max():.3f}", f"{abs(found.scale - 1).max():.3f}", f"{cpu:.0f}"]
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
