"""`btfkit fit`: a BTF, a relief or a query file -> a material."""

from __future__ import annotations

import shlex
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from btfkit.cli.bar import Bar
from btfkit.cli.many import cluster_option, outputs, over, the_one
from btfkit.cli.options import (
    DurationType,
    FiniteType,
    LocationType,
    SettingType,
    completed,
    fitted_models,
    force_option,
    out_option,
    seed_option,
    stem,
    the_only,
)
from btfkit.cli.outcome import INTERRUPTED, Outcome, command_line, verb
from btfkit.cli.preview import of_material, preview_option
from btfkit.remote import Location, located

if TYPE_CHECKING:
    from btfkit.fitting.report import FitReport


def _models() -> str:
    """Every model with its settings and their defaults, for `--help`."""
    from btfkit.fitting import MODELS, settings_of

    lines = ["Models and their settings (--set key=value), with defaults:", "", "\b"]
    for model in MODELS:
        given = " ".join(f"{name}={value}" for name, value in settings_of(model).items())
        lines += textwrap.wrap(f"{model}: {given or 'none'}", 76, subsequent_indent="    ")
    return "\n".join(lines)


@verb(
    "fit",
    example="""btfkit fit wool.btf.zarr --model neubtf --budget 10m
btfkit fit *.btf.zarr --model neumip --cluster tcp://host:8786 -o models""",
    more=_models,
)
@click.argument("sources", metavar="[SOURCE]", nargs=-1, type=LocationType())
@click.option(
    "--model", default="auto", show_default=True, help="Name of a model, or auto.",
    shell_complete=completed(lambda: ["auto", *fitted_models()]),
)  # fmt: skip
@click.option(
    "--from", "teacher", type=click.Path(path_type=Path),
    help="A fitted model that teaches --model student; SOURCE may be left out then.",
)  # fmt: skip
@out_option("The model file; by default SOURCE.MODEL.safetensors here; of several, their folder")
@click.option(
    "--budget",
    type=DurationType(),
    default="5m",
    show_default=True,
    help="Wall time from the end of reading to the end, evaluation included.",
)
@click.option("--steps", type=click.IntRange(min=0), help="Train this many steps instead.")
@click.option(
    "--holdout",
    type=FiniteType(0, 1, max_open=True),
    default=0.05,
    show_default=True,
    help="Share of the direction pairs (or query rows) kept for the test.",
)
@click.option(
    "--device", type=click.Choice(["auto", "cpu", "cuda"]), default="auto", show_default=True
)
@click.option("--resume", is_flag=True, help="Go on with an interrupted fit of the same output.")
@click.option("--set", "settings", type=SettingType(), multiple=True, help="A model's setting.")
@click.option(
    "--full-report", is_flag=True, help="Evaluate every held-out pair, beyond the budget."
)
@cluster_option
@preview_option
@seed_option
@force_option
def fit_verb(
    bar: Bar,
    *,
    sources: tuple[Location, ...],
    model: str,
    teacher: Path | None,
    out: Path | None,
    budget: float,
    steps: int | None,
    holdout: float,
    device: str,
    resume: bool,
    settings: tuple[tuple[str, str], ...],
    full_report: bool,
    cluster: str | None,
    preview: bool,
    seed: int,
    force: bool,
) -> Outcome:
    """Fit a model to SOURCE; without SOURCE, to the only store in this folder.

    SOURCE: a native store, anything `btfkit ingest` reads, a relief file or a query file.
    Writes the model and OUT.report.json beside it. Ctrl-C keeps the best state so far.
    With --cluster, several: a task a material; one that fails is named at the end.
    `--model student --from MODEL` fits a small model to a large one's answers.
    Under torchrun several processes fit one material (neumip, sbtf).
    """
    from btfkit.errors import unknown
    from btfkit.fitting import MODELS
    from btfkit.fitting.fit import fit
    from btfkit.fitting.training import following
    from btfkit.sources import material, measured

    if model != "auto" and model not in MODELS:
        raise ValueError(unknown("model", model, ["auto", *MODELS]))
    asked: dict[str, Any] = {
        "model": model, "budget_s": budget, "steps": steps, "holdout": holdout, "seed": seed,
        "device": device, "settings": dict(settings), "full_report": full_report,
    }  # fmt: skip

    def named(source: Location) -> Path:
        return Path(f"{stem(source)}.{model}.safetensors")

    if cluster and teacher is not None:
        raise ValueError("--from teaches one student, and --cluster fits many: leave out one")
    if cluster:
        targets = outputs(sources, out, named)
        return _on_cluster(cluster, targets, asked, preview, resume=resume, force=force, bar=bar)
    bar.phase("reading")
    path = the_one(sources, "sources")
    if path is None and teacher is None:
        path = the_only(
            Path().glob("*.btf.zarr"),
            what="stores",
            remedy="name one: btfkit fit STORE",
            first="btfkit ingest FOLDER, or name a SOURCE",
        )
    taught = None if teacher is None else material(teacher)
    if path is not None:
        default = named(path)
    else:
        assert teacher is not None
        assert taught is not None
        # wool.neumip.safetensors teaches wool.student.safetensors.
        own = stem(teacher).removesuffix(f".{taught.model}")
        default = Path(f"{own}.{model}.safetensors")
    report = fit(
        None if path is None else measured(path),
        teacher=taught,
        # Of processes that fit together only the first one writes.
        out=None if following() else out or default,
        resume=resume and not following(),
        progress=bar,
        phase=bar.phase,
        force=force,
        **asked,
    )
    if report.interrupted:
        return _to_go_on(report)
    return _fitted(report, preview)


