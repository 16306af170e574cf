"""One cell of the benchmark: one model on one material within one budget, measured."""

from __future__ import annotations

import importlib
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

import numpy as np

from btfkit import metrics, native
from btfkit.bench.cases import Case
from btfkit.fitting import CLOSED_FORM, TRAINED
from btfkit.materials.base import Material
from btfkit.materials.evaluation import errors_on_btf, errors_on_queries
from btfkit.native import neumip as kernels

# Looks at the held-out error while a model is trained, evenly spread in the logarithm of time.
_LOOKS = 7
_LOOK_QUERIES = 8192
_RATE_QUERIES = 1 << 17


@final
@dataclass(frozen=True)
class Cell:
    """What is run.

    Attributes:
        material: name of the case. model: a name of `MODELS`. settings: the model's own.
        budget_cpu_s: CPU seconds of training, over all threads; None for closed forms.
        seed: of the model.
    """

    material: str
    model: str
    settings: Mapping[str, str] = field(default_factory=dict)
    budget_cpu_s: float | None = None
    seed: int = 0

    @property
    def label(self) -> str:
        """The model with its settings."""
        return " ".join([self.model, *(f"{k}={v}" for k, v in self.settings.items())])

    @property
    def key(self) -> str:
        """The cell's file name."""
        budget = "" if self.budget_cpu_s is None else f"_{self.budget_cpu_s:g}s"
        return f"{self.material}_{self.label}{budget}_{self.seed}".replace(" ", "_")


def cells_of(
    material: str, models: Iterable[str], budgets: Iterable[float], *, seed: int, size: int
) -> list[Cell]:
    """Every cell of a material: closed forms once a setting, trained models once a budget too."""
    found = []
    wanted = tuple(budgets)
    for model in models:
        for settings in _variants(model, size):
            times = wanted if model in TRAINED else (None,)
            # A variant is one more point of a curve; the longest budget says enough.
            times = times[-1:] if settings and model in TRAINED else times
            found += [Cell(material, model, settings, budget, seed) for budget in times]
    return found


