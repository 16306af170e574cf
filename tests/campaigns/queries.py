"""Random queries of random settings of models: finite, and equal by kernel, twin and export."""

from __future__ import annotations

import contextlib
import io
import runpy
import shutil
import sys
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import cases
import numpy as np

from btfkit.export.package import export
from btfkit.materials.base import Header, Material
from btfkit.materials.lambert import Lambert, LambertSpec
from btfkit.materials.neubtf.paper import NeuBTFPaper, NeuBTFSpec
from btfkit.materials.neumip.material import NeuMIP, NeuMIPPaper
from btfkit.materials.neumip.spec import NeuMIPSpec
from btfkit.materials.rainer import Rainer19, Rainer20, RainerSpec
from btfkit.native.neural import plain
from campaigns.limits import Attempt, Find

COUNT = 1000
_INPUTS = (
    ("lx", "ly", "vx", "vy"),
    ("lx", "ly", "vx", "vy", "hx", "hy", "hz", "cos_diff"),
    ("lx", "ly", "vx", "vy", "hx", "hy", "hz", "cos_diff", "level"),
)
# Of a thousand answers, as many may stand on the border between two texels or steps of a march,
# from where rounding moves them.
_BORDERS = 0.02


def _any(rng: np.random.Generator, *values: Any) -> Any:
    return values[int(rng.integers(len(values)))]


def _settings(rng: np.random.Generator) -> tuple[Any, Any, Header]:
    """A model's class, a spec of it and a header, all at random."""
    h, w = (int(n) for n in rng.integers(1, 40, 2))
    wrap = _any(rng, "wrap", "clamp")
    header = Header(grid=(h, w), wrap=wrap, texel_mm=0.25)
    match int(rng.integers(6)):
        case 0:
            return Lambert, LambertSpec((h, w)), header
        case 1:
            return Rainer19, RainerSpec((h, w), latents=int(rng.integers(1, 17))), header
        case 2:
            spec = RainerSpec((h, w), latents=int(_any(rng, 8, 32)), whitened=True)
            return Rainer20, spec, header
        case 3:
            # Sines of more than this double rounding layer by layer.
            return (
                NeuBTFPaper,
                NeuBTFSpec((h, w), omega=1.25, parallax=bool(rng.integers(2))),
                header,
            )
        case 4:
            return (
                NeuMIPPaper,
                NeuMIPSpec((h, w), levels=int(rng.integers(1, 4)), output="released"),
                header,
            )
    levels = int(rng.integers(1, 5))
    heights = bool(rng.integers(2))
    spec = NeuMIPSpec(
        (h, w), levels=levels, features=int(rng.integers(3, 9)), coarse=int(_any(rng, 0, 4)) if levels > 2 else 0,
        light=int(_any(rng, 0, 3)) if heights else 0, offset=0 if heights else int(_any(rng, 0, 4, 7)),
        heights=heights, hidden=tuple(int(n) for n in rng.integers(5, 33, int(rng.integers(1, 4)))),
        activation=_any(rng, "relu", "leaky"), directions=_INPUTS[int(rng.integers(3))],
        output=_any(rng, "log", "relu", "mask"), precision=_any(rng, "float32", "float16"),
        frames=int(_any(rng, 0, 1)),
    )  # fmt: skip
    return NeuMIP, spec, header


def _made(rng: np.random.Generator) -> Material | None:
    """A material of random numbers, in the ranges that fitted ones have; None where refused."""
    kind, spec, header = _settings(rng)
    try:
        shapes = kind.shapes(spec, header)
    except (ValueError, TypeError):
        return None
    weights = {}
    for name, shape in shapes.items():
        if name.startswith("texture"):
            spread = 0.05 if "heights" in name or isinstance(spec, NeuBTFSpec) else 0.4
            value = rng.random(shape) if kind is Lambert else rng.normal(0, spread, shape)
        elif name.endswith("norm.weight"):
            value = rng.uniform(0.1, 0.3, shape)
        else:
            value = rng.normal(0, 1 / np.sqrt(shape[-1]), shape) + 0.1 * name.endswith("bias")
        half = name.startswith("texture") and getattr(spec, "precision", "") == "float16"
        weights[name] = value.astype(np.float16 if half else np.float32)
    try:
        return kind(spec, weights, header)
    except (ValueError, TypeError):
        return None


def _asked(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Queries, one in twenty of them hostile."""
    found = {
        "uv": rng.uniform(-3, 3, (COUNT, 2)).astype(np.float32),
        "light": cases.directions(rng, COUNT),
        "view": cases.directions(rng, COUNT, lowest=0.05),
        "footprint": rng.uniform(0, 8, COUNT).astype(np.float32),
    }
    for name, array in found.items():
        rows = rng.random(COUNT) < 0.0125
        bad = _any(rng, np.nan, np.inf, -np.inf, 0.0, -1.0, 1e30, 1e-30, -0.0)
        array[rows] = bad if name != "footprint" else abs(bad)
    return found


def queries(folder: Path) -> Attempt:
    """A seed: one material of random settings, a thousand queries, three evaluations."""

    def attempt(seed: int) -> Counter[str]:
        rng = np.random.default_rng([seed, 6])
        material = _made(rng)
        if material is None:
            return Counter({"settings refused": 1})
        given = _asked(rng)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            rgb, opacity = material.evaluate(**given)
            if not (np.isfinite(rgb).all() and np.isfinite(opacity).all()):
                raise Find(f"{material.model} {material.spec}: not finite")
            sound = _sound(given)
            kept = {name: value[sound] for name, value in given.items()}
            program = material.program()
            # The twin takes what the preparation before it has brought to one tile.
            uv = kept["uv"].astype(np.float64)
            uv = np.clip(uv, 0, 1) if material.header.wrap == "clamp" else uv - np.floor(uv)
            twin, _ = plain.answer(
                program, uv.astype(np.float32), kept["light"], kept["view"], kept["footprint"]
            )
            _compare(material, "twin", rgb[sound], twin)
            counts = Counter({"queries": COUNT, "settings": 1})
            if seed % 10 == 0:
                _compare(material, "numpy export", rgb[sound], _exported(material, kept, folder))
                counts["exports"] += 1
        return counts

    return attempt


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
    export(material, "npz", out)
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
