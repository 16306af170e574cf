"""How well mirror spheres in photographs tell lights, by their size and number.

    python benchmarks/lights.py [--json]

Photographs are traced (tests/calibration/balls.py): balls of 25 mm on gravel under a round lamp of
12 mm radius, 400 mm away, 8-bit JPEG of quality 95; a far camera, and one at 800 mm. Synthetic.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from btfkit.calibration.rti import calibrate_lights
from btfkit.colour import to_srgb

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "calibration"))
from balls import Scene, dome

PLACES = ((-45, 25), (40, -22), (35, 28))


def measured(radius_px: int, count: int, camera_mm: float | None) -> dict[str, Any]:
    """Errors of six lights on `count` balls of a radius in pixels."""
    scale = radius_px / 50
    scene = Scene(
        tuple((place, 12.5) for place in PLACES[:count]),
        width=round(480 * scale), height=round(320 * scale), mm_per_px=0.25 / scale,
        camera_mm=camera_mm,
    )  # fmt: skip
    lamps = dome(6, lowest=30)
    with tempfile.TemporaryDirectory() as name:
        for i, lamp in enumerate(lamps):
            codes = np.rint(255 * to_srgb(scene.photograph(lamp, i))).astype(np.uint8)
            cv2.imwrite(f"{name}/{i}.jpg", codes, [cv2.IMWRITE_JPEG_QUALITY, 95])
        start = time.process_time()
        table = calibrate_lights(Path(name), sphere_mm=25, focal_px=scene.focal_px())
        seconds = time.process_time() - start
    if count == 1:
        # One ball tells directions from where it shows the lamp, seen from straight above.
        centre = np.array([*PLACES[0], 12.5])
        to = lamps - centre
        for _ in range(20):
            half = to / np.linalg.norm(to, axis=1, keepdims=True) + [0, 0, 1]
            to = lamps - centre - 12.5 * half / np.linalg.norm(half, axis=1, keepdims=True)
        lamps = to
    found = np.array([light.direction for light in table.found])
    true = lamps / np.linalg.norm(lamps, axis=1, keepdims=True)
    cross = np.linalg.norm(np.cross(found, true), axis=1)
    angle = np.degrees(np.arctan2(cross, np.sum(found * true, axis=1)))
    placed = [x.position for x in table.found if x.position is not None]
    off = np.linalg.norm(np.array(placed) - lamps, axis=1) if len(placed) == len(lamps) else None
    return {
        "radius_px": radius_px, "spheres": count, "camera": "far" if camera_mm is None else "near",
        "direction_deg": float(np.sqrt(np.mean(angle**2))), "said_deg": table.error_deg,
        "position_mm": None if off is None else float(np.sqrt(np.mean(off**2))),
        "cpu_s_a_photograph": seconds / len(lamps),
    }  # fmt: skip


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", action="store_true", help="one JSON object")
    options = parser.parse_args()
    rows = [
        measured(radius, count, camera)
        for radius in (50, 150)
        for count in (1, 2, 3)
        for camera in (None, 800.0)
    ]
    if options.json:
        print(json.dumps(rows))
        return
    print(" ".join(f"{name:>18}" for name in rows[0]))
    for row in rows:
        cells = (
            "" if v is None else f"{v:.3f}" if isinstance(v, float) else v for v in row.values()
        )
        print(" ".join(f"{cell:>18}" for cell in cells))


if __name__ == "__main__":
    main()