def _variants(model: str, size: int) -> tuple[dict[str, str], ...]:
    if model == "pca":
        return tuple({"rank": str(rank)} for rank in (1, 2, 4, 8, 16, 32))
    if model == "neumip":
        smaller = {"size": str(max(size // 2, 1))}
        return ({}, {"offset": "0"}, smaller, {"precision": "int8"})
    return ({},)


def run_cell(cell: Cell, case: Case) -> dict[str, Any]:
    """Fit, then measure: what `docs/benchmarks.md` lists, as JSON types."""
    with _peak_memory() as memory:
        start = time.perf_counter()
        if cell.model in CLOSED_FORM:
            cpu = time.process_time()
            fitted = _load(CLOSED_FORM[cell.model])
            material = fitted(case.train, settings=dict(cell.settings), progress=None)
            cpu_s = time.process_time() - cpu
            curve: list[dict[str, float]] = []
            steps, queries = 1, int(np.prod(case.train.shape[:3]))
            seconds = time.perf_counter() - start
        else:
            material, (seconds, cpu_s, steps, queries), curve = _trained(cell, case)
    return {
        "material": cell.material,
        "model": cell.model,
        "settings": dict(cell.settings),
        "label": cell.label,
        "budget_cpu_s": cell.budget_cpu_s,
        "seed": cell.seed,
        "seconds": seconds,
        "cpu_seconds": cpu_s,
        "steps": steps,
        "queries": queries,
        **_errors(material, case),
        **_sizes(material),
        **rate(material, case),
        "peak_memory_bytes": memory.get("bytes"),
        "curve": curve,
    }


def _trained(
    cell: Cell, case: Case
) -> tuple[Material, tuple[float, float, int, int], list[dict[str, float]]]:
    import torch

    from btfkit.fitting.loop import Generators

    torch.set_num_threads(native.threads())
    trainable = _load(TRAINED[cell.model])(
        case.train,
        np.arange(len(case.train)),
        np.arange(0),
        settings=dict(cell.settings),
        generators=Generators(cell.seed),
        progress=None,
    )
    budget = cell.budget_cpu_s or 1.0
    looks = iter(np.geomspace(budget / 32, budget, _LOOKS)[:-1])
    due = next(looks, None)
    seconds = cpu_s = 0.0
    steps = 0
    curve: list[dict[str, float]] = []
    while cpu_s < budget:
        start, cpu = time.perf_counter(), time.process_time()
        trainable.step(cpu_s / budget)
        cpu_s += time.process_time() - cpu
        seconds += time.perf_counter() - start
        steps += 1
        if due is not None and cpu_s >= due:
            due = next((look for look in looks if look > cpu_s), None)
            curve.append({"cpu_s": cpu_s, "steps": steps, **_look(trainable.material(), case)})
    material = trainable.material()
    curve.append({"cpu_s": cpu_s, "steps": steps, **_look(material, case)})
    return material, (seconds, cpu_s, steps, trainable.queries), curve


def _look(material: Material, case: Case) -> dict[str, float]:
    """The error at the finest level, of a fixed part of the held-out texels."""
    sharp = np.flatnonzero(np.asarray(case.queries.footprint) <= 0.5)[:: max(1, _stride(case))]
    errors = errors_on_queries(material, case.queries.subset(sharp))
    return {"mse_log1p": errors["mse_log1p"], "psnr_log1p": errors["psnr_log1p"]}


def _stride(case: Case) -> int:
    return int((np.asarray(case.queries.footprint) <= 0.5).sum()) // _LOOK_QUERIES


def _errors(material: Material, case: Case) -> dict[str, Any]:
    errors = errors_on_btf(material, case.pictures)
    if material.has_levels:
        errors["levels"] = errors_on_queries(material, case.queries)["levels"]
    return errors


def _sizes(material: Material) -> dict[str, int]:
    """Weights but textures, and bytes of everything that answering needs."""
    plain = [a.size for name, a in material.weights.items() if "texture" not in name]
    return {
        "parameters": int(sum(plain)),
        "bytes": int(sum(array.nbytes for array in material.weights.values())),
    }


def rate(material: Material, case: Case) -> dict[str, float | None]:
    """Answers a second and a CPU second at random texels, and the share of the measured peak."""
    rng = np.random.default_rng(2)
    pool = case.queries
    rows = rng.integers(0, len(pool), _RATE_QUERIES)
    blur = np.asarray(pool.footprint)[rows]
    if not material.has_levels:
        blur = np.full_like(blur, 0.5)
    ask = (pool.uv[rows], pool.light[rows], pool.view[rows], blur)
    part = _RATE_QUERIES // 32
    start = time.perf_counter()
    material.evaluate(*(a[:part] for a in ask))
    # A model that takes microseconds a query is timed on fewer of them.
    count = _RATE_QUERIES if time.perf_counter() - start < 0.1 else part
    walls, cpus = [], []
    for _ in range(3):
        start, cpu = time.perf_counter(), time.process_time()
        material.evaluate(*(a[:count] for a in ask))
        walls.append(time.perf_counter() - start)
        cpus.append(time.process_time() - cpu)
    work = _operations(material)
    cpu_rate = count / max(min(cpus), 1e-9)
    share = None
    if work is not None and kernels.available():
        share = work * cpu_rate / peak()
    return {
        "queries_per_s": count / min(walls),
        "queries_per_cpu_s": cpu_rate,
        "ns_per_query": 1e9 * min(walls) / count,
        "flop_per_query": work,
        "share_of_peak": share,
    }


def _operations(material: Material) -> int | None:
    """Multiplications and additions a query of a model that is a network; None for others."""
    matrices = [
        array.size
        for name, array in material.weights.items()
        if name.endswith("weight") and array.ndim == 2 and "texture" not in name
    ]
    return 2 * sum(matrices) if matrices else None


_PEAK: list[float] = []


def peak() -> float:
    """Float32 operations a second of one thread: the best of many short windows, measured once.

    Neighbours on the machine can only slow a window down.
    """
    if not _PEAK:
        _PEAK.append(max(kernels.peak(0.02) for _ in range(25)))
    return _PEAK[0]


@contextmanager
def _peak_memory() -> Iterator[dict[str, int]]:
    """Growth of resident memory at its highest, bytes, where Linux says it."""
    found: dict[str, int] = {}
    reset, status = Path("/proc/self/clear_refs"), Path("/proc/self/status")
    try:
        reset.write_text("5")
        before = _status(status, "VmRSS")
    except OSError:
        yield found
        return
    yield found
    found["bytes"] = max(_status(status, "VmHWM") - before, 0)


def _status(path: Path, name: str) -> int:
    for line in path.read_text().splitlines():
        if line.startswith(name + ":"):
            return int(line.split()[1]) * 1024
    return 0


def _load(home: str) -> Any:
    module, name = home.split(":")
    return getattr(importlib.import_module(module), name)


def psnr_log1p(result: Mapping[str, Any]) -> float:
    """The one number that curves are drawn of."""
    return metrics.psnr(float(result["mse_log1p"]))
