"""Where nothing was measured: models fitted to few pairs, against the truth of the hemisphere.

    python benchmarks/coverage.py [--models neumip neubtf sbtf] [--materials NAME ...]
        [--sets 9 81 240 400] [--steps 1500] [--set KEY=VALUE ...]
    python benchmarks/coverage.py --photographs FOLDER [--size 128] [--models ...] [--steps 1500]

Traced materials of 64 x 64 texels, fitted to 9 pairs lit from the eye, to one view under 81 and
under 240 lights, and to 20 x 20 pairs; PSNR of log(1 + x) in each 15 degrees of the view, of 16
views and lights each, even over its part of the hemisphere, beside `lambert` fitted to the same.
Chroma: mean over texels of the largest difference of a channel's share of the sum.

Of photographs there is no truth: over random directions above 30 degrees the share of answers far
from the measured mean colour (by more than 0.2 in a channel's share of the sum) and of black ones
(a sum below a tenth of the mean's times the light's cosine).
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import btfkit
from btfkit import directions
from btfkit.btf import BTF
from btfkit.coverage import spread_pairs
from btfkit.fitting import fit as fitting
from btfkit.materials.base import Material
from btfkit.materials.evaluation import texel_centres
from btfkit.relief import procedural
from btfkit.relief.synth import direction_set
from btfkit.relief.trace import traced_btf

SIZE, BINS, VIEWS = 64, 6, 16
Floats = NDArray[Any]


def pairs_of(kind: str) -> tuple[Floats, Floats]:
    """(n, 3) lights and views of a set."""
    ring = directions.from_angles(np.radians([0] + 8 * [25]), np.radians(45.0 * np.arange(9)))
    if kind == "9":
        return ring.astype(np.float32), ring.astype(np.float32)
    if kind == "400":
        table = direction_set("20")
        return np.tile(table, (20, 1)), np.repeat(table, 20, axis=0)
    light = direction_set("bonn81" if kind == "81" else kind)
    return light, np.repeat([[0, 0, 1]], len(light), axis=0).astype(np.float32)


def in_memory(btf: BTF) -> Floats:
    """Textures of all pairs."""
    return btf.textures.batch(range(len(btf)))


def truth(name: str) -> tuple[BTF, Floats]:
    """Pairs all over the hemisphere, and their textures."""
    rng = np.random.default_rng(5)
    edges = np.cos(np.radians(15.0 * np.arange(BINS + 1)))
    z = rng.uniform(np.repeat(edges[1:], VIEWS), np.repeat(edges[:-1], VIEWS))
    view = directions.from_angles(
        np.arccos(np.maximum(z, 0.02)), rng.uniform(0, 2 * np.pi, len(z))
    ).astype(np.float32)
    light, _ = spread_pairs(len(z), rng)
    btf = traced_btf(procedural.make(name, SIZE), light, view, samples=32)
    return btf, in_memory(btf)


def answers(material: Material, btf: BTF) -> Floats:
    """(n, h, w, c) of a material for the pairs of a BTF."""
    uv = texel_centres(*btf.shape[1:3])
    each = [
        material.evaluate(uv, a, b).reflectance for a, b in zip(btf.light, btf.view, strict=True)
    ]
    return np.stack(each)


def decibels(found: Floats, true: Floats) -> Floats:
    """(6,) PSNR of log(1 + x) by view."""
    error = np.square(np.log1p(np.maximum(found, 0)) - np.log1p(true)).mean(axis=(1, 2, 3))
    return -10 * np.log10(error.reshape(BINS, -1).mean(axis=1))


def chroma(found: Floats, true: Floats) -> float:
    """Mean largest difference of a channel's share of the sum."""
    sums = [v.sum(axis=-1, keepdims=True) for v in (found, true)]
    lit = (sums[0][..., 0] > 1e-3) & (sums[1][..., 0] > 1e-3)
    shares = [v / np.maximum(s, 1e-9) for v, s in zip((found, true), sums, strict=True)]
    return float(np.abs(shares[0] - shares[1])[lit].max(axis=-1).mean())


