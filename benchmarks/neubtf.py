"""NeuBTF: its own error and what it carries; the published one beside free textures and PCA.

    python benchmarks/neubtf.py -o FOLDER --only carried [--cpu 36] [--seeds 0 1 2]
    python benchmarks/neubtf.py -o FOLDER --only wool terms swapped [--cpu 36] [--seeds 0 1 2]
    python benchmarks/neubtf.py -o FOLDER [--budget 600] [--free 300] [--only NAME ...] [--plot PNG]

Everything is synthetic: traced from materials of known relief, at 128 x 128 on Bonn-81 directions
(`carried`: at 96 x 96 on 25 x 25 of them, one thread, carried onto a tile of another seed;
`terms`: at 64 x 64 on 16 x 16). `wool` is measured, and needs BTFKIT_REAL_DATA.
Each cell is written to FOLDER when it is done; a second run goes on where the first one stopped.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
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
from btfkit import colour, metrics
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
SIZE, SMALL, TERM, HOLDOUT, SEED = 128, 96, 64, 0.05, 0


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


def carried(
    cells: Cells, name: str, model: str, cpu: float, seed: int, cell: str = "carried"
) -> None:
    """A tile fitted for some CPU seconds, and carried onto a tile of another seed."""
    tiles = []
    for tile in (0, 1):
        path = cells.folder / f"{name}-{SMALL}-{tile}.btf.zarr"
        if not path.exists():
            btf = synth_btf(name, size=SMALL, lights="25", views="25", seed=tile)
            writer.write(btf, path)
        tiles.append(btfkit.open(path))
    cells.get(
        f"{name}-{model}-{cell}-{cpu:g}-{seed}",
        lambda: onto_another(
            name, tiles, model, cpu, seed, keep=cells.folder / f"{name}-{model}-{seed}.safetensors"
        ),
    )


def onto_another(
    name: str,
    tiles: list[BTF],
    model: str,
    cpu: float,
    seed: int,
    *,
    keep: Path | None = None,
    **settings: str,
) -> dict[str, Any]:
    """PSNR of log(1 + rgb) on ten held-out pairs: own, and carried onto the second tile."""
    from btfkit.fitting.neubtf.data import frontal_slice
    from btfkit.materials import file

    own, other = tiles
    rows, test = btfkit.split(len(own), HOLDOUT, SEED)
    material, training, found = after(own, model, cpu, seed, **settings)
    if keep is not None:
        file.save(material, keep, training=training, force=True)
    pairs = np.random.default_rng(1).permutation(test)[:10]
    found["own"] = evaluation.errors_on_btf(material, own, pairs=pairs)["psnr_log1p"]
    flat = metrics.Pooled()
    for pair in pairs:
        truth = other.texture(int(pair))
        flat.add(np.broadcast_to(truth.mean(axis=(0, 1)), truth.shape), truth)
    found["mean_colour"] = flat.errors()["psnr_log1p"]
    if not training:
        return found
    guide = frontal_slice(other, rows).permute(1, 2, 0).numpy()
    relief = procedural.make(name, SMALL, seed=1)
    for kind, given in (("", None), ("_normals", normals_of(relief.height * SMALL))):
        if given is not None and model != "neubtf":
            continue
        moved = onto_guide(material, training, guide, normals=given)
        errors = evaluation.errors_on_btf(moved, other, pairs=pairs)
        found[f"carried{kind}"] = errors["psnr_log1p"]
        if given is None:
            found |= {key: errors[key] for key in ("ssim_srgb", "flip")}
            found["copied_there"] = moved.header.provenance.get("copied", 0.0)
        if "texture.heights" in moved.weights:
            heights = moved.weights["texture.heights"][..., 0].astype(float)
            texels, truth = heights * (moved.spec.depth_scale * SMALL), relief.height * SMALL
            found[f"height_error{kind}"] = np.std(texels - truth)
            found["height"] = np.std(truth)
    alone = {n: a for n, a in training.items() if not n.startswith("copying.")}
    moved = onto_guide(material, alone, guide)
    found["encoder_alone"] = evaluation.errors_on_btf(moved, other, pairs=pairs)["psnr_log1p"]
    return found


def after(
    btf: BTF, model: str, cpu: float, seed: int, **settings: str
) -> tuple[Any, dict[str, Any], dict[str, Any]]:
    """A model after some CPU seconds of one thread, what carries it, and what its fit states."""
    import torch

    from btfkit.fitting.loop import Run, train
    from btfkit.fitting.neubtf.encoder import Encoder as HalfResolution

    torch.set_num_threads(1)
    rows, test = btfkit.split(len(btf), HOLDOUT, SEED)
    trainable, generators = begun(btf, model, rows, test, seed, **settings)
    encoder = getattr(trainable, "encoder", None)
    if model == "neubtf-paper" and isinstance(encoder, HalfResolution):
        trainable._optimisers["encoder_moments"] = Both(encoder)
    run = Run(None, None, budget_cpu_s=cpu)
    train(trainable, run, generators=generators)
    stated = trainable.stated()
    return trainable.material(), trainable.training_arrays(), {"steps": run.done, **stated}


def onto_guide(material: Any, training: dict[str, Any], guide: Any, **more: Any) -> Any:
    """A material carried onto a periodic guidance."""
    from btfkit.materials import file
    from btfkit.propagation import propagate

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "m.safetensors"
        file.save(material, path, training=training)
        return propagate(guide, path, **({"wrap": "wrap"} | more))


def normals_of(height: Any) -> Any:
    """(h, w, 3) unit normals of a periodic surface, texels."""
    from btfkit.relief.photometric import normal_of

    across, down = (np.roll(height, -1, axis) - np.roll(height, 1, axis) for axis in (1, 0))
    return normal_of(np.stack([across, -down], axis=-1) / 2)


def wool(cells: Cells, model: str, cpu: float, seed: int) -> None:
    """Measured wool: a quarter of it fitted, and carried onto the frontal slice of the whole."""
    cell = f"wool-{model}-quarter-{cpu:g}-{seed}"
    cells.get(cell, lambda: onto_the_rest(model, cpu, seed))


def onto_the_rest(model: str, cpu: float, seed: int) -> dict[str, Any]:
    """Errors over the three quarters that the fit has not seen, on twelve held-out pairs."""
    from btfkit.fitting.neubtf.data import frontal_slice

    whole = measured_wool()
    _, h, w, _ = whole.shape
    quarter = whole.crop(slice(0, h // 2), slice(0, w // 2))
    rows, test = btfkit.split(len(whole), HOLDOUT, SEED)
    pairs = np.random.default_rng(1).permutation(test)[:12]
    material, training, found = after(quarter, model, cpu, seed)
    found["own"] = evaluation.errors_on_btf(material, quarter, pairs=pairs)["psnr_log1p"]
    guide = frontal_slice(whole, rows).permute(1, 2, 0).numpy()
    moved = onto_guide(material, training, guide, wrap="clamp")
    found["copied_there"] = moved.header.provenance.get("copied", 0.0)
    # Three rectangles make up what was not seen; the mean of each image's own quarter beside.
    parts = [(slice(0, h // 2), slice(w // 2, w)), (slice(h // 2, h), slice(0, w))]
    scores: dict[str, list[float]] = {}
    pooled, flat = metrics.Pooled(), metrics.Pooled()
    for pair in pairs:
        truth, answer = whole.texture(int(pair)), evaluation.answer_pair(moved, whole, int(pair))
        mean = truth[: h // 2, : w // 2].mean(axis=(0, 1))
        for part in parts:
            pooled.add(answer[part], truth[part])
            flat.add(np.broadcast_to(mean, truth[part].shape), truth[part])
            seen = answer[part], truth[part]
            scores.setdefault("ssim_srgb", []).append(metrics.ssim_srgb(*seen))
            scores.setdefault("flip", []).append(float(metrics.flip(*seen).mean()))
    errors = pooled.errors()
    found |= {"unseen": errors["psnr_log1p"], "unseen_linear": errors["psnr"]}
    found["mean_colour"] = flat.errors()["psnr_log1p"]
    return found | {key: float(np.mean(values)) for key, values in scores.items()}


def side_by_side(cells: Cells, path: Path) -> None:
    """Woven cloth in cobbles, by a mask, on both materials' guidance: what `carried` has fitted."""
    import cv2

    from btfkit.cli import btfkit as group
    from btfkit.cli.outcome import run
    from btfkit.fitting.neubtf.data import frontal_slice
    from btfkit.propagation import propagate

    names = ("cobbles", "woven")
    models = [cells.folder / f"{name}-neubtf-0.safetensors" for name in names]
    guides = [
        np.tile(frontal_slice(btf, np.arange(len(btf))).permute(1, 2, 0).numpy(), (2, 2, 1))
        for btf in (btfkit.open(cells.folder / f"{name}-{SMALL}-1.btf.zarr") for name in names)
    ]
    row, col = np.mgrid[: 2 * SMALL, : 2 * SMALL] - SMALL + 0.5
    mask = (np.hypot(row, col) < 0.7 * SMALL).astype(np.uint8) * 255
    guide = np.where(mask[..., None] > 0, guides[1], guides[0]).astype(np.float32)
    out, picture, size = cells.folder / "both.safetensors", cells.folder / "both.png", 4 * SMALL
    propagate(guide, models, mask=mask, out=out, force=True)
    run(group, [
        "render", str(out), "-o", str(picture), "--shape", "plane", "--light", "50,120",
        "--view", "35,270", "--size", f"{size}x{size}", "--force",
    ])  # fmt: skip
    shown = [
        cv2.resize(np.rint(255 * image).astype(np.uint8), (size, size))
        for image in (metrics.to_srgb(guide)[..., ::-1], mask[..., None].repeat(3, 2) / 255)
    ]
    cv2.imwrite(str(path), np.concatenate([*shown, cv2.imread(str(picture))], axis=1))


