"""The whole benchmark: cells one after the other, kept as they finish, then tables and plots."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from btfkit import native
from btfkit.bench import kernels, plots, tables
from btfkit.bench.cases import Case, procedural, stored
from btfkit.bench.cells import Cell, cells_of, peak, run_cell
from btfkit.errors import BtfkitError
from btfkit.files import whole
from btfkit.fitting import MODELS
from btfkit.native.neumip import available, variants

Progress = Callable[[float, float], None]


@final
@dataclass(frozen=True)
class Profile:
    """How much is run.

    Attributes:
        materials: of the catalogue. stores: further ones, from files.
        models: by name. budgets_cpu_s: of every trained model.
        size: texels a side. directions: lights, and views, of the traced materials.
        holdout: share of the pairs of stores that are held out.
        seed: of data and models. kernel_seconds: a figure of the kernel tables; 0 for none.
    """

    materials: tuple[str, ...] = ("cobbles", "woven", "scratched", "print")
    stores: tuple[Path, ...] = ()
    models: tuple[str, ...] = tuple(MODELS)
    budgets_cpu_s: tuple[float, ...] = (5.0, 15.0, 60.0)
    size: int = 128
    directions: int = 21
    holdout: float = 0.05
    seed: int = 0
    kernel_seconds: float = 0.5


QUICK = Profile(
    materials=("cobbles", "print"), budgets_cpu_s=(0.5, 1.5), size=48, directions=12,
    kernel_seconds=0.1,
)  # fmt: skip


def run(profile: Profile, folder: Path, *, progress: Progress | None = None) -> dict[str, Any]:
    """Run what of a profile is not in `folder` yet, and write its tables, plots and JSON there.

    Args:
        profile: what is wanted.
        folder: created where missing; cells that lie there, of the same profile, are not repeated.
        progress: called with (cells done, cells).

    Returns:
        What bench.json holds: machine, profile, cells, tables, targets.

    Raises:
        ValueError: an unknown model or material.
        BtfkitError: `folder` holds cells of another profile.
    """
    _check(profile)
    folder.mkdir(parents=True, exist_ok=True)
    _claim(folder, profile)
    names: list[str | Path] = [*profile.materials, *profile.stores]
    planned = [(name, _planned(name, profile)) for name in names]
    total = sum(len(cells) for _, cells in planned) + 1
    rows: list[dict[str, Any]] = []
    for name, cells in planned:
        case: Case | None = None
        for cell in cells:
            kept = folder / "cells" / f"{cell.key}.json"
            if not kept.is_file():
                case = case or _case(name, profile)
                _write(kept, {**_run_or_say_why(cell, case), "case": case.describe()})
            rows.append(json.loads(kept.read_text()))
            if progress:
                progress(len(rows), total)
    found = {
        "machine": machine(),
        "profile": json.loads(json.dumps(asdict(profile), default=str)),
        "cells": rows,
        **_kernels(folder, profile),
    }
    found["targets"] = tables.targets(rows)
    good = [row for row in rows if "failed" not in row]
    plots.rate_distortion(good, folder / "rate-distortion.png")
    plots.time_to_error(good, folder / "time-to-error.png")
    (folder / "bench.md").write_text(tables.markdown(found))
    _write(folder / "bench.json", found)
    if progress:
        progress(total, total)
    return found


def machine() -> dict[str, Any]:
    """Processor, compiler and versions that figures depend on."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "threads": native.threads(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "python": platform.python_version(),
        "compiler": _compiler(),
        "kernels": native.in_use(),
        "variants": variants(),
        "peak_gflops_one_thread": peak() / 1e9 if available() else None,
        "versions": {
            name: importlib.metadata.version(name) for name in ("btfkit", "numpy", "torch")
        },
    }


def _check(profile: Profile) -> None:
    from btfkit.relief.procedural import CATALOGUE

    for kind, given, known in (
        ("model", profile.models, MODELS),
        ("material", profile.materials, CATALOGUE),
    ):
        unknown = [name for name in given if name not in known]
        if unknown:
            raise ValueError(f"no {kind} {unknown[0]!r}; there are {', '.join(known)}")


def _claim(folder: Path, profile: Profile) -> None:
    """Cells of different data must not meet in one folder."""
    mark = folder / "profile.json"
    decisive = {name: getattr(profile, name) for name in ("size", "directions", "holdout", "seed")}
    if mark.is_file() and json.loads(mark.read_text()) != decisive:
        raise BtfkitError(
            f"{folder} holds results of {json.loads(mark.read_text())}, not of {decisive}",
            remedy="name another folder, or delete this one",
        )
    _write(mark, decisive)


def _planned(name: str | Path, profile: Profile) -> list[Cell]:
    label = name if isinstance(name, str) else name.name.removesuffix(".btf.zarr")
    return cells_of(
        label, profile.models, profile.budgets_cpu_s, seed=profile.seed, size=profile.size
    )


def _case(name: str | Path, profile: Profile) -> Case:
    if isinstance(name, Path):
        return stored(name, holdout=profile.holdout, seed=profile.seed)
    return procedural(name, size=profile.size, directions=profile.directions, seed=profile.seed)


def _run_or_say_why(cell: Cell, case: Case) -> dict[str, Any]:
    """A model that cannot take a material is a finding of the benchmark, not its end."""
    try:
        return run_cell(cell, case)
    except (BtfkitError, ValueError) as error:
        return {
            "material": cell.material, "model": cell.model, "label": cell.label,
            "settings": dict(cell.settings), "budget_cpu_s": cell.budget_cpu_s,
            "failed": str(error),
        }  # fmt: skip


def _kernels(folder: Path, profile: Profile) -> dict[str, Any]:
    if profile.kernel_seconds <= 0 or not available():
        return {}
    kept = folder / "kernels.json"
    if not kept.is_file():
        seconds = profile.kernel_seconds
        _write(
            kept,
            {
                "kernels": kernels.kernel_table(seconds),
                "loop": kernels.loop_table(seconds),
                "skips": kernels.skip_table(seconds),
                "regions": kernels.region_table(seconds),
            },
        )
    found: dict[str, Any] = json.loads(kept.read_text())
    return found


def _write(path: Path, value: Mapping[str, Any]) -> None:
    path.parent.mkdir(exist_ok=True)
    with whole(path, force=True) as partial:
        partial.write_text(json.dumps(_json(value), indent=1))


def _json(value: Any) -> Any:
    """JSON's own types; NaN and infinity become text."""
    if isinstance(value, Mapping):
        return {str(key): _json(item) for key, item in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_json(item) for item in value]
    if isinstance(value, np.generic):
        return _json(value.item())
    if isinstance(value, float) and not np.isfinite(value):
        return str(value)
    return value if isinstance(value, (str, int, float, bool, type(None))) else str(value)


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    names = [
        line.split(":", 1)[1].strip()
        for line in (info.read_text().splitlines() if info.is_file() else ())
        if line.startswith("model name")
    ]
    return names[0] if names else platform.processor() or platform.machine()


def _compiler() -> str:
    for name in ("c++", "g++", "clang++"):
        try:
            out = subprocess.run([name, "--version"], capture_output=True, text=True, check=True)
        except (OSError, subprocess.CalledProcessError):
            continue
        return out.stdout.splitlines()[0]
    return "none found"
