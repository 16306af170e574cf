"""Random queries of random settings of models: finite, and equal by kernel, twin, torch and export."""

from __future__ import annotations

import contextlib
import io
import runpy
import shutil
import sys
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import cases
import numpy as np
import torch

from btfkit.conventions import MOST_LOG
from btfkit.export import npz
from btfkit.fitting.neumip import forward
from btfkit.materials.base import Material
from btfkit.materials.explained import program_of
from btfkit.materials.neumip.material import NeuMIPMaterial
from btfkit.materials.sbtf.material import SBTF
from btfkit.native.neural import plain
from campaigns import settings
from campaigns.limits import Attempt, Find

COUNT = 1000
# Of a thousand answers, as many may stand on the border between two texels or steps of a march,
# from where rounding moves them.
_BORDERS = 0.02


def _asked(rng: np.random.Generator, material: Material) -> dict[str, np.ndarray]:
    """Queries, one in twenty of them hostile."""
    found = {
        "uv": rng.uniform(-3, 3, (COUNT, 2)).astype(np.float32),
        "light": cases.directions(rng, COUNT),
        "view": cases.directions(rng, COUNT, lowest=0.05),
        "footprint": rng.uniform(0, 8, COUNT).astype(np.float32),
    }
    if material.has_curvature:
        # Of wider footprints several rays are asked for, of which the twin knows nothing.
        found["footprint"][:] = 0.5
        found["curvature"] = rng.uniform(-1, 1, COUNT).astype(np.float32)
    for name, array in found.items():
        rows = rng.random(COUNT) < 0.0125
        bad = settings.any_of(rng, np.nan, np.inf, -np.inf, 0.0, -1.0, 1e30, 1e-30, -0.0)
        array[rows] = bad if name != "footprint" else abs(bad)
    return found


def queries(folder: Path) -> Attempt:
    """A seed: one material of random settings, a thousand queries, up to four evaluations."""
    torch.set_num_threads(1)

    def attempt(seed: int) -> Counter[str]:
        rng = np.random.default_rng([seed, 6])
        material = settings.made(rng)
        if material is None:
            return Counter({"settings refused": 1})
        given = _asked(rng, material)
        counts = Counter({"queries": COUNT, "settings": 1})
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            rgb, opacity = material.evaluate(**given)
            if not (np.isfinite(rgb).all() and np.isfinite(opacity).all()):
                raise Find(f"{material.model} {material.spec}: not finite")
            sound = _sound(given)
            kept = {name: value[sound] for name, value in given.items()}
            for what, answer in _others(material, kept, opacity[sound], folder, seed):
                _compare(material, what, rgb[sound], answer)
                counts[f"by the {what}"] += 1
        return counts

    return attempt


def _others(
    material: Material, kept: dict[str, np.ndarray], opacity: np.ndarray, folder: Path, seed: int
) -> Iterator[tuple[str, np.ndarray]]:
    """The same queries answered otherwise."""
    # The answer to one does not hang on those beside it.
    order = np.random.default_rng(seed).permutation(len(kept["uv"]))
    turned = np.empty((len(order), 3), np.float32)
    turned[order] = material.evaluate(**{k: v[order] for k, v in kept.items()}).reflectance
    yield "other order", turned
    program = program_of(material)
    if program is None:
        return
    # The twin takes what the preparation before it has brought to one tile.
    uv = kept["uv"].astype(np.float64)
    uv = np.clip(uv, 0, 1) if material.header.wrap == "clamp" else uv - np.floor(uv)
    at = (uv.astype(np.float32), kept["light"], kept["view"], kept["footprint"])
    bend = kept.get("curvature")
    if isinstance(material, SBTF) and bend is not None:
        bend = np.clip(bend, *material.sharpest)
    yield "twin", plain.answer(program, *at, bend)[0]
    if isinstance(material, NeuMIPMaterial) and _has_torch(material):
        # It answers what a ray meets, whether or not it does.
        yield "torch", _by_torch(material, at, bend) * (opacity > 0)[:, None]
    if seed % 10 == 0:
        yield "numpy export", _exported(material, kept, folder)


def _has_torch(material: NeuMIPMaterial) -> bool:
    """Training sees the published program's six numbers, and rays through holes, otherwise."""
    return material.spec.output != "released" and not material.spec.holes


def _by_torch(
    material: NeuMIPMaterial, at: tuple[np.ndarray, ...], bend: np.ndarray | None
) -> np.ndarray:
    uv, light, view, footprint = at
    if material.spec.levels == 1:
        # There is one level of detail, whatever is asked.
        footprint = np.full_like(footprint, 0.5)
    parts = (material.flat, material.texels, uv, light, view, footprint)
    parts += () if bend is None else (bend,)
    given = (torch.from_numpy(np.ascontiguousarray(part, np.float32)) for part in parts)
    log = forward.log_answer(material.layout, forward.forward(material.layout, *given))
    return np.asarray(np.maximum(np.expm1(np.minimum(log.numpy(), MOST_LOG)), 0))


def _sound(given: dict[str, np.ndarray]) -> np.ndarray:
    """Rows that every evaluation defines: the twin and exports take what was already looked at."""
    ok = np.ones(COUNT, bool)
    for name, array in given.items():
        rows = array.reshape(COUNT, -1)
        ok &= np.isfinite(rows).all(1) & (np.abs(rows) < 1e3).all(1)
        if name in ("light", "view"):
            ok &= np.abs(np.linalg.norm(rows, axis=1) - 1) < 1e-5
    return ok & (given["view"][:, 2] > 0.04) & (given["light"][:, 2] > 0.01)


def _compare(material: Material, what: str, ours: np.ndarray, theirs: np.ndarray) -> None:
    # float32 through the layers in another order, magnified by exp.
    off = ~np.isclose(ours, theirs, rtol=5e-3, atol=5e-4).all(axis=-1)
    if off.mean() > _BORDERS:
        raise Find(f"{material.model} {material.spec}: {off.mean():.1%} differ from the {what}")


def _exported(material: Material, given: dict[str, np.ndarray], folder: Path) -> np.ndarray:
    out = folder / "export"
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    npz.write(material, material.program(), out)
    np.savez(folder / "q.npz", **given)
    before = sys.argv
    sys.argv = ["evaluate.py", str(folder / "q.npz"), str(folder / "a.npz")]
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            runpy.run_path(str(out / "evaluate.py"), run_name="__main__")
    finally:
        sys.argv = before
    with np.load(folder / "a.npz") as answers:
        found: np.ndarray = answers["rgb"]
    return found