class Both:
    """Muon and Adam behind the face of one optimiser, whose rate is Adam's."""

    def __init__(self, encoder: Any) -> None:
        import torch

        from btfkit.fitting.neubtf.muon import Muon

        self._parts = {
            20.0: Muon(encoder.matrices()),
            3.0: torch.optim.Adam(encoder.rest(), lr=0.0, betas=(0.9, 0.99)),
        }
        self.param_groups = [{"params": list(encoder.parameters()), "lr": 0.0}]

    def zero_grad(self, set_to_none: bool = True) -> None:
        """As torch's."""
        for part in self._parts.values():
            part.zero_grad(set_to_none=set_to_none)

    def step(self) -> None:
        """Both move what is theirs, at 4e-2 and 6e-3 where Adam's rate would be 2e-3."""
        for factor, part in self._parts.items():
            for group in part.param_groups:
                group["lr"] = factor * self.param_groups[0]["lr"]
            part.step()

    def state_dict(self) -> dict[str, Any]:
        """Without moments: such a run is never resumed."""
        return {"state": {}, "param_groups": []}

    def load_state_dict(self, state: Any) -> None:
        """See `state_dict`."""


# The published loss without each of its terms, and with half the weights of ours.
TERMS: dict[str, dict[str, str]] = {
    "all": {},
    "no-pixels": {"pixels": "0"},
    "no-style": {"style": "0"},
    "no-frequency": {"frequency": "0"},
    "pixels-alone": {"style": "0", "frequency": "0"},
}


