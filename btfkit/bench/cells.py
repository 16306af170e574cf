"""One cell of the benchmark: one model on one material within one budget, measured."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np

from btfkit.bench import machine, measures
from btfkit.bench.cases import Case
from btfkit.fitting import CLOSED_FORM, TRAINED
from btfkit.fitting.training import begun, closed_form
from btfkit.materials.base import Material

# Looks at the held-out error while a model is trained, evenly spread in the logarithm of time.
_LOOKS = 7
# A file name holds 255 bytes.
_MOST_NAME = 150
# Models that are run with gains, too: enough to see what gains do.
_GAINED = ("lambert", "rainer19", "neumip")
# The one model whose networks serve several materials.
SHARED = "rainer20"


@final
@dataclass(frozen=True)
class Cell:
    """What is run.

    Attributes:
        material: name of the case. model: a name of `MODELS`. settings: the model's own.
        budget_cpu_s: CPU seconds of training, over all threads; None for closed forms.
        seed: of the model.
        together: materials that the model is trained on at once, with `budget_cpu_s` for each;
            empty for one alone.
    """

    material: str
    model: str
    settings: Mapping[str, str] = field(default_factory=dict)
    budget_cpu_s: float | None = None
    seed: int = 0
    together: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """The model with its settings."""
        return " ".join([self.model, *(f"{k}={v}" for k, v in self.said().items())])

    @property
    def key(self) -> str:
        """The cell's file name."""
        budget = "" if self.budget_cpu_s is None else f"_{self.budget_cpu_s:g}s"
        name = f"{self.material}_{self.label}{budget}_{self.seed}".replace(" ", "_")
        if len(name) <= _MOST_NAME:
            return name
        return f"{name[:_MOST_NAME]}_{hashlib.sha256(name.encode()).hexdigest()[:16]}"

    def said(self) -> dict[str, str]:
        """The settings, and the materials trained together."""
        shared = {"shared": "+".join(self.together)} if self.together else {}
        return {**self.settings, **shared}


def cells_of(
    material: str,
    models: Iterable[str],
    budgets: Iterable[float],
    *,
    seed: int,
    rows: int | None,
    pictured: bool = True,
    gains: bool = False,
) -> list[Cell]:
    """Every cell of a material: closed forms once a setting, trained models once a budget too.

    Args:
        material: its name. models, budgets, seed: of the profile.
        rows: of the data's grid; None where queries do not say.
        pictured: whether the data are pictures; models that need some refuse queries only once.
        gains: whether some models that can find gains are run once more to do so, and variants
            that are smaller or coarser are left out.
    """
    found = []
    wanted = tuple(budgets)
    for model in models:
        variants = list(_variants(model, rows, pictured=pictured))
        if gains:
            # Smaller and coarser models are told apart by traced materials.
            variants = [each for each in variants if not {"size", "precision"} & each.keys()]
        if gains and pictured and model in _GAINED:
            variants.append({"gains": "true"})
        for settings in variants:
            times = wanted if model in TRAINED else (None,)
            # A variant is one more point of a curve; the longest budget says enough.
            times = times[-1:] if settings and model in TRAINED else times
            found += [Cell(material, model, settings, budget, seed) for budget in times]
    return found


def shared_cells(
    materials: Sequence[str], models: Iterable[str], budgets: Sequence[float], *, seed: int
) -> list[Cell]:
    """One model trained on all materials at once, measured on each; the longest budget."""
    if SHARED not in models or len(materials) < 2:
        return []
    together = tuple(materials)
    return [Cell(name, SHARED, {}, budgets[-1], seed, together) for name in materials]