def _fitted(report: FitReport, preview: bool) -> Outcome:
    left = of_material(report.material, Path(report.out)) if preview and report.out else {}
    return Outcome(report.line(), {**report.as_dict(), **left}, then=_next(report))


def _on_cluster(
    where: str,
    targets: Mapping[str, Location],
    asked: Mapping[str, Any],
    preview: bool,
    *,
    resume: bool,
    force: bool,
    bar: Bar,
) -> Outcome:
    """A task a source; a fit whose worker is lost goes on from its last state on another."""
    from btfkit.cluster import Ended
    from btfkit.files import refuse_existing
    from btfkit.fitting.saving import state_file

    tasks: dict[str, Sequence[Any] | Ended] = {}
    for source, target in targets.items():
        out = Path(str(target))
        state = state_file(out)
        try:
            refuse_existing(out, force=force or (resume and state.exists()))
            if force and not resume:
                state.unlink(missing_ok=True)
            elif state.exists() and not resume:
                raise FileExistsError(
                    f"{state} is there, of an interrupted fit: --resume or --force"
                )
        except OSError as error:
            tasks[source] = Ended(error=error)
        else:
            tasks[source] = (out, asked, preview)
    return over(where, tasks, _task, bar)


def _task(source: str, out: Path, asked: Mapping[str, Any], preview: bool) -> Outcome:
    """Fit a source on a worker; one that another worker began goes on where that left it."""
    from btfkit.fitting.fit import fit
    from btfkit.fitting.saving import state_file
    from btfkit.sources import measured

    begun = state_file(out).is_file()
    # What lies there is what a lost worker of this very call left.
    report = fit(measured(located(source)), out=out, resume=begun, force=True, **asked)
    return _fitted(report, preview)


def _to_go_on(report: FitReport) -> Outcome:
    """An interrupted fit: where its state lies, and the command that goes on with it."""
    again = command_line(drop=("--force",), add=("--resume",))
    state = f"{report.out}.state"
    line = f"{report.line()}\n  state: {state}\n  go on: {again}"
    data = {**report.as_dict(), "state": state, "go_on": again}
    return Outcome(line, data, code=INTERRUPTED)


def _next(report: FitReport) -> str:
    """What one does with a fitted model."""
    out = shlex.quote(report.out or "")
    if report.material.model in ("neubtf", "neubtf-paper") and not report.untrained:
        return f"btfkit propagate guidance.png --model {out}"
    try:
        report.material.program()
    except TypeError:
        return f"btfkit render {out} --shape sphere"
    return f"btfkit view {out}"