def terms(cells: Cells, name: str, cpu: float, seed: int) -> None:
    """The published model with and without each term of its loss, own and carried, small."""
    tiles = [synth_btf(name, size=TERM, lights="16", views="16", seed=tile) for tile in (0, 1)]
    for term, settings in TERMS.items():
        cells.get(
            f"{name}-terms-{term}-{cpu:g}-{seed}",
            lambda settings=settings: onto_another(
                name, tiles, "neubtf-paper", cpu, seed, **settings
            ),
        )


def swapped(cells: Cells, name: str, cpu: float, seed: int) -> None:
    """The published decoder behind the encoder and the optimiser of the model with heights."""
    from btfkit.fitting.neubtf import encoder, paper

    published = paper.Encoder

    def lighter(latents: int, generator: Any) -> Any:
        return encoder.Encoder(3, latents, generator)

    paper.Encoder = lighter  # type: ignore[misc,assignment]
    try:
        carried(cells, name, "neubtf-paper", cpu, seed, cell="swapped")
    finally:
        paper.Encoder = published  # type: ignore[misc]


def measured_wool() -> BTF:
    """256 x 256 wool under every third light of every third view (BTFKIT_REAL_DATA)."""
    folder = Path(os.environ["BTFKIT_REAL_DATA"]) / "ubo2003_pca"
    spec = importlib.util.spec_from_file_location("decode", folder / "decode.py")
    assert spec is not None
    assert spec.loader is not None
    decode = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(decode)
    textures, light, view = decode.pairs("wool")
    some = np.arange(81)[::3]
    pairs = (81 * some[:, None] + some).reshape(-1)
    linear = [colour.from_srgb(np.clip(textures[int(i)], 0, 1)) for i in pairs]
    values = np.stack(linear).astype(np.float32)
    return BTF(values, light[pairs], view[pairs], wrap="clamp")


