"""The adjustment of a rig: error against CPU seconds with 8, 16 and 48 views.

    python benchmarks/bundle.py [--out bundle.json]

Synthetic: corners of the tests' turntable rig with noise of 0.02 px, to 72 degrees; errors are of
the true points in views that the adjustment has not seen, of the focal length and of directions.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "calibration"))

import turntables

from btfkit.calibration.bundle import Sighting, adjust
from btfkit.calibration.camera_model import Camera
from btfkit.calibration.geometry import Geometry
from btfkit.calibration.kinematics import Axis, Kinematics, Rigid

NOISE_PX = 0.02
_LINE = (
    "{views:3} views {cpu_s:7.2f} s  held out {px:.4f} px, focal {focal:.1e}, "
    "view {view_deg:.5f} deg, condition {condition:.1e}"
)


def cell(count: int, rng: np.random.Generator) -> dict[str, float]:
    """One rig, adjusted from `count` views."""
    rig = turntables.Turntable(rng)
    points = turntables.corners()
    sightings = []
    for k in range(count):
        at = {"tilt": np.radians(72 * k / (count - 1)), "turn": np.radians(137.5 * k)}
        seen = turntables.apply(rig.sample_to_camera(at["tilt"], at["turn"]), points)
        pixels = turntables.project(seen) + NOISE_PX * rng.standard_normal((len(points), 2))
        sightings.append(Sighting(f"view {k}", at, points, pixels))
    axes = tuple(Axis(name, "rotary", *rig.nominal[name]) for name in ("tilt", "turn"))
    lens = np.array([1450.0, 1450, 499.5, 374.5, 0, 0, 0, 0, 0])
    pose = Rigid(rig.nominal_camera[:3, :3], rig.nominal_camera[:3, 3])
    start = Geometry(
        Camera(turntables.WIDTH, turntables.HEIGHT, lens),
        pose,
        Kinematics(axes, {"sample": ("tilt", "turn")}),
    )
    began = time.process_time()
    found = adjust(start, sightings)
    seconds = time.process_time() - began
    square, apart = [], []
    for tilt, turn in zip(np.radians([5, 35, 50, 65, 72]), (0.3, 2.0, 3.3, 4.1, 5.5), strict=True):
        at = {"tilt": tilt, "turn": turn}
        true = turntables.project(turntables.apply(rig.sample_to_camera(tilt, turn), points))
        off = found.geometry.camera.project(found.geometry.sample_to_camera(at)(points)) - true
        square.append((off**2).sum(1).mean())
        view = found.geometry.view_position(at)
        sine = np.linalg.norm(np.cross(view / np.linalg.norm(view), rig.view_direction(tilt, turn)))
        apart.append(np.degrees(sine))
    return {
        "views": count, "cpu_s": seconds, "px": float(np.sqrt(np.mean(square))),
        "focal": abs(found.geometry.camera.parameters[0] / turntables.TRUTH[0] - 1),
        "view_deg": float(max(apart)), "condition": found.condition,
    }  # fmt: skip


def main() -> None:
    """Print a line a cell."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out")
    given = parser.parse_args()
    lines = [cell(count, np.random.default_rng(0)) for count in (8, 16, 48)]
    for line in lines:
        print(_LINE.format(**line))
    if given.out:
        Path(given.out).write_text(json.dumps(lines, indent=1))


if __name__ == "__main__":
    main()