def _variants(model: str, rows: int | None, *, pictured: bool) -> tuple[dict[str, str], ...]:
    if model == "pca" and pictured:
        return tuple({"rank": str(rank)} for rank in (1, 2, 4, 8, 16, 32))
    if model == "neumip":
        smaller = ({"size": str(max(rows // 2, 1))},) if rows else ()
        return ({}, {"offset": "0"}, *smaller, {"precision": "int8"})
    return ({},)


def run_cell(cell: Cell, case: Case) -> dict[str, Any]:
    """Fit, then measure: what `docs/benchmarks.md` lists, as JSON types."""
    with measures.peak_memory() as memory:
        stated: Mapping[str, Any] = {}
        if cell.model in CLOSED_FORM:
            material, ran, stated = _closed_form(cell, case)
        else:
            trainable, generators = _trainable(cell, [case])
            budget = cell.budget_cpu_s or 1.0
            ran = _train(trainable, generators, budget, lambda m: measures.look(m, case))
            material, stated = trainable.material(), trainable.stated()
    found = {"gains": stated["gains"]} if "gains" in stated else {}
    return {**_row(cell, case, material, ran, memory), **found}


def run_together(cells: Sequence[Cell], cases: Sequence[Case]) -> list[dict[str, Any]]:
    """One training on all cases; a row for each. The budget is that of each, added up."""
    budget = sum(cell.budget_cpu_s or 1.0 for cell in cells)
    with measures.peak_memory() as memory:
        trainable, generators = _trainable(cells[0], cases)
        ran = _train(trainable, generators, budget, None)
    return [
        _row(cell, case, trainable.material(which), ran, memory)
        for which, (cell, case) in enumerate(zip(cells, cases, strict=True))
    ]


def refusal(cell: Cell, error: Exception) -> dict[str, Any]:
    """What stands in place of a row where a model cannot take a material."""
    return {**_head(cell), "failed": str(error)}


@final
@dataclass(frozen=True)
class _Ran:
    """What a fit took; curve: looks at the held-out error on the way."""

    seconds: float
    cpu_s: float
    steps: int
    queries: int
    curve: tuple[dict[str, float], ...] = ()


def _row(
    cell: Cell, case: Case, material: Material, ran: _Ran, memory: Mapping[str, int]
) -> dict[str, Any]:
    return {
        **_head(cell),
        "seconds": ran.seconds,
        "cpu_seconds": ran.cpu_s,
        "steps": ran.steps,
        "queries": ran.queries,
        **measures.errors(material, case),
        **measures.sizes(material),
        **measures.rate(material, case),
        "peak_memory_bytes": memory.get("bytes"),
        "curve": list(ran.curve),
    }


def _head(cell: Cell) -> dict[str, Any]:
    return {
        "material": cell.material,
        "model": cell.model,
        "settings": cell.said(),
        "label": cell.label,
        "budget_cpu_s": cell.budget_cpu_s,
        "seed": cell.seed,
        "machine": machine.brief(),
    }


def _closed_form(cell: Cell, case: Case) -> tuple[Material, _Ran, Mapping[str, Any]]:
    start, cpu = time.perf_counter(), time.process_time()
    material, found = closed_form(case.train, cell.model, cell.settings, seed=cell.seed)
    spent = time.perf_counter() - start, time.process_time() - cpu
    return material, _Ran(*spent, 1, case.samples), found.stated() if found else {}


def _trainable(cell: Cell, cases: Sequence[Case]) -> tuple[Any, Any]:
    """What is trained, and the generators that it draws from."""
    from btfkit.fitting.loop import Generators

    first, *others = (case.train for case in cases)
    generators = Generators(cell.seed)
    more: dict[str, Any] = {"others": others} if others else {}
    trainable = begun(
        first, cell.model, np.arange(len(first)), np.arange(0), cell.settings, generators,
        progress=None, **more,
    )  # fmt: skip
    return trainable, generators


def _train(
    trainable: Any,
    generators: Any,
    budget: float,
    look: Callable[[Material], dict[str, float]] | None,
) -> _Ran:
    """Steps until their CPU time is spent; looks do not count."""
    from btfkit.fitting import loop

    looks = iter(np.geomspace(budget / 32, budget, _LOOKS)[:-1])
    due = None if look is None else next(looks, None)
    curve: list[dict[str, float]] = []

    def seen(run: loop.Run) -> None:
        nonlocal due
        if look is not None and due is not None and run.cpu_s >= due:
            due = next((later for later in looks if later > run.cpu_s), None)
            curve.append(_point(run, look(trainable.material())))

    run = loop.Run(None, None, budget_cpu_s=budget)
    loop.train(trainable, run, generators=generators, look=seen)
    if run.interrupted:
        raise KeyboardInterrupt
    if look is not None:
        curve.append(_point(run, look(trainable.material())))
    return _Ran(run.elapsed_s, run.cpu_s, run.done, trainable.queries, tuple(curve))


def _point(run: Any, errors: dict[str, float]) -> dict[str, float]:
    return {"cpu_s": run.cpu_s, "steps": run.done, **errors}