def begun(
    btf: BTF, model: str, rows: Any, test: Any, seed: int, **settings: str
) -> tuple[Any, Any]:
    """A model before its first step."""
    from btfkit.fitting import TRAINED
    from btfkit.fitting.loop import Generators

    module, name = TRAINED[model].split(":")
    kind = getattr(importlib.import_module(module), name)
    generators = Generators(seed)
    if model == "neumip":
        settings = {"levels": "1", **settings}
    return kind(btf, rows, test, settings=settings, generators=generators), generators


def spread(btf: BTF, model: Path) -> dict[str, Any]:
    """Held-out error of the material propagated onto slices under other lights and views."""
    from btfkit.propagation import propagate

    _, test = btfkit.split(len(btf), HOLDOUT, SEED)
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

    train, _ = btfkit.split(len(btf), HOLDOUT, SEED)
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

    train, test = btfkit.split(len(crop), HOLDOUT, SEED)
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


def carry(cells: Cells, chosen: list[str], args: argparse.Namespace) -> None:
    """All that is fitted for some CPU seconds of one thread."""
    for seed in args.seeds:
        for name in args.materials if "carried" in chosen else ():
            for model in args.models:
                carried(cells, name, model, args.cpu, seed)
        if "wool" in chosen:
            for model in ("neubtf", "neubtf-paper"):
                wool(cells, model, args.cpu, seed)
        for name in args.materials if "terms" in chosen else ():
            terms(cells, name, args.cpu, seed)
        for name in args.materials if "swapped" in chosen else ():
            swapped(cells, name, args.cpu, seed)


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--budget", type=float, default=600.0, help="seconds a fit")
    parser.add_argument("--free", type=float, default=300.0, help="seconds with free textures")
    parser.add_argument(
        "--only",
        nargs="*",
        help="carried, wool, terms, swapped, brick, gravel, woven, print, cobbles, propagation",
    )
    parser.add_argument("--seeds", nargs="*", type=int, default=[0], help="of what is carried")
    parser.add_argument("--materials", nargs="*", default=["woven", "cobbles", "gravel"])
    parser.add_argument("--models", nargs="*", default=["neubtf", "neubtf-paper", "neumip"])
    parser.add_argument("--cpu", type=float, default=36.0, help="CPU seconds a carried fit")
    parser.add_argument("--plot", type=Path)
    parser.add_argument("--mask", type=Path, help="a picture of two materials on one guidance")
    args = parser.parse_args()
    print(platform.processor() or platform.machine(), os.cpu_count(), "processors", flush=True)
    cells = Cells(args.out)
    chosen = args.only or ["carried", *FLAT, *STEEP, "propagation"]
    carry(cells, chosen, args)
    for name, relief in FLAT.items():
        if name in chosen:
            compare(cells, name, relief, args.budget, args.free)
    for name, relief in STEEP.items():
        if name in chosen:
            parallax(cells, name, relief, args.free)
    if "propagation" in chosen:
        propagation(cells, "gravel", args.free)
    if args.mask:
        side_by_side(cells, args.mask)
    if args.plot:
        plot(args.out, args.plot)


if __name__ == "__main__":
    main()
