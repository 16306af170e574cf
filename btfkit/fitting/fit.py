"""`fit`: data in, material and report out, whatever the model."""

from __future__ import annotations

import importlib
import importlib.metadata
import math
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from btfkit.btf import BTF
from btfkit.coverage import SAMPLE, Coverage
from btfkit.errors import FitError, unknown
from btfkit.files import refuse_existing
from btfkit.fitting import CLOSED_FORM, MODELS, TAUGHT, TRACED, gains, loaded
from btfkit.fitting.phases import Phases, Told
from btfkit.fitting.reading import masked, read_once
from btfkit.fitting.report import FitReport
from btfkit.fitting.saving import report_file, save, state_file
from btfkit.fitting.training import Plan, Progress, Ran, gpu, solved, trained
from btfkit.heldout import fingerprint, shared_split
from btfkit.materials.base import Material
from btfkit.materials.evaluation import errors_on_btf, errors_on_queries
from btfkit.queries import QuerySet
from btfkit.relief.relief import Relief
from btfkit.settings import as_text

_DEVICES = ("auto", "cpu", "cuda")


def fit(
    source: BTF | QuerySet | Relief | None,
    *,
    model: str = "auto",
    teacher: Material | None = None,
    budget_s: float = 300.0,
    steps: int | None = None,
    holdout: float = 0.05,
    seed: int = 0,
    device: str = "auto",
    out: str | os.PathLike[str] | None = None,
    resume: bool = False,
    settings: Mapping[str, Any] | None = None,
    full_report: bool = False,
    progress: Progress | None = None,
    phase: Told | None = None,
    force: bool = False,
) -> FitReport:
    """Fit a model.

    `import btfkit` makes OpenMP's threads sleep where they wait (OMP_WAIT_POLICY=PASSIVE), unless
    torch was imported before it: on a busy machine such a fit is several times slower.

    Args:
        source: a BTF, queries with answers, or a relief (traced on a Bonn-81 grid first, or as
            the model asks for).
        model: a name of `MODELS`, or "auto".
        teacher: a fitted model whose answers a `student` learns; then `source` may be None: what
            the errors tell is how far the student is from its teacher.
        budget_s: wall time from the end of reading to the end, seconds, evaluation included: that
            takes at most a tenth, at least 2 s. `steps` takes its place where given.
        holdout: share of direction pairs (of rows, for queries) kept for the test, 0 to 1.
        seed: of all randomness.
        device: "auto", "cpu" or "cuda"; auto is CUDA where there is one and the model can.
        out: model file to write, with OUT.report.json beside it; None writes nothing.
        resume: go on with the interrupted fit that left OUT.state; what that wrote is replaced.
        settings: the model's own, by name; values as text, numbers or booleans.
        full_report: evaluate every held-out pair, however long it takes.
        progress: called with (done, total) of the present part.
        phase: called with (name, seconds left or None) when a part begins: reading, starting,
            training, writing, evaluating.
        force: whether an existing `out`, or the state of an interrupted fit, is replaced.

    Raises:
        ValueError: an unknown model, setting or device, a budget or holdout that leaves nothing.
        FitError: no usable data, or training that diverges.
        FileExistsError: `out` exists and `force` is False.
        OSError: nothing can be written where `out` shall lie.
    """
    _check(model, budget_s, steps, device)
    _check_taught(model, source, teacher)
    shared_split(1, holdout, seed)  # refuses what is no share
    final = _out(out, resume=resume, force=force)
    plan = Plan(steps, final, resume, force or resume, seed, holdout, device)
    phases = Phases(budget_s if steps is None else None, phase)
    phases.begin("reading")
    data = read_once(_traced(_asked(source, teacher, seed), model, seed))
    chosen, choice, parts = _chosen(data, model)
    relief = source if isinstance(source, Relief) else None
    if relief is not None and chosen in TRACED:
        parts = {**parts, "wrap": relief.wrap}
    given = {**parts, **as_text(settings or {})}
    if relief is None and chosen == "sbtf" and isinstance(data, BTF):
        relief, told = _relief_behind(data, given, plan, budget_s, phases, progress)
        choice = (*choice, told) if told else choice
    if chosen in CLOSED_FORM:
        train = shared_split(len(data), holdout, seed)[0]
        material, run = solved(data.subset(train), chosen, given, plan, progress)
        if "gains.pairs" in run.training:
            run = replace(run, training={**run.training, "gains.pairs": train})
    else:
        material, run = trained(data, chosen, given, plan, phases, progress, relief, teacher)
    if phases.late():
        said = f"starting took {phases.seconds['starting']:.0f} s of a budget of {budget_s:g} s"
        choice = (*choice, f"{said}: training had its least share, and ended late")
    if _cpu_alone(chosen, run.device, device):
        what = f"{chosen} with gains" if gains.asked_for(given) else chosen
        choice = (*choice, f"trained on the CPU: {what} cannot use a GPU")
    provenance = _provenance(data, plan, given, run)
    if teacher is not None:
        of = {"model": teacher.model, "provenance": dict(teacher.header.provenance)}
        provenance["teacher"] = of
    header = replace(
        material.header, provenance=provenance, steps=run.steps, coverage=_covered(data, plan)
    )
    material = type(material)(material.spec, material.weights, header)
    if final is not None:
        # Before the evaluation: whatever happens there, the model is safe.
        phases.begin("writing")
        save(material, final, run.training, force=plan.force)
    phases.begin("evaluating")
    errors: Mapping[str, Any] = {}
    try:
        limit = None if full_report else phases.evaluating_s()
        errors = _errors(material, data, plan, limit, progress, gains=gains.asked_for(given))
        if "psnr_carried" in run.stated and "psnr" in errors:
            errors = {**errors, "psnr_own": errors["psnr"]}
        errors = {**errors, **run.stated}
    except KeyboardInterrupt:
        choice = (*choice, "not evaluated, because interrupted: btfkit eval does it")
    phases.end()
    report = replace(_report(material, errors, data, plan, run, phases), choice=choice)
    if final is not None:
        report.write(report_file(final))
        if not run.interrupted:
            state_file(final).unlink(missing_ok=True)
    return report


