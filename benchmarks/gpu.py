"""NeuMIP on a GPU: queries a second by torch and by the fused kernels, and fits to equal error.

    python benchmarks/gpu.py -o FOLDER [--fit] [--batch 65536] [--device cuda]

Without a CUDA device it says so and measures nothing; `--device cpu` runs the same code by torch
on the CPU, to see that it works. Shares are of the card's own matrix product, measured in the same
run: 4096 x 4096 in the format of the factors. Networks of the published sizes take 6200 operations
to answer and 18600 to train; lookups are not counted.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from btfkit.btf import BTF
from btfkit.fitting import fit as fitting
from btfkit.fitting import loop
from btfkit.fitting.neumip import trainable
from btfkit.fitting.neumip.engines import triton
from btfkit.fitting.neumip.engines.device import Autograd
from btfkit.fitting.neumip.engines.triton import Fused
from btfkit.materials.base import Header
from btfkit.materials.neumip.spec import NeuMIPSpec, most_levels
from btfkit.native.neural.layout import Layout
from btfkit.relief import procedural
from btfkit.relief.synth import direction_set
from btfkit.relief.trace import traced_btf

EVALUATE, TRAIN = 6200, 18600
KINDS = {"fp32": torch.float32, "tf32": torch.float32, "bf16": torch.bfloat16,
         "fp16": torch.float16}  # fmt: skip
CASES = {"128, level 0": (128, False), "512, half level 0, half mixed": (512, True)}


def rate(call: Callable[[], object], work: float, device: torch.device) -> float:
    """Work a second: the best of nine windows of at least 50 ms."""

    def window(repeats: int) -> float:
        start = time.perf_counter()
        for _ in range(repeats):
            call()
        if device.type == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter() - start

    window(2)
    repeats = max(1, int(0.05 / max(window(3) / 3, 1e-6)))
    return work * repeats / min(window(repeats) for _ in range(9))


def peak(matrix: str, device: torch.device) -> float:
    """Operations a second of a large matrix product."""
    side = 4096 if device.type == "cuda" else 512
    torch.backends.cuda.matmul.allow_tf32 = matrix == "tf32"
    a, b = (torch.randn(side, side, device=device).to(KINDS[matrix]) for _ in range(2))
    return rate(lambda: a @ b, 2 * side**3, device)


def published(size: int, mixed: bool) -> Layout:
    """The published networks and textures."""
    levels = most_levels((size, size)) if mixed else 1
    return NeuMIPSpec((size, size), levels, output="log").layout(Header(grid=(size, size)))


def batch_of(count: int, mixed: bool, device: torch.device) -> tuple[Any, torch.Tensor]:
    """Random queries and answers."""
    rng = np.random.default_rng(0)

    def directions() -> np.ndarray:
        radius, angle = np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
        xy = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
        return np.column_stack([xy, np.sqrt(1 - radius**2)])

    level = np.where(rng.random(count) < 0.5, 0, rng.uniform(0, 9, count))
    parts = [rng.random((count, 2)), directions(), directions(), 0.5 * 2**level,
             rng.random((count, 3))]  # fmt: skip
    uv, light, view, blur, target = (
        torch.from_numpy(part.astype(np.float32)).to(device) for part in parts
    )
    return (uv, light, view, blur if mixed else None), target


def rates(name: str, count: int, device: torch.device) -> list[dict[str, Any]]:
    """A row for each engine: million queries a second and share of the card's product."""
    size, mixed = CASES[name]
    layout = published(size, mixed)
    rng = np.random.default_rng(1)
    weights = torch.from_numpy(0.3 * rng.standard_normal(layout.weights)).float().to(device)
    texels = torch.from_numpy(rng.standard_normal((layout.texels, 8))).float().to(device)
    batch, target = batch_of(count, mixed, device)
    engines: dict[tuple[str, str, int], Autograd | Fused] = {("torch", "fp32", 0): Autograd(layout)}
    if device.type == "cuda" and triton.available():
        for matrix in triton.MATRICES:
            for block in (32, 64, 128):
                engines["fused", matrix, block] = Fused(layout, device, matrix=matrix, block=block)
    peaks = {matrix: peak(matrix, device) for _, matrix, _ in engines}
    torch.backends.cuda.matmul.allow_tf32 = False
    rows = []
    for (kind, matrix, block), engine in engines.items():
        best = peaks[matrix]
        answers = rate(lambda e=engine: e.evaluate(weights, texels, batch), count, device)
        trained = rate(lambda e=engine: e.gradients(weights, texels, batch, target), count, device)
        rows.append({
            "case": name, "by": kind, "matrix": matrix, "block": block,
            "evaluate_mqs": answers / 1e6, "train_mqs": trained / 1e6,
            "evaluate_share": answers * EVALUATE / best, "train_share": trained * TRAIN / best,
            "product_tflops": best / 1e12,
        })  # fmt: skip
        print(json.dumps(rows[-1]), flush=True)
    return rows


def cobbles(size: int) -> BTF:
    """16 lights x 16 views of a material with relief."""
    table = direction_set("16")
    light, view = np.tile(table, (len(table), 1)), np.repeat(table, len(table), axis=0)
    return traced_btf(procedural.make("cobbles", size), light, view)


def whole_steps(count: int, device: torch.device) -> list[dict[str, Any]]:
    """Steps with everything in them, and how much of them drawing batches on the CPU takes."""
    rows = []
    for size in (128, 512):
        btf = cobbles(64)
        pairs = np.arange(len(btf))
        inner = trainable.NeuMIP(
            btf, pairs[8:], pairs[:8], settings={"size": str(size), "batch": str(count)},
            generators=loop.Generators(0),
        )  # fmt: skip
        ours = inner.on_device(str(device))
        stepped = rate(lambda o=ours: o.step(0.5), count, device)
        drawn = rate(lambda i=inner: i.source.batch(0, count), count, torch.device("cpu"))
        rows.append({"size": size, "step_mqs": stepped / 1e6, "draw_mqs": drawn / 1e6})
        print(json.dumps(rows[-1]), flush=True)
    return rows


def fits(device: torch.device) -> list[dict[str, Any]]:
    """Held-out error against seconds of training, on the CPU and on the device."""
    btf = cobbles(128)
    rows = []
    for where in ("cpu", device.type):
        for budget in (2.0, 5.0, 15.0, 45.0):
            report = fitting.fit(btf, model="neumip", budget_s=budget, device=where)
            rows.append({
                "device": report.device, "seconds": report.seconds, "steps": report.steps,
                "queries": report.queries, "psnr_log1p": report.errors["psnr_log1p"],
            })  # fmt: skip
            print(json.dumps(rows[-1]), flush=True)
        if device.type == "cpu":
            break
    return rows


def main() -> int:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--out", type=Path)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--batch", type=int, default=1 << 16)
    parser.add_argument("--fit", action="store_true", help="fits to equal error, too")
    args = parser.parse_args()
    if args.device == "cuda" and not torch.cuda.is_available():
        print(f"no CUDA device for torch {torch.__version__}: nothing measured", file=sys.stderr)
        return 1
    device = torch.device(args.device)
    name = torch.cuda.get_device_name() if device.type == "cuda" else platform.processor()
    found: dict[str, Any] = {"device": name, "torch": torch.__version__}
    found["rates"] = [row for case in CASES for row in rates(case, args.batch, device)]
    found["steps"] = whole_steps(args.batch, device)
    if args.fit:
        found["fits"] = fits(device)
    if args.out:
        args.out.mkdir(parents=True, exist_ok=True)
        (args.out / "gpu.json").write_text(json.dumps(found, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
