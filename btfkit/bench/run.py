"""The whole benchmark: cells one after the other, kept as they finish, then tables and plots."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, final

from btfkit.bench import answers, kernels, plots, real, stages, tables
from btfkit.bench.cases import (
    Case,
    asked,
    has_queries,
    name_of,
    procedural,
    rows_of,
    stored,
    stratified,
)
from btfkit.bench.cells import Cell, cells_of, refusal, run_cell, run_together, shared_cells
from btfkit.bench.machine import machine
from btfkit.errors import BtfkitError, unknown
from btfkit.files import whole
from btfkit.fitting import MODELS
from btfkit.io import queryfile
from btfkit.jsonvalues import plain
from btfkit.native.neural import available

Progress = Callable[[float, float], None]


@final
@dataclass(frozen=True)
class Profile:
    """How much is run.

    Attributes:
        materials: of the catalogue. stores: further ones, from files, query files among them.
        models: by name. budgets_cpu_s: of every trained model, ascending.
        size: texels a side. directions: lights, and views, of the traced materials.
        holdout: share of the pairs of stores, and of the rows of query files, that are held out.
        answers: (name, query file) of methods from elsewhere, answered questions.
        seed: of data and models. kernel_seconds: a figure of the kernel tables; 0 for none.
        measured: whether pairs of stores are held out by their angle to the nearest pair trained
            on, and the scoreboard of `btfkit.bench.real` is written.
        stages: of a calibration, by name. small_stages: whether at sizes that take seconds.
    """

    materials: tuple[str, ...] = ("cobbles", "woven", "scratched", "print")
    stores: tuple[Path, ...] = ()
    models: tuple[str, ...] = tuple(MODELS)
    answers: tuple[tuple[str, Path], ...] = ()
    budgets_cpu_s: tuple[float, ...] = (5.0, 15.0, 60.0)
    size: int = 128
    directions: int = 21
    holdout: float = 0.05
    seed: int = 0
    kernel_seconds: float = 0.5
    measured: bool = False
    stages: tuple[str, ...] = ()
    small_stages: bool = False

    @property
    def sources(self) -> tuple[str | Path, ...]:
        """Materials and stores, in the order in which they are run."""
        return (*self.materials, *self.stores)


QUICK = Profile(
    materials=("cobbles", "print"), budgets_cpu_s=(0.5, 1.5), size=48, directions=12,
    kernel_seconds=0.1, small_stages=True,
)  # fmt: skip

# What a scoreboard of measured materials changes of a profile.
REAL: dict[str, Any] = {
    "measured": True, "holdout": 0.1, "budgets_cpu_s": (20.0,), "kernel_seconds": 0.0,
}  # fmt: skip


def run(profile: Profile, folder: Path, *, progress: Progress | None = None) -> dict[str, Any]:
    """Run what of a profile is not in `folder` yet; write tables, plots and JSON of all in it.

    Several processes may run different materials, models or budgets into one folder at a time:
    cells appear whole, and who ends last writes tables of all of them.

    Args:
        profile: what is wanted.
        folder: created where missing; cells that lie there, of the same profile, are not repeated.
        progress: called with (cells done, cells).

    Returns:
        What bench.json holds: machine, profile, cells, tables of kernels.

    Raises:
        ValueError: an unknown model or material, or two materials of one name.
        BtfkitError: `folder` holds cells of another profile.
    """
    _check(profile)
    folder.mkdir(parents=True, exist_ok=True)
    _claim(folder, profile)
    _run_missing(profile, folder, progress)
    _score(profile, folder)
    stages.run_missing(folder, profile.stages, seed=profile.seed, quick=profile.small_stages)
    further = {
        "machine": machine(),
        "profile": json.loads(json.dumps(asdict(profile), default=str)),
        **_kernels(folder, profile),
        "stages": stages.finished(folder),
    }
    rows: list[dict[str, Any]] | None = None
    results: dict[str, Any] = {}
    # Another process may have finished cells meanwhile; the last to write has seen them all.
    while rows != (now := cells_in(folder, profile)):
        rows = now
        results = {**further, "cells": rows}
        _report(folder, results)
        if profile.measured:
            real.write(folder, results)
    return results


def ask(profile: Profile, folder: Path) -> list[Path]:
    """Write the questions of every material, `questions/NAME.npz`, for methods from elsewhere.

    Raises:
        ValueError: an unknown material. BtfkitError: `folder` holds cells of another profile.
    """
    _check(profile)
    (folder / "questions").mkdir(parents=True, exist_ok=True)
    _claim(folder, profile)
    written = []
    for source in profile.sources:
        path = folder / "questions" / f"{name_of(source)}.npz"
        queryfile.write(answers.questions(_case(source, profile)), path, force=True)
        written.append(path)
    return written


def _score(profile: Profile, folder: Path) -> None:
    """A cell for every file of answers, beside those of the models."""
    if not profile.answers:
        return
    cases = [_case(source, profile) for source in profile.sources]
    for name, path in profile.answers:
        given = answers.read(path)
        case = answers.case_of(path, given, cases)
        key = f"{case.name}_{name}".replace(" ", "_").replace("/", "_")
        row = {**answers.scored(name, given, case), "seed": profile.seed, "answers": path.name}
        _write(folder / "cells" / f"{key}.json", {**row, "case": case.describe()})


def _report(folder: Path, results: Mapping[str, Any]) -> None:
    """Plots, tables and JSON of everything."""
    good = [row for row in results["cells"] if "failed" not in row]
    for name, draw in (
        ("rate-distortion.png", plots.rate_distortion),
        ("time-to-error.png", plots.time_to_error),
    ):
        with whole(folder / name, force=True) as partial:
            draw(good, partial)
    for name, told in (
        ("bench.md", tables.markdown(results)),
        ("bench.csv", tables.csv_of(results["cells"])),
        ("bench.tex", tables.latex(results["cells"])),
    ):
        with whole(folder / name, force=True) as partial:
            partial.write_text(told, encoding="utf-8")
    _write(folder / "bench.json", results)


def cells_in(folder: Path, profile: Profile) -> list[dict[str, Any]]:
    """Every finished cell of a folder: materials in the order asked for, then what else lies there,
    models in the order of `MODELS`, budgets ascending.
    """
    rows = [json.loads(path.read_text()) for path in sorted((folder / "cells").glob("[!.]*.json"))]
    first = [name_of(source) for source in profile.sources]
    materials = [*first, *sorted({row["material"] for row in rows} - set(first))]
    models = list(MODELS)

    def order(row: Mapping[str, Any]) -> tuple[Any, ...]:
        model = row["model"]
        return (
            materials.index(row["material"]),
            models.index(model) if model in models else len(models),
            [(k, len(v), v) for k, v in row["settings"].items()],
            row["budget_cpu_s"] or 0,
        )

    return sorted(rows, key=order)


def _run_missing(profile: Profile, folder: Path, progress: Progress | None) -> None:
    """Run the planned cells that are not in the folder: each material's own, then shared ones."""
    pictured = [s for s in profile.sources if isinstance(s, str) or not has_queries(s)]
    planned = [
        cells_of(
            name_of(source), profile.models, profile.budgets_cpu_s, seed=profile.seed,
            rows=profile.size if isinstance(source, str) else rows_of(source),
            pictured=source in pictured, gains=profile.measured,
        )
        for source in profile.sources
    ]  # fmt: skip
    together = shared_cells(
        [name_of(source) for source in pictured if not profile.measured], profile.models,
        profile.budgets_cpu_s, seed=profile.seed,
    )  # fmt: skip
    missing = bool(together) and not all(_file(folder, cell).is_file() for cell in together)
    total = sum(map(len, planned)) + len(together)
    done = 0
    cases: list[Case] = []
    for source, cells in zip(profile.sources, planned, strict=True):
        case: Case | None = None
        for cell in cells:
            if not _file(folder, cell).is_file():
                case = case or _case(source, profile)
                _keep(folder, cell, _run_or_say_why(cell, case), case)
            done += 1
            if progress:
                progress(done, total)
        if missing and source in pictured:
            cases.append(case or _case(source, profile))
    if missing:
        rows = _run_together_or_say_why(together, cases)
        for cell, row, case in zip(together, rows, cases, strict=True):
            _keep(folder, cell, row, case)
    if progress:
        progress(total, total)