def _check(model: str, budget_s: float, steps: int | None, device: str) -> None:
    """ValueError for what no fit can take, whoever asks."""
    if model != "auto" and model not in MODELS:
        raise ValueError(unknown("model", model, ["auto", *MODELS]))
    if not (math.isfinite(budget_s) and budget_s > 0):
        raise ValueError(f"budget_s = {budget_s}; expected seconds above 0")
    if steps is not None and steps < 0:
        raise ValueError(f"steps = {steps}; expected 0 or more")
    if device not in _DEVICES:
        raise ValueError(unknown("device", device, _DEVICES))


def _check_taught(
    model: str, source: BTF | QuerySet | Relief | None, teacher: Material | None
) -> None:
    """ValueError for a teacher nobody listens to, or neither data nor teacher."""
    if teacher is not None and model not in TAUGHT:
        raise ValueError(f"{model} learns from data alone; from a model does: {', '.join(TAUGHT)}")
    if source is None and teacher is None:
        raise ValueError("nothing to fit to: neither data nor a teacher is named")


def _asked(
    source: BTF | QuerySet | Relief | None, teacher: Material | None, seed: int
) -> BTF | QuerySet | Relief:
    """The data, or queries that the teacher answers."""
    if source is not None:
        return source
    from btfkit.fitting.student.lessons import queries_of

    assert teacher is not None
    return queries_of(teacher, seed=seed)


def _out(out: str | os.PathLike[str] | None, *, resume: bool, force: bool) -> Path | None:
    """Where the model goes, once it is sure that it can.

    Raises:
        FileExistsError: something lies there that nobody said may be replaced.
        FitError: there is nothing to resume.
    """
    if out is None:
        if resume:
            raise FitError("nothing to resume: no out is named", remedy="name it with out")
        return None
    state = state_file(Path(out))
    if resume and not state.is_file():
        raise FitError(f"nothing to resume: {state} is not there", remedy="leave out --resume")
    # What an interruption wrote is there to be replaced by what goes on with it.
    final = refuse_existing(out, force=force or resume)
    if state.exists() and not (resume or force):
        raise FileExistsError(
            f"{state} is there, of an interrupted fit: --resume (resume=True) goes on with it, "
            f"--force (force=True) starts anew"
        )
    return final


def _cpu_alone(model: str, used: str, device: str) -> bool:
    """Whether a GPU was asked for, or is there, and the model cannot use it."""
    if model in CLOSED_FORM:
        return device == "cuda"
    return used == "cpu" and device != "cpu" and bool(gpu())


