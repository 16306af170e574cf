"""Rectification: error against CPU seconds of bilinear samples, areas and Gaussians; and the rate.

    python benchmarks/rectify.py [--pairs 200] [--out rectify.json]

The cloth is synthetic: pixels and texels are integrated from the same fine samples. Errors are
signal to noise against the mean over a texel's area, and against its Gaussian of half a texel.
The rate is that of 256 x 256 textures from four exposures of a one-megapixel mosaic.
"""

from __future__ import annotations

import argparse
import json
import resource
import time

import numpy as np
from scipy import ndimage

from btfkit.calibration.camera_model import Camera
from btfkit.calibration.kinematics import Rigid
from btfkit.calibration.merge import merge_exposures
from btfkit.calibration.noise import NoiseModel
from btfkit.calibration.rectify import Grid, footprints, rectify
from btfkit.native import resample

SCALE, FINE = 3.3, 6
_LINE = (
    "{method:9} {texels:4} texels {tilt_deg:4.0f} deg {cpu_s:8.4f} s  "
    "area {area_db:5.1f} dB  Gaussian {gaussian_db:5.1f} dB"
)
_RATE = (
    "{pairs} textures: {cpu_s:.3f} CPU s each, 6561 take {minutes_6561_two_cores:.1f} min on "
    "two cores, peak {peak_gb:.2f} GB"
)


def cloth(texels: int, rng: np.random.Generator) -> np.ndarray:
    """A weave with fibres, SCALE * FINE samples a texel and 150 more on every side."""
    size = int(texels * SCALE * FINE) + 300
    y, x = np.mgrid[:size, :size] / (SCALE * FINE)
    warp, weft = (0.5 + 0.5 * np.sin(2 * np.pi * at / 4.37) for at in (x, y))
    over = (np.floor(2 * x / 4.37) + np.floor(2 * y / 4.37)) % 2 > 0
    fibres = ndimage.gaussian_filter(rng.standard_normal((size, size)), 1.2)
    return np.clip(np.where(over, warp, weft) * 0.6 + 0.2 + 0.12 * fibres / fibres.std(), 0.02, 2)


def integrated(fine: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Means over the rectangles between edges, in samples."""
    total = np.cumsum(np.cumsum(np.pad(fine, ((1, 0), (1, 0))), 0), 1)
    at = ndimage.map_coordinates(total, np.meshgrid(rows, columns, indexing="ij"), order=1)
    return np.diff(np.diff(at, axis=0), axis=1) / (np.diff(rows)[:, None] * np.diff(columns))


def snr_db(truth: np.ndarray, found: np.ndarray) -> float:
    """Variance of the truth over the mean square of the error."""
    return float(10 * np.log10(np.var(truth) / np.mean((found - truth) ** 2)))


def cells(texels: int, tilt_deg: float, rng: np.random.Generator) -> list[dict[str, object]]:
    """One line a method, at one size and one tilt."""
    fine = cloth(texels, rng)
    tilt = np.radians(tilt_deg)
    wide, span = FINE / np.cos(tilt), texels * SCALE * FINE
    columns = np.arange(150 - 140 // wide * wide, 150 + span + 140, wide)
    rows = np.arange(150 - 140 // FINE * FINE, 150 + span + 140, FINE)
    frame = integrated(fine, rows, columns).astype(np.float32)[..., None]
    middle = 150 + (np.arange(texels) + 0.5) * SCALE * FINE
    place = np.meshgrid((middle - columns[0]) / wide - 0.5, (middle - rows[0]) / FINE - 0.5)
    place = np.stack(place, -1).reshape(-1, 2)
    slope = np.diag([SCALE * np.cos(tilt), SCALE])
    edges = 150 + np.arange(texels + 1) * SCALE * FINE
    area_truth = integrated(fine, edges, edges)
    blurred = ndimage.gaussian_filter(fine, 0.5 * SCALE * FINE, truncate=6)
    at = np.meshgrid(middle - 0.5, middle - 0.5, indexing="ij")
    gauss_truth = ndimage.map_coordinates(blurred, at, order=1)
    extra = np.maximum(0.25 * np.diag(slope) ** 2 - 1 / 12, 0.25)
    packed = np.array([resample.KEPT / extra[0], 0, resample.KEPT / extra[1]], np.float32)
    count = len(place)
    methods = {
        "bilinear": lambda: ndimage.map_coordinates(frame[..., 0], place[:, ::-1].T, order=1),
        "area": lambda: (
            resample.area(
                frame, place, np.tile(slope.astype(np.float32), (count, 1, 1)), threads=1
            ).value
        ),
        "ewa": lambda: resample.ewa(frame, place, np.tile(packed, (count, 1)), threads=1).value,
    }
    out = []
    for name, method in methods.items():
        start = time.process_time()
        found = method().reshape(texels, texels)
        seconds = time.process_time() - start
        out.append({
            "method": name, "texels": texels, "tilt_deg": tilt_deg, "cpu_s": seconds,
            "area_db": snr_db(area_truth, found), "gaussian_db": snr_db(gauss_truth, found),
        })  # fmt: skip
    return out


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
            rows, columns = where.window(1000, 1000)
        merged = merge_exposures([f[rows, columns] for f in raw], times, noise)
        rectify(merged.radiance[..., None], where, variance=merged.variance[..., None],
                sites=sites, origin=(rows.start, columns.start), threads=1)  # fmt: skip
    seconds = (time.process_time() - start) / pairs
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return {"pairs": pairs, "cpu_s": seconds, "minutes_6561_two_cores": seconds * 6561 / 120,
            "peak_gb": memory}  # fmt: skip


def main() -> None:
    """Print a line a cell, and the rate."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pairs", type=int, default=200)
    parser.add_argument("--out")
    given = parser.parse_args()
    rng = np.random.default_rng(0)
    lines = []
    for texels in (32, 64, 128):
        for tilt in (0.0, 45.0, 60.0, 75.0):
            for line in cells(texels, tilt, rng):
                lines.append(line)
                print(_LINE.format(**line))
    found = rate(given.pairs, rng)
    print(_RATE.format(**found))
    if given.out:
        with open(given.out, "w") as file:
            json.dump({"cells": lines, "rate": found}, file, indent=1)


if __name__ == "__main__":
    main()
