"""`fit`: data in, material and report out, whatever the model."""

from __future__ import annotations

import importlib
import importlib.metadata
import math
import os
import secrets
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import BTF
from btfkit.errors import FitError, unknown
from btfkit.files import refuse_existing, room_for
from btfkit.fitting import CLOSED_FORM, MODELS, TRAINED
from btfkit.fitting.phases import Phases, Told
from btfkit.fitting.reading import masked, read_once
from btfkit.fitting.report import FitReport, report_file
from btfkit.heldout import fingerprint, split
from btfkit.materials import file
from btfkit.materials.base import Material
from btfkit.materials.evaluation import errors_on_btf, errors_on_queries
from btfkit.queries import QuerySet
from btfkit.relief.relief import Relief
from btfkit.settings import as_text

Progress = Callable[[int, int], None]
_DEVICES = ("auto", "cpu", "cuda")


def fit(
    source: BTF | QuerySet | Relief,
    *,
    model: str = "auto",
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
        source: a BTF, queries with answers, or a relief (traced on a Bonn-81 grid first).
        model: a name of `MODELS`, or "auto".
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
    split(2, holdout, seed)
    final = _out(out, resume=resume, force=force)
    plan = _Plan(steps, final, resume, force or resume, seed, holdout, device)
    phases = Phases(budget_s if steps is None else None, phase)
    phases.begin("reading")
    data = read_once(_traced(source))
    chosen, choice, parts = _chosen(data, model)
    given = {**parts, **as_text(settings or {})}
    if chosen in CLOSED_FORM:
        train = split(len(data), holdout, seed)[0]
        material, run = _solved(data.subset(train), chosen, given, plan, progress)
    else:
        material, run = _trained(data, chosen, given, plan, phases, progress)
    if phases.late():
        said = f"starting took {phases.seconds['starting']:.0f} s of a budget of {budget_s:g} s"
        choice = (*choice, f"{said}: training had its least share, and ended late")
    if _cpu_alone(chosen, run.device, device):
        choice = (*choice, f"trained on the CPU: {chosen} cannot use a GPU")
    provenance = _provenance(data, plan, given, run)
    header = replace(material.header, provenance=provenance, steps=run.steps)
    material = type(material)(material.spec, material.weights, header)
    if final is not None:
        # Before the evaluation: whatever happens there, the model is safe.
        phases.begin("writing")
        _save(material, final, run.training, force=plan.force)
    phases.begin("evaluating")
    errors: Mapping[str, Any] = {}
    try:
        limit = None if full_report else phases.evaluating_s()
        errors = _errors(material, data, plan, limit, progress)
    except KeyboardInterrupt:
        choice = (*choice, "not evaluated, because interrupted: btfkit eval does it")
    phases.end()
    report = replace(_report(material, errors, data, plan, run, phases), choice=choice)
    if final is not None:
        report.write(report_file(final))
        if not run.interrupted:
            _state_file(final).unlink(missing_ok=True)
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
    state = _state_file(Path(out))
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


@final
@dataclass(frozen=True)
class _Ran:
    """What a training took."""

    seconds: float
    cpu_seconds: float
    steps: int
    queries: int
    curve: tuple[tuple[float, int, float], ...] = ()
    interrupted: bool = False
    training: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    device: str = "cpu"
    untrained: tuple[str, ...] = ()


@final
@dataclass(frozen=True)
class _Plan:
    """What is asked of a fit, once it has been checked."""

    steps: int | None
    out: Path | None
    resume: bool
    force: bool
    seed: int
    holdout: float
    device: str


def _solved(
    source: BTF | QuerySet,
    model: str,
    settings: Mapping[str, str],
    plan: _Plan,
    progress: Progress | None,
) -> tuple[Material, _Ran]:
    """A closed form, which reads its data as it goes."""
    if plan.resume:
        raise FitError(f"nothing to resume: {model} is solved at once", remedy="leave out --resume")
    if plan.out is not None and model == "interpolation":
        room_for(plan.out, 2 * _values(source), what="an interpolation of these data")
    start, cpu = time.perf_counter(), time.process_time()
    function = _load(CLOSED_FORM[model])
    material: Material = function(source, settings=settings, progress=progress)
    seconds = time.perf_counter() - start, time.process_time() - cpu
    return material, _Ran(*seconds, 1, _samples(source))


def _trained(
    source: BTF | QuerySet,
    model: str,
    settings: Mapping[str, str],
    plan: _Plan,
    phases: Phases,
    progress: Progress | None,
) -> tuple[Material, _Ran]:
    import torch

    from btfkit import native
    from btfkit.fitting import loop

    if plan.device == "cuda" and not _gpu():
        raise FitError("no CUDA device is available", remedy="use --device cpu")
    torch.set_num_threads(native.threads())
    generators = loop.Generators(plan.seed)
    if isinstance(source, QuerySet):
        phases.begin("starting")
    train, test = split(len(source), plan.holdout, plan.seed)
    trainable: loop.Trainable = _load(TRAINED[model])(
        source, train, test, settings=settings, generators=generators,
        progress=phases.reading(progress),
    )  # fmt: skip
    where = "cpu"
    if plan.device != "cpu" and _gpu() and (moved := trainable.on_device(_gpu())):
        trainable, where = moved, _gpu()
    run = loop.Run(None, plan.steps)
    state, best = None if plan.out is None else _state_file(plan.out), None
    if state is not None:
        held = sum(tensor.nbytes for tensor in trainable.state().values())
        # The present state, the best one, and the model itself.
        room_for(state, 3 * held, what="what a fit can be resumed from")
        if plan.resume:
            best = loop.load_state(state, trainable, run, generators)
    phases.begin("training")
    if plan.steps is None:
        run.budget_s = phases.training_s()
    loop.train(
        trainable, run, generators=generators, state_file=state, progress=progress, best=best
    )
    if run.interrupted and state is not None and run.done == 0:
        raise KeyboardInterrupt
    ran = _Ran(
        run.elapsed_s, run.cpu_s, run.done, trainable.queries, tuple(run.curve),
        run.interrupted, trainable.training_arrays(), where, trainable.untrained(),
    )  # fmt: skip
    return trainable.material(), ran


def _save(
    material: Material, out: Path, training: Mapping[str, NDArray[Any]], *, force: bool
) -> None:
    """Write the model; where that fails, write it elsewhere and say where."""
    try:
        file.save(material, out, training=training, force=force)
    except OSError as error:
        kept = _saved_elsewhere(material, out, training)
        if kept is None:
            raise
        raise OSError(
            error.errno, f"{error.strerror or error}; what was trained is kept as {kept}", str(out)
        ) from error


def _saved_elsewhere(
    material: Material, out: Path, training: Mapping[str, NDArray[Any]]
) -> Path | None:
    for folder in (Path.cwd(), Path.home(), Path(tempfile.gettempdir())):
        kept = folder / f"{out.stem}.{secrets.token_hex(4)}.safetensors"
        try:
            file.save(material, kept, training=training)
        except (OSError, RuntimeError):
            continue
        return kept
    return None


def _gpu() -> str:
    """torch's name of the GPU; empty without one."""
    import torch

    return "cuda" if torch.cuda.is_available() else ""


def _cpu_alone(model: str, used: str, device: str) -> bool:
    """Whether a GPU was asked for, or is there, and the model cannot use it."""
    if model in CLOSED_FORM:
        return device == "cuda"
    return used == "cpu" and device != "cpu" and bool(_gpu())


def _traced(source: BTF | QuerySet | Relief) -> BTF | QuerySet:
    if not isinstance(source, Relief):
        return source
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


def _samples(source: BTF | QuerySet) -> int:
    return len(source) * (math.prod(source.shape[1:3]) if isinstance(source, BTF) else 1)


def _values(source: BTF | QuerySet) -> int:
    return math.prod(source.shape) if isinstance(source, BTF) else 0


def _load(home: str) -> Any:
    module, name = home.split(":")
    return getattr(importlib.import_module(module), name)


def _state_file(out: Path) -> Path:
    return out.with_name(out.name + ".state")


def _provenance(
    source: BTF | QuerySet, plan: _Plan, settings: Mapping[str, str], run: _Ran
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
    return found | ({"untrained": list(run.untrained)} if run.untrained else {})


def _errors(
    material: Material,
    source: BTF | QuerySet,
    plan: _Plan,
    limit_s: float | None,
    progress: Progress | None,
) -> Mapping[str, Any]:
    """Held-out errors; of a BTF, of as many pairs as there is time for, in random order."""
    test = split(len(source), plan.holdout, plan.seed)[1]
    if not len(test):
        return {}
    if isinstance(source, QuerySet):
        return errors_on_queries(material, source.subset(test))
    if limit_s is not None:
        test = np.random.default_rng([plan.seed, 0xE7A1]).permutation(test)
    return errors_on_btf(material, source, pairs=test, within_s=limit_s, progress=progress)


def _report(
    material: Material,
    errors: Mapping[str, Any],
    source: BTF | QuerySet,
    plan: _Plan,
    run: _Ran,
    phases: Phases,
) -> FitReport:
    train, test = split(len(source), plan.holdout, plan.seed)
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
