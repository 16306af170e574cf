"""What a NeuMIP's channels and layers buy and cost, and where the time of an answer goes.

    python benchmarks/neumip.py [--budget CPU_SECONDS] [--size TEXELS] [material ...]

After figures 9 and 10 of Kuznetsov et al., "NeuMIP", 2021: the error on held-out pictures and the
time of an answer by feature channels and by layers, each in parts of the default's, means over the
materials; then the shares of march, lookups and decoder. One thread of one run: CPU seconds.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from btfkit.bench import cases, cells
from btfkit.fitting.neumip.settings import Settings
from btfkit.fitting.neumip.trainable import spec_of
from btfkit.footprint import most_levels
from btfkit.materials.base import Header
from btfkit.materials.neumip.spec import NeuMIPSpec
from btfkit.native.neural import Kernel

MATERIALS = ("cobbles", "woven", "scratched", "print")
# The paper has 7 channels and 4 layers of 3 to 13 and 2 to 8; a texel here holds 8 numbers.
CHANNELS, LAYERS = (3, 4, 6, 8), (2, 3, 4, 6, 8)
_QUERIES, _TURNS = 1 << 16, 21


def main() -> None:
    """The shares of an answer's time, then a fit for each variant and material."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("materials", nargs="*", default=MATERIALS)
    parser.add_argument("--budget", type=float, default=6.0, help="CPU seconds a fit")
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--directions", type=int, default=13, help="lights, and views")
    parser.add_argument("--time-alone", action="store_true", help="no fits")
    asked = parser.parse_args()
    shares(512)
    for size in (128, 512):
        finer(size)
    variants = [{"features": str(n), "frames": str(min(2, n // 3))} for n in CHANNELS]
    variants += [{"layers": str(n - 1)} for n in LAYERS]
    if not asked.time_alone:
        table(variants, asked.materials, asked.budget, asked.size, asked.directions)


def shares(size: int) -> None:
    """ns of an answer at `size`, half of the queries sharp, and what of it is what."""
    spec = spec_of(Settings(), (size, size), most_levels((size, size)))
    flat = replace(spec, heights=False, offset=0)
    hidden = (1,) * len(spec.hidden)
    every, unmoved, looked = _times([spec, flat, replace(flat, hidden=hidden)])
    parts = {"march": every - unmoved, "lookups": looked, "decoder": unmoved - looked}
    said = ", ".join(f"{name} {100 * part / every:.0f} %" for name, part in parts.items())
    print(f"{size} x {size}, mixed levels: {every:.0f} ns an answer; {said}", flush=True)


def finer(size: int) -> None:
    """Time of an answer with textures read half a level finer, in parts of that without."""
    spec = spec_of(Settings(), (size, size), most_levels((size, size)))
    rng = np.random.default_rng(1)
    whole, between = rng.integers(1, 6, _QUERIES), rng.uniform(0, 5, _QUERIES)
    kinds = {
        "sharp": np.zeros(_QUERIES), "whole levels": whole.astype(float), "any level": between,
        "half sharp": between * (rng.random(_QUERIES) < 0.5),
    }  # fmt: skip
    for kind, level in kinds.items():
        footprint = (0.5 * 2**level).astype(np.float32)
        plain, half = _turns([replace(spec, finer=0.0), replace(spec, finer=0.5)], footprint).T
        ratio = np.sort(half / plain)
        middle, low, high = np.quantile(ratio, [0.5, 0.25, 0.75])
        print(
            f"{size} x {size}, {kind}: half a level finer takes {middle:.3f} of the time "
            f"({low:.3f} to {high:.3f}, quartiles of {_TURNS} turns)", flush=True,
        )  # fmt: skip


def table(
    variants: Sequence[dict[str, str]],
    materials: Sequence[str],
    budget: float,
    size: int,
    directions: int,
) -> None:
    """A line for each variant: mse of log(1 + x) and time in parts of the default's."""
    known = [cases.procedural(n, size=size, directions=directions, seed=0) for n in materials]
    specs = [
        spec_of(Settings(), (size, size), most_levels((size, size))),
        *(_spec(each, size) for each in variants),
    ]
    errors = []
    for settings in [{}, *variants]:
        rows = [cells.run_cell(cells.Cell(c.name, "neumip", settings, budget), c) for c in known]
        errors.append([row["mse_log1p"] for row in rows])
        said = " ".join(f"{name}={value}" for name, value in settings.items()) or "default"
        parts = np.exp(np.log(np.array(errors[-1]) / np.array(errors[0])).mean())
        each = " ".join(f"{-10 * np.log10(error):.1f}" for error in errors[-1])
        print(f"{said}: {parts:.2f} of the default's error (dB: {each})", flush=True)
    times = _times(specs)
    for settings, taken in zip(variants, times[1:], strict=True):
        said = " ".join(f"{name}={value}" for name, value in settings.items())
        print(f"{said}: {taken / times[0]:.2f} of its time, {taken:.0f} ns")


def _spec(settings: dict[str, str], size: int) -> NeuMIPSpec:
    given = Settings(**{name: int(value) for name, value in settings.items()})
    return spec_of(given, (size, size), most_levels((size, size)))


def _times(specs: Sequence[NeuMIPSpec]) -> list[float]:
    """ns an answer of each, half of them sharp, by turns, the best of several."""
    rng = np.random.default_rng(2)
    level = rng.uniform(0, 5, _QUERIES) * (rng.random(_QUERIES) < 0.5)
    found: list[float] = _turns(specs, (0.5 * 2**level).astype(np.float32)).min(axis=0).tolist()
    return found


def _turns(specs: Sequence[NeuMIPSpec], footprint: np.ndarray) -> np.ndarray:
    """(turns, specs) ns an answer of each, by turns."""
    rng = np.random.default_rng(0)
    asks = []
    for spec in specs:
        layout = spec.layout(Header(grid=spec.size))
        weights = 0.1 * rng.standard_normal(layout.weights).astype(np.float32)
        texels = 0.3 * rng.standard_normal((layout.texels, 8)).astype(np.float32)
        if layout.heights:
            h, w = layout.heights
            down, across = np.mgrid[:h, :w] * (12 * np.pi / h)
            layout.surface(texels)[:] = 0.035 / layout.depth_scale * np.sin(down) * np.sin(across)
        kernel = Kernel(layout, threads=1)
        if layout.heights:
            kernel.freeze(texels)
        asks.append((kernel, weights, texels))
    uv = rng.random((_QUERIES, 2), np.float32)
    light, view = (_upper(rng) for _ in range(2))
    taken = np.empty((_TURNS, len(specs)))
    for turn in taken:
        for k, (kernel, weights, texels) in enumerate(asks):
            start = time.process_time()
            kernel.evaluate(weights, texels, uv, light, view, footprint)
            turn[k] = time.process_time() - start
    return 1e9 * taken / _QUERIES


def _upper(rng: np.random.Generator) -> np.ndarray:
    found = rng.standard_normal((_QUERIES, 3)).astype(np.float32)
    found[:, 2] = np.abs(found[:, 2]) + 0.2
    return found / np.linalg.norm(found, axis=1, keepdims=True)


if __name__ == "__main__":
    main()
