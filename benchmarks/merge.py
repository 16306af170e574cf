"""What merging an exposure series costs and how near it comes to the bound of its noise.

    python benchmarks/merge.py [--quick] [--json]

Twelve bits, black 200, 15 electrons a count, 6 electrons of read noise, exposures of 1, 1/4, 1/16
and 1/64 s, radiances over five decades; synthetic, one seed. Beside ours: a plain sum over times
(Poisson), the best single exposure, hat weights, and OpenCV's Debevec on 16 bits.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit.calibration.merge import merge_exposures, merge_plainly
from btfkit.calibration.noise import NoiseModel

Floats = NDArray[Any]
GAIN, READ_E, BLACK, WHITE = 15.0, 6.0, 200.0, 4095
EXPOSURE = np.array([1, 1 / 4, 1 / 16, 1 / 64])
DECADES = (20.0, 200.0, 2e3, 2e4, 2e5)
NOISE = NoiseModel(gain=GAIN, read=READ_E / GAIN, white=WHITE, black=BLACK)


def shoot(photons: Floats, seed: int) -> list[Floats]:
    """Counts (h, w) of each exposure of (h, w) electrons a second."""
    rng = np.random.default_rng(seed)
    frames = []
    for t in EXPOSURE:
        electrons = rng.poisson(photons * t) + rng.normal(0, READ_E, photons.shape)
        counts = np.clip(np.rint(BLACK + electrons / GAIN), 0, WHITE)
        frames.append(counts.astype(np.uint16))
    return frames


def ours(frames: list[Floats]) -> Floats:
    """The streamed merge."""
    return merge_exposures(frames, EXPOSURE, NOISE).radiance


def plain(frames: list[Floats]) -> Floats:
    """Its plain twin."""
    return merge_plainly(frames, EXPOSURE, NOISE).radiance


def poisson(frames: list[Floats]) -> Floats:
    """Sum of counts over the sum of times, of what does not saturate."""
    raw = np.stack(frames).astype(float)
    used = raw < WHITE
    t = EXPOSURE[:, None, None]
    with np.errstate(invalid="ignore"):
        return np.asarray((used * (raw - BLACK)).sum(0) / (used * t).sum(0))


def single(frames: list[Floats]) -> Floats:
    """The longest exposure that does not saturate."""
    raw = np.stack(frames).astype(float)
    best = np.argmax(raw < WHITE, axis=0)
    counts = np.take_along_axis(raw, best[None], axis=0)[0]
    return np.asarray((counts - BLACK) / EXPOSURE[best])


def hat(frames: list[Floats]) -> Floats:
    """Weights that fall to both ends of the range."""
    raw = np.stack(frames).astype(float)
    weight = np.minimum(raw, WHITE - raw) + 1e-6
    return np.asarray((weight * (raw - BLACK) / EXPOSURE[:, None, None]).sum(0) / weight.sum(0))


def debevec(frames: list[Floats]) -> Floats:
    """OpenCV's, with the linear response that 16 bits get; in ours' scale."""
    import cv2

    # What saturates has to be the highest code: only there its weight is 0.
    lift = 65535 / (WHITE - BLACK)
    lifted = [np.clip((f.astype(float) - BLACK) * lift, 0, 65535).astype(np.uint16) for f in frames]
    merged = cv2.createMergeDebevec().process(
        [cv2.merge([f] * 3) for f in lifted], EXPOSURE.astype(np.float32)
    )[..., 0]
    return np.asarray(merged)


METHODS: dict[str, Callable[[list[Floats]], Floats]] = {
    "noise model, iterated (btfkit)": ours, "its plain twin": plain, "sum over times": poisson,
    "best single exposure": single, "hat weights": hat, "OpenCV Debevec, 16 bits": debevec,
}  # fmt: skip


def measured(size: int, rounds: int) -> dict[str, Any]:
    """Relative deviation and bias by decade, and CPU seconds a megapixel."""
    rng = np.random.default_rng(1)
    low, high = np.log10(DECADES[0]), np.log10(10 * DECADES[-1])
    photons = 10 ** rng.uniform(low, high, (size, size))
    frames = shoot(photons, 2)
    bound = NOISE.bound(photons / GAIN, EXPOSURE) * GAIN / photons
    bands = [(photons >= d) & (photons < 10 * d) for d in DECADES]
    out: dict[str, Any] = {"bound": {"sd": [float(np.sqrt(np.mean(bound[b] ** 2))) for b in bands]}}
    for name, method in METHODS.items():
        seconds = []
        for _ in range(rounds):
            start = time.process_time()
            found = method(frames)
            seconds.append(time.process_time() - start)
        # Some methods leave the scale open: the brightest decade sets it.
        scale = float(np.nanmedian(photons[bands[-1]] / found[bands[-1]]))
        off = found * (scale if name.startswith("OpenCV") else GAIN) / photons - 1
        out[name] = {
            "sd": [float(np.sqrt(np.nanmean(off[b] ** 2))) for b in bands],
            "bias": [float(np.nanmean(off[b])) for b in bands],
            "cpu_s_per_mpx": min(seconds) / photons.size * 1e6,
        }
    return out


def by_size(sizes: tuple[int, ...] = (512, 1024, 2048)) -> dict[str, float]:
    """CPU seconds of the streamed merge of four frames, by megapixels."""
    rng = np.random.default_rng(3)
    out = {}
    for size in sizes:
        frames = [rng.integers(200, 4000, (size, size), np.uint16) for _ in EXPOSURE]
        seconds = []
        for _ in range(3):
            start = time.process_time()
            ours(frames)
            seconds.append(time.process_time() - start)
        out[f"{size * size / 1e6:.2f}"] = min(seconds)
    return out


def table(found: dict[str, Any]) -> str:
    """The figures for people."""
    lines = ["relative deviation (bias) by decade from 20 e/s" + " " * 8 + "CPU s a megapixel"]
    for name, row in found.items():
        bias = row.get("bias", [0.0] * len(DECADES))
        cells = [f"{s:.4f} ({b:+.4f})" for s, b in zip(row["sd"], bias, strict=True)]
        cost = f"{row['cpu_s_per_mpx']:.3f}" if "cpu_s_per_mpx" in row else ""
        lines.append(f"{name:32}" + "  ".join(cells) + f"  {cost}")
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a sixteenth of a megapixel")
    parser.add_argument("--json", action="store_true", help="one JSON object")
    options = parser.parse_args()
    found = measured(256 if options.quick else 1024, 1 if options.quick else 3)
    costs = by_size((128, 256, 512) if options.quick else (512, 1024, 2048))
    if options.json:
        print(json.dumps({"methods": found, "cpu_s_by_mpx": costs}))
        return
    print(table(found))
    print("CPU s by megapixels: " + ", ".join(f"{k}: {v:.4f}" for k, v in costs.items()))


if __name__ == "__main__":
    main()