def _traced(source: BTF | QuerySet | Relief, model: str, seed: int) -> BTF | QuerySet:
    if not isinstance(source, Relief):
        return source
    if model in TRACED:
        queries: QuerySet = loaded(TRACED[model])(source, seed=seed)
        return queries
    from btfkit import directions
    from btfkit.relief.trace import traced_btf

    table = directions.bonn81().astype(np.float32)
    light, view = np.tile(table, (len(table), 1)), np.repeat(table, len(table), axis=0)
    return traced_btf(source, light, view)


def _chosen(source: BTF | QuerySet, model: str) -> tuple[str, tuple[str, ...], Mapping[str, str]]:
    if model != "auto":
        return model, (), {}
    from btfkit.fitting.choice import choose

    choice = choose(source)
    return choice.model, choice.reasons, choice.settings


def _relief_behind(
    data: BTF,
    given: Mapping[str, str],
    plan: Plan,
    budget_s: float,
    phases: Phases,
    progress: Progress | None,
) -> tuple[Relief | None, str]:
    """The relief of the training pairs, for outlines; what is said of it, or nothing."""
    if given.get("heights", "auto") == "found":
        return None, ""
    from btfkit.fitting.heightfield.chain import relief_behind

    phases.begin("heights")
    train = data.subset(shared_split(len(data), plan.holdout, plan.seed)[0])
    relief, told = relief_behind(
        train, budget_s=None if plan.steps is not None else budget_s, steps=plan.steps,
        seed=plan.seed, progress=progress,
    )  # fmt: skip
    phases.begin("reading")
    return relief, told


def _covered(data: BTF | QuerySet, plan: Plan) -> Coverage | None:
    """Which directions the training saw; None where no pair is seen from above."""
    rows = shared_split(len(data), plan.holdout, plan.seed)[0]
    if isinstance(data, QuerySet):
        rows = rows[data.valid()[rows]]
    seen = rows[data.view[:, 2][rows] > 0]
    count = len(seen)
    if count > SAMPLE:
        seen = seen[np.random.default_rng(0).choice(count, SAMPLE, replace=False)]
    return Coverage.of(data.light[seen], data.view[seen], count=count) if count else None


def _provenance(
    source: BTF | QuerySet, plan: Plan, settings: Mapping[str, str], run: Ran
) -> dict[str, Any]:
    found = {
        "data": dict(source.provenance),
        "fingerprint": fingerprint(source),
        "seed": plan.seed,
        "holdout": plan.holdout,
        "settings": dict(settings),
        "steps": run.steps,
        "btfkit": importlib.metadata.version("btfkit"),
    }
    found |= {"untrained": list(run.untrained)} if run.untrained else {}
    return found | ({"stated": dict(run.stated)} if run.stated else {})


def _errors(
    material: Material,
    source: BTF | QuerySet,
    plan: Plan,
    limit_s: float | None,
    progress: Progress | None,
    *,
    gains: bool,
) -> Mapping[str, Any]:
    """Held-out errors; of a BTF, of as many pairs as there is time for, in random order."""
    test = shared_split(len(source), plan.holdout, plan.seed)[1]
    if not len(test):
        return {}
    if isinstance(source, QuerySet):
        return errors_on_queries(material, source.subset(test))
    if limit_s is not None:
        test = np.random.default_rng([plan.seed, 0xE7A1]).permutation(test)
    return errors_on_btf(
        material, source, pairs=test, within_s=limit_s, progress=progress, gains=gains
    )


def _report(
    material: Material,
    errors: Mapping[str, Any],
    source: BTF | QuerySet,
    plan: Plan,
    run: Ran,
    phases: Phases,
) -> FitReport:
    train, test = shared_split(len(source), plan.holdout, plan.seed)
    textures = [n for n in material.weights if "texture" in n]
    sizes = {name: array.size for name, array in material.weights.items()}
    return FitReport(
        material=material,
        errors=errors,
        seconds=run.seconds,
        cpu_seconds=run.cpu_seconds,
        steps=run.steps,
        queries=run.queries,
        parameters=sum(size for name, size in sizes.items() if name not in textures),
        bytes=sum(array.nbytes for array in material.weights.values()),
        curve=run.curve,
        masked_texels=masked(source, train),
        interrupted=run.interrupted,
        out=None if plan.out is None else os.fspath(plan.out),
        settings=material.header.provenance["settings"],
        device=run.device,
        held_out=tuple(test.tolist()),
        untrained=run.untrained,
        phases=dict(phases.seconds),
    )
