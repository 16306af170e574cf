"""Directions and focal length that a calibration finds on the twin, over several seeds.

    python benchmarks/geometry.py [--seeds 5] [--spheres 16]

Each seed is another rig with everything wrong with it (640 x 480 mosaic, sixteen views of the
board). Errors are of twelve poses of the sample against where the twin's camera and lamp really
were. About 45 CPU seconds a seed.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from btfkit.calibration.stages import calibrate, geometry_of
from btfkit.devices import mock
from btfkit.devices.capture.plan import from_document
from btfkit.devices.capture.run import measure
from btfkit.devices.twin.log import Twin, TwinLog
from btfkit.devices.twin.truth import truth
from btfkit.devices.twin.world import World
from btfkit.sequence import Sequence

PLAN: dict[str, Any] = {
    "views": 4, "lights": 3, "reference_every": 0, "whites": 0, "colours": 0, "targets": 16,
    "exposures": {"count": 1},
}  # fmt: skip


def found(seed: int, spheres: int) -> dict[str, float]:
    """Worst and rms errors of one rig, degrees; of its focal length, relative."""
    start = os.times()
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        log = TwinLog(run, Twin(seed=seed))
        plan = from_document("geometry", {**PLAN, "spheres": spheres})
        measure(mock.open_rig(log.begin(), log=log), plan, run, synthetic=True)
        sequence = Sequence.open(run)
        geometry = geometry_of(calibrate(sequence)[0])
        groups = sequence.groups("sample").values()
        readings = [sequence.frames[group[0]].axes for group in groups]
        true = truth(run)
        focal = World(log.twin.setup(blind=True)).truth.focal_px[0]
        light = _apart([geometry.light_position("lamp", at) for at in readings], true.light)
        view = _apart([geometry.view_position(at) for at in readings], true.view)
    now = os.times()
    return {
        "seed": seed, "focal": abs(geometry.camera.parameters[0] / focal - 1),
        "view_worst": view.max(), "light_rms": float(np.sqrt((light**2).mean())),
        "light_worst": light.max(), "cpu_s": sum(now[:4]) - sum(start[:4]),
    }  # fmt: skip


def _apart(found: Any, true: Any) -> Any:
    """(n,) degrees between directions (n, 3) of any length."""
    one, other = (np.asarray(each, float) for each in (found, true))
    sine = np.linalg.norm(np.cross(one, other), axis=1)
    return np.degrees(sine / np.linalg.norm(one, axis=1) / np.linalg.norm(other, axis=1))


def main() -> None:
    """A row a seed, then mean and standard deviation over them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--spheres", type=int, default=16)
    given = parser.parse_args()
    rows = []
    for seed in range(1, given.seeds + 1):
        rows.append(found(seed, given.spheres))
        print({name: round(float(value), 6) for name, value in rows[-1].items()}, flush=True)
    for name in list(rows[0])[1:]:
        values = np.array([row[name] for row in rows])
        print(f"{name}: {values.mean():.6f} ± {values.std(ddof=min(1, len(values) - 1)):.6f}")


if __name__ == "__main__":
    main()