def shown(name: str, found: Floats, true: Floats, beside: Floats | None, note: str = "") -> Floats:
    """Print a row of a table; its decibels."""
    db = decibels(found, true)
    gain = "" if beside is None else f"{(db - beside).min():+.2f}"
    cells = " | ".join(f"{value:.1f}" for value in db)
    print(f"| {name} | {cells} | {gain} | {chroma(found, true):.3f} |{note}", flush=True)
    return db


def traced(args: argparse.Namespace, settings: dict[str, str]) -> None:
    """Tables of traced materials."""
    for kind in args.sets:
        print(f"\n{kind} pairs\n\n| | 0-15 | -30 | -45 | -60 | -75 | -90 | least gain | chroma |")
        print("|---|---|---|---|---|---|---|---|---|")
        for name in args.materials:
            at, true = truth(name)
            light, view = pairs_of(kind)
            btf = traced_btf(procedural.make(name, SIZE), light, view, samples=8)
            # Of nine pairs none can be spared.
            share = 0.0 if kind == "9" else 0.05
            plain = fitting.fit(btf, model="lambert", holdout=share).material
            beside = shown(f"{name}: lambert", answers(plain, at), true, None)
            for model in args.models:
                cpu = time.process_time()
                own = {"free": "0.95"} if model == "neubtf" else {"levels": "1"}
                report = fitting.fit(
                    btf, model=model, steps=args.steps, holdout=share, seed=args.seed,
                    settings={**own, **settings},
                )  # fmt: skip
                held = report.errors.get("psnr_log1p", float("nan"))
                note = f" held out {held:.1f} dB, {time.process_time() - cpu:.0f} CPU s"
                shown(f"{name}: `{model}`", answers(report.material, at), true, beside, note)


def photographs(args: argparse.Namespace, settings: dict[str, str]) -> None:
    """The table of photographs."""
    btf = btfkit.open(args.photographs)
    middle = [slice((n - args.size) // 2, (n + args.size) // 2) for n in btf.shape[1:3]]
    btf = btf.crop(*middle)
    mean = np.nanmean(in_memory(btf), axis=(0, 1, 2))
    print(
        f"\n{len(btf)} photographs, {args.size} x {args.size}\n\n| | far | black |\n|---|---|---|"
    )
    for model in ("lambert", *args.models):
        own = {"lambert": {}, "neubtf": {"free": "0.95"}}.get(model, {"levels": "1"})
        given = {} if model == "lambert" else {**own, **settings}
        report = fitting.fit(
            btf, model=model, steps=args.steps, holdout=0.0, seed=args.seed, settings=given
        )
        rng = np.random.default_rng(0)
        light, view = spread_pairs(200_000, rng, np.sin(np.radians(30)))
        uv = rng.random((len(light), 2)).astype(np.float32)
        found = report.material.evaluate(uv, light, view).reflectance
        total = found.sum(axis=1)
        away = np.abs(found / np.maximum(total, 1e-9)[:, None] - mean / mean.sum()).max(axis=1)
        black = total < 0.1 * mean.sum() * light[:, 2]
        print(f"| `{model}` | {(away > 0.2).mean():.3f} | {black.mean():.3f} |", flush=True)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--models", nargs="+", default=["neumip", "neubtf", "sbtf"])
    parser.add_argument(
        "--materials", nargs="+", default=["cobbles", "woven", "scratched", "print"]
    )
    parser.add_argument("--sets", nargs="+", default=["9", "81", "240", "400"])
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--photographs", type=Path)
    parser.add_argument("--size", type=int, default=128)
    args = parser.parse_args()
    settings = dict(each.split("=", 1) for each in args.set)
    (photographs if args.photographs else traced)(args, settings)


if __name__ == "__main__":
    main()
