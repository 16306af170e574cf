"""NeuBTF: its own error and what it carries; the published one beside free textures and PCA.

    python benchmarks/neubtf.py -o FOLDER --only carried [--cpu 36]
    python benchmarks/neubtf.py -o FOLDER [--budget 600] [--free 300] [--only NAME ...] [--plot PNG]

Everything is synthetic: traced from materials of known relief, at 128 x 128 on Bonn-81 directions
(`carried`: at 96 x 96 on 25 x 25 of them, one thread, carried onto a tile of another seed).
Each cell is written to FOLDER when it is done; a second run goes on where the first one stopped.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import platform
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import btfkit
from btfkit import metrics
from btfkit.btf import BTF
from btfkit.fitting import fit as fitting
from btfkit.io.store import writer
from btfkit.materials import evaluation
from btfkit.relief import procedural
from btfkit.relief.synth import direction_set, synth_btf
from btfkit.relief.trace import traced_btf

# Material -> height of its structure, texels of the 128 x 128 tile; None is its own.
FLAT: dict[str, float | None] = {"brick": 1.5, "gravel": 1.5, "woven": 1.5, "print": None}
STEEP: dict[str, float | None] = {"cobbles": None}
SIZE, SMALL, HOLDOUT, SEED = 128, 96, 0.05, 0


class Cells:
    """Results by name, kept on disk as they come."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def get(self, name: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """The result `name`: read where it is there, else made and written."""
        path = self.folder / f"{name}.json"
        if not path.exists():
            start, cpu = time.perf_counter(), time.process_time()
            made = make()
            made |= {"wall_s": time.perf_counter() - start, "cpu_s": time.process_time() - cpu}
            made["load"] = os.getloadavg()[0]
            path.write_text(json.dumps(made, default=float))
        found: dict[str, Any] = json.loads(path.read_text())
        shown = {k: round(v, 3) for k, v in found.items() if isinstance(v, float)}
        print(name, json.dumps(shown), flush=True)
        return found

    def store(self, name: str, relief: float | None) -> BTF:
        """The traced BTF of a material, as a store."""
        path = self.folder / f"{name}.btf.zarr"
        if not path.exists():
            writer.write(synth_btf(name, size=SIZE, relief_texels=relief), path)
        return btfkit.open(path)


def fitted(
    btf: BTF, model: str, budget: float, out: Path | None, **settings: str
) -> dict[str, Any]:
    """Report of a fit, without what is no number."""
    report = fitting.fit(
        btf, model=model, budget_s=budget, holdout=HOLDOUT, seed=SEED,
        out=out, force=True, settings=settings,
    )  # fmt: skip
    return {k: v for k, v in report.as_dict().items() if k not in ("choice", "settings")}


def compare(cells: Cells, name: str, relief: float | None, budget: float, free: float) -> None:
    """One material: encoder, free textures, interpolation, PCA at equal bytes."""
    btf = cells.store(name, relief)
    model = cells.folder / f"{name}.safetensors"
    report = cells.get(f"{name}-neubtf", lambda: fitted(btf, "neubtf-paper", budget, model))
    cells.get(f"{name}-free", lambda: fitted(btf, "neubtf-paper", free, None, encoder="false"))
    size = str(int(report["bytes"]))
    cells.get(f"{name}-pca", lambda: fitted(btf, "pca", 1, None, bytes=size))
    cells.get(f"{name}-interpolation", lambda: fitted(btf, "interpolation", 1, None))
    cells.get(f"{name}-guides", lambda: spread(btf, model))
    cells.get(f"{name}-scales", lambda: scales(btf, model))


def parallax(cells: Cells, name: str, relief: float | None, budget: float) -> None:
    """Strong relief, without and with the head that follows it; free textures."""
    btf = cells.store(name, relief)
    for head in ("false", "true"):
        cells.get(
            f"{name}-free-parallax-{head}",
            lambda head=head: fitted(
                btf, "neubtf-paper", budget, None, encoder="false", parallax=head
            ),
        )


def carried(cells: Cells, name: str, model: str, cpu: float) -> None:
    """A tile fitted for some CPU seconds, and carried onto a tile of another seed."""
    tiles = []
    for seed in (0, 1):
        path = cells.folder / f"{name}-{SMALL}-{seed}.btf.zarr"
        if not path.exists():
            btf = synth_btf(name, size=SMALL, lights="25", views="25", seed=seed)
            writer.write(btf, path)
        tiles.append(btfkit.open(path))
    cells.get(f"{name}-{model}-carried-{cpu:g}", lambda: onto_another(name, tiles, model, cpu))


def onto_another(name: str, tiles: list[BTF], model: str, cpu: float) -> dict[str, Any]:
    """PSNR of log(1 + rgb) on ten held-out pairs: own, and carried onto the second tile."""
    import torch

    from btfkit.fitting.loop import Run, train
    from btfkit.fitting.neubtf.data import frontal_slice
    from btfkit.materials import file
    from btfkit.propagation import propagate

    torch.set_num_threads(1)
    own, other = tiles
    rows, test = fitting.split(len(own), HOLDOUT, SEED)
    trainable, generators = begun(own, model, rows, test)
    run = Run(None, None, budget_cpu_s=cpu)
    train(trainable, run, generators=generators)
    material = trainable.material()
    pairs = np.random.default_rng(1).permutation(test)[:10]
    found: dict[str, Any] = {"steps": run.done}
    found["own"] = evaluation.errors_on_btf(material, own, pairs=pairs)["psnr_log1p"]
    flat = metrics.Pooled()
    for pair in pairs:
        truth = other.texture(int(pair))
        flat.add(np.broadcast_to(truth.mean(axis=(0, 1)), truth.shape), truth)
    found["mean_colour"] = flat.errors()["psnr_log1p"]
    if not trainable.training_arrays():
        return found
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "m.safetensors"
        file.save(material, path, training=trainable.training_arrays())
        guide = frontal_slice(other, rows).permute(1, 2, 0).numpy()
        moved = propagate(guide, path, wrap="wrap")
    errors = evaluation.errors_on_btf(moved, other, pairs=pairs)
    found |= {"carried": errors["psnr_log1p"]}
    found |= {key: errors[key] for key in ("ssim_srgb", "flip")} | trainable.stated()
    if "texture.heights" in moved.weights:
        heights = moved.weights["texture.heights"][..., 0].astype(float)
        texels = heights * (moved.spec.depth_scale * SMALL)
        truth = procedural.make(name, SMALL, seed=1).height * SMALL
        found["height_error"], found["height"] = np.std(texels - truth), np.std(truth)
    return found


def begun(btf: BTF, model: str, rows: Any, test: Any) -> tuple[Any, Any]:
    """A model before its first step."""
    from btfkit.fitting import TRAINED
    from btfkit.fitting.loop import Generators

    module, name = TRAINED[model].split(":")
    kind = getattr(importlib.import_module(module), name)
    generators = Generators(SEED)
    settings = {"levels": "1"} if model == "neumip" else {}
    return kind(btf, rows, test, settings=settings, generators=generators), generators


def spread(btf: BTF, model: Path) -> dict[str, Any]:
    """Held-out error of the material propagated onto slices under other lights and views."""
    from btfkit.propagation import propagate

    _, test = fitting.split(len(btf), HOLDOUT, SEED)
    rng = np.random.default_rng(SEED)
    pairs = rng.permutation(test)[:24]
    theta = np.degrees(np.arccos(np.clip(btf.view[:, 2], -1, 1)))
    lit = btf.light[:, 2] > 0.6
    found: dict[str, Any] = {}
    for low, high in ((0, 5), (25, 35), (55, 65)):
        slices = rng.permutation(np.flatnonzero((theta >= low) & (theta < high) & lit))[:6]
        values = []
        for pair in slices:
            carried = propagate(btf.texture(int(pair)), model, wrap="wrap")
            values.append(evaluation.errors_on_btf(carried, btf, pairs=pairs)["psnr"])
        found[f"view_{(low + high) // 2}"] = {
            "mean": float(np.mean(values)), "deviation": float(np.std(values)), "slices": values,
        }  # fmt: skip
    return found


def scales(btf: BTF, model: Path) -> dict[str, Any]:
    """R(A(G)) shrunk against R(A(G shrunk)), decibel."""
    from btfkit.fitting.neubtf.data import frontal_slice
    from btfkit.propagation import consistency

    train, _ = fitting.split(len(btf), HOLDOUT, SEED)
    guidance = frontal_slice(btf, train).permute(1, 2, 0).numpy()
    return {str(scale): consistency(guidance, model, scale=scale) for scale in (0.75, 0.5, 0.25)}


def propagation(cells: Cells, name: str, budget: float) -> None:
    """A 512 x 512 material: fit a 128 x 128 crop, propagate onto the frontal slice of the whole."""
    relief = procedural.make(name, 512, relief_texels=1.5)
    table = direction_set("16")
    light, view = np.tile(table, (len(table), 1)), np.repeat(table, len(table), axis=0)
    whole = traced_btf(relief, light, view)
    crop = whole.crop(slice(0, 128), slice(0, 128))
    model = cells.folder / f"{name}-crop.safetensors"
    cells.get(f"{name}-crop", lambda: fitted(crop, "neubtf-paper", budget, model))
    cells.get(f"{name}-propagated", lambda: against_truth(whole, crop, model))


def against_truth(whole: BTF, crop: BTF, model: Path) -> dict[str, Any]:
    """PSNR over what the fit never saw, beside that over the crop, on held-out pairs."""
    from btfkit.fitting.neubtf.data import frontal_slice
    from btfkit.propagation import propagate

    train, test = fitting.split(len(crop), HOLDOUT, SEED)
    guidance = frontal_slice(whole, train).permute(1, 2, 0).numpy()
    carried = propagate(guidance, model, wrap="wrap")
    mean = np.zeros(3)
    seen, unseen, colour = metrics.Pooled(), metrics.Pooled(), metrics.Pooled()
    for pair in test[:24]:
        truth = whole.texture(int(pair))
        answer = evaluation.answer_pair(carried, whole, int(pair))
        rest = np.ones(truth.shape[:2], bool)
        rest[:128, :128] = False
        seen.add(answer[~rest], truth[~rest])
        unseen.add(answer[rest], truth[rest])
        mean = truth[~rest].mean(axis=0)
        colour.add(np.broadcast_to(mean, truth[rest].shape), truth[rest])
    own = evaluation.errors_on_btf(btfkit.load(model), crop, pairs=test[:24])
    return {
        "crop_psnr": own["psnr"],
        "seen_psnr": seen.errors()["psnr"],
        "unseen_psnr": unseen.errors()["psnr"],
        "mean_colour_psnr": colour.errors()["psnr"],
    }


def plot(folder: Path, path: Path) -> None:
    """Error against time, of all materials that are there."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(6.4, 3.8), dpi=110)
    for index, name in enumerate([*FLAT, *STEEP]):
        for kind, style in (("neubtf", "-"), ("free", "--")):
            file = folder / f"{name}-{kind}.json"
            if file.exists():
                curve = np.array(json.loads(file.read_text())["curve"])
                decibel = -10 * np.log10(curve[:, 2])
                axis.plot(curve[:, 0], decibel, style, color=f"C{index}", label=f"{name}, {kind}")
    axis.set(xlabel="seconds of training", ylabel="held-out PSNR of log(1 + rgb), dB")
    axis.legend(fontsize=7, ncols=2)
    axis.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(path)


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--budget", type=float, default=600.0, help="seconds a fit")
    parser.add_argument("--free", type=float, default=300.0, help="seconds with free textures")
    parser.add_argument(
        "--only", nargs="*", help="carried, brick, gravel, woven, print, cobbles, propagation"
    )
    parser.add_argument("--cpu", type=float, default=36.0, help="CPU seconds a carried fit")
    parser.add_argument("--plot", type=Path)
    args = parser.parse_args()
    print(platform.processor() or platform.machine(), os.cpu_count(), "processors", flush=True)
    cells = Cells(args.out)
    chosen = args.only or ["carried", *FLAT, *STEEP, "propagation"]
    if "carried" in chosen:
        for name in ("woven", "cobbles"):
            for model in ("neubtf", "neubtf-paper", "neumip"):
                carried(cells, name, model, args.cpu)
    for name, relief in FLAT.items():
        if name in chosen:
            compare(cells, name, relief, args.budget, args.free)
    for name, relief in STEEP.items():
        if name in chosen:
            parallax(cells, name, relief, args.free)
    if "propagation" in chosen:
        propagation(cells, "gravel", args.free)
    if args.plot:
        plot(args.out, args.plot)


if __name__ == "__main__":
    main()
