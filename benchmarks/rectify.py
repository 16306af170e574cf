"""The rate of merging and rectifying: 256 x 256 textures from four exposures of a megapixel.

    python benchmarks/rectify.py [--pairs 200]

Errors against CPU seconds: `btfkit bench rectify`.
"""

from __future__ import annotations

import argparse
import resource
import time

import numpy as np

from btfkit.calibration.camera_model import Camera
from btfkit.calibration.demosaic import colours_of
from btfkit.calibration.kinematics import Rigid
from btfkit.calibration.merge import merge_exposures
from btfkit.calibration.noise import NoiseModel
from btfkit.calibration.rectify import Grid, footprints, rectify

_RATE = (
    "{pairs} textures: {cpu_s:.3f} CPU s each, 6561 take {minutes_6561_two_cores:.1f} min on "
    "two cores, peak {peak_gb:.2f} GB"
)


def rate(pairs: int, rng: np.random.Generator) -> dict[str, float]:
    """CPU seconds a texture, merging included, reading not: views of 25 lights each."""
    camera = Camera(1000, 1000, np.array([4800.0, 4800, 499.5, 499.5, -0.1, 0, 0, 0, 0]))
    radiance = rng.uniform(1e3, 4e4, (1000, 1000))
    times = np.array([0.064, 0.016, 0.004, 0.001])
    raw = [np.clip(200 + radiance * t + rng.normal(0, 3, radiance.shape), 0, 4095).astype(np.uint16)
           for t in times]  # fmt: skip
    noise = NoiseModel(gain=2.5, read=2.0, white=4095.0, black=200.0, dark=0.0)
    sites = np.array([[0, 1], [1, 2]], np.int32)
    grid = Grid(256, 256, 0.5)
    start = time.process_time()
    for pair in range(pairs):
        if pair % 25 == 0:
            tilt = np.radians(75 * (pair // 25) / max(pairs // 25, 1))
            c, s = np.cos(tilt), np.sin(tilt)
            turn = np.diag([1.0, -1, -1]) @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
            where = footprints(camera, Rigid(turn, np.array([0, 0, 700.0])), grid, mosaic=True)
            rows, columns = where.window(1000, 1000, margin=4)
        merged = merge_exposures([f[rows, columns] for f in raw], times, noise)
        rectify(
            merged.radiance[..., None], where, variance=merged.variance[..., None], sites=sites,
            colours=colours_of(merged, "RGGB"), origin=(rows.start, columns.start), threads=1,
        )  # fmt: skip
    seconds = (time.process_time() - start) / pairs
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return {"pairs": pairs, "cpu_s": seconds, "minutes_6561_two_cores": seconds * 6561 / 120,
            "peak_gb": memory}  # fmt: skip


def main() -> None:
    """Print the rate."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pairs", type=int, default=200)
    given = parser.parse_args()
    print(_RATE.format(**rate(given.pairs, np.random.default_rng(0))))


if __name__ == "__main__":
    main()