def _check(profile: Profile) -> None:
    from btfkit.relief.procedural import CATALOGUE

    for kind, given, known in (
        ("model", profile.models, MODELS),
        ("material", profile.materials, CATALOGUE),
        ("stage", profile.stages, stages.STAGES),
    ):
        for name in given:
            if name not in known:
                raise ValueError(unknown(kind, name, known))
    names = [name_of(source) for source in profile.sources]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise ValueError(
            f"two materials are called {twice[0]!r}, and results are kept by name: rename a store"
        )


def _claim(folder: Path, profile: Profile) -> None:
    """Cells of different data must not meet in one folder."""
    mark = folder / "profile.json"
    decisive = {name: getattr(profile, name) for name in ("size", "directions", "holdout", "seed")}
    if profile.measured:
        decisive["measured"] = True
    if mark.is_file() and json.loads(mark.read_text()) != decisive:
        raise BtfkitError(
            f"{folder} holds results of {json.loads(mark.read_text())}, not of {decisive}",
            remedy="name another folder, or delete this one",
        )
    _write(mark, decisive)


def _case(source: str | Path, profile: Profile) -> Case:
    if isinstance(source, str):
        return procedural(
            source, size=profile.size, directions=profile.directions, seed=profile.seed
        )
    read = asked if has_queries(source) else stratified if profile.measured else stored
    return read(source, holdout=profile.holdout, seed=profile.seed)


def _run_or_say_why(cell: Cell, case: Case) -> dict[str, Any]:
    """A model that cannot take a material is a finding of the benchmark, not its end."""
    try:
        return run_cell(cell, case)
    except (BtfkitError, ValueError) as error:
        return refusal(cell, error)


def _run_together_or_say_why(cells: Sequence[Cell], cases: Sequence[Case]) -> list[dict[str, Any]]:
    try:
        return run_together(cells, cases)
    except (BtfkitError, ValueError) as error:
        return [refusal(cell, error) for cell in cells]


def _kernels(folder: Path, profile: Profile) -> dict[str, Any]:
    kept = folder / "kernels.json"
    if not kept.is_file():
        if profile.kernel_seconds <= 0 or not available():
            return {}
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
    results: dict[str, Any] = json.loads(kept.read_text())
    return results


def _file(folder: Path, cell: Cell) -> Path:
    return folder / "cells" / f"{cell.key}.json"


def _keep(folder: Path, cell: Cell, row: Mapping[str, Any], case: Case) -> None:
    _write(_file(folder, cell), {**row, "case": case.describe()})


def _write(path: Path, value: Mapping[str, Any]) -> None:
    path.parent.mkdir(exist_ok=True)
    with whole(path, force=True) as partial:
        partial.write_text(json.dumps(plain(value), indent=1))
