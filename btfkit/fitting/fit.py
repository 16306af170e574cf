"""`fit`: data in, material and report out, whatever the model."""

from __future__ import annotations

import importlib
import importlib.metadata
import json
import math
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import BTF
from btfkit.errors import FitError
from btfkit.files import refuse_existing, whole
from btfkit.fitting import CLOSED_FORM, MODELS, TRAINED
from btfkit.jsonvalues import plain
from btfkit.materials import file
from btfkit.materials.base import Material
from btfkit.materials.evaluation import errors_on_btf, errors_on_queries
from btfkit.queries import QuerySet
from btfkit.relief.relief import Relief

Progress = Callable[[int, int], None]


@final
@dataclass(frozen=True)
class FitReport:
    """What a fit gave.

    Attributes:
        material: the fitted model.
        errors: held-out errors by the keys of docs/metrics.md; empty without held-out data.
        seconds, cpu_seconds: of the training alone.
        steps, queries: taken and seen.
        parameters: weights but textures. bytes: of all arrays that answering needs.
        curve: (seconds, step, score) at every look at the held-out data.
        choice: why `auto` took this model and these parts, and why a GPU is not used.
        device: what it was trained on.
        interrupted: whether the user ended it early.
    """

    material: Material
    errors: Mapping[str, Any]
    seconds: float
    cpu_seconds: float
    steps: int
    queries: int
    parameters: int
    bytes: int
    curve: tuple[tuple[float, int, float], ...] = ()
    choice: tuple[str, ...] = ()
    masked_texels: int = 0
    interrupted: bool = False
    out: str | None = None
    settings: Mapping[str, str] = field(default_factory=dict)
    device: str = "cpu"

    def as_dict(self) -> dict[str, Any]:
        """The report as JSON types; errors stand at the top level under their own keys."""
        rest = {k: v for k, v in self.__dict__.items() if k not in ("material", "errors")}
        return {"model": self.material.model, **self.errors, **rest}

    def line(self) -> str:
        """For people: one line, and one for each reason of `auto`."""
        psnr = self.errors.get("psnr")
        error = "no held-out data" if psnr is None else f"held-out PSNR {psnr:.2f} dB"
        line = (
            f"{self.out or self.material.model}: {error}, {self.steps} steps in "
            f"{self.seconds:.1f} s, {self.parameters} weights, {self.bytes / 1e6:.2f} MB"
        )
        return "\n  ".join([line, *self.choice])


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
    settings: Mapping[str, str] | None = None,
    progress: Progress | None = None,
    force: bool = False,
) -> FitReport:
    """Fit a model.

    Args:
        source: a BTF, queries with answers, or a relief (traced on a Bonn-81 grid first).
        model: a name of `MODELS`, or "auto".
        budget_s: wall time of the training alone, seconds; `steps` takes its place where given.
        holdout: share of direction pairs (of rows, for queries) kept for the test, 0 to 1.
        seed: of all randomness.
        device: "auto", "cpu" or "cuda"; auto is CUDA where there is one and the model can.
        out: model file to write, with OUT.report.json beside it; None writes nothing.
        resume: go on with the interrupted fit that left OUT.state.
        settings: the model's own, as text.
        progress: called with (done, total).
        force: whether an existing `out` is replaced.

    Raises:
        ValueError: an unknown model or setting, a holdout that leaves nothing.
        FitError: no usable data, or training that diverges.
        FileExistsError: `out` exists and `force` is False.
    """
    final = None if out is None else refuse_existing(out, force=force)
    source = _traced(source)
    chosen, choice, parts = _chosen(source, model)
    given = {**parts, **(settings or {})}
    train, test = split(len(source), holdout, seed)
    start, cpu = time.perf_counter(), time.process_time()
    if chosen in CLOSED_FORM:
        function = _load(CLOSED_FORM[chosen])
        material: Material = function(source.subset(train), settings=given, progress=progress)
        run = _Ran(time.perf_counter() - start, time.process_time() - cpu, 1, _samples(source))
        if device == "cuda":
            choice = (*choice, _on_cpu(chosen))
    else:
        material, run = _trained(
            source, chosen, train, test, given, seed, device,
            _Plan(None if steps is not None else budget_s, steps, final, resume), progress,
        )  # fmt: skip
        if run.device == "cpu" and device != "cpu" and _gpu():
            choice = (*choice, _on_cpu(chosen))
    header = replace(
        material.header, provenance=_provenance(source, seed, holdout, given, run), steps=run.steps
    )
    material = type(material)(material.spec, material.weights, header)
    report = _report(material, source, test, run, choice, given, final)
    if final is not None:
        file.save(material, final, training=run.training, force=force)
        _write_report(report, final)
        if not run.interrupted:
            _state_file(final).unlink(missing_ok=True)
    return report


def split(count: int, holdout: float, seed: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices for training and for the test, each ascending; the same for equal arguments.

    Raises:
        ValueError: `holdout` outside 0..1, or nothing left to train on.
    """
    if not 0 <= holdout < 1:
        raise ValueError(f"holdout = {holdout}; expected 0 up to, but not, 1")
    held = 0 if holdout == 0 or count == 1 else max(1, round(holdout * count))
    if held >= count:
        raise ValueError(f"holdout = {holdout} of {count} leaves nothing to train on")
    order = np.random.default_rng([seed, 0x5EED]).permutation(count)
    return np.sort(order[held:]), np.sort(order[:held])


@final
@dataclass(frozen=True)
class _Ran:
    """What a training took."""

    seconds: float
    cpu_seconds: float
    steps: int
    queries: int
    curve: tuple[tuple[float, int, float], ...] = ()
    masked: int = 0
    interrupted: bool = False
    training: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    device: str = "cpu"


@final
@dataclass(frozen=True)
class _Plan:
    budget_s: float | None
    steps: int | None
    out: Path | None
    resume: bool


def _trained(
    source: BTF | QuerySet,
    model: str,
    train: NDArray[np.intp],
    test: NDArray[np.intp],
    settings: Mapping[str, str],
    seed: int,
    device: str,
    plan: _Plan,
    progress: Progress | None,
) -> tuple[Material, _Ran]:
    import torch

    from btfkit import native
    from btfkit.fitting import loop

    if device == "cuda" and not _gpu():
        raise FitError("no CUDA device is available", remedy="use --device cpu")
    torch.set_num_threads(native.threads())
    generators = loop.Generators(seed)
    trainable: loop.Trainable = _load(TRAINED[model])(
        source, train, test, settings=settings, generators=generators, progress=progress
    )
    where = "cpu"
    if device != "cpu" and _gpu() and (moved := trainable.on_device(_gpu())):
        trainable, where = moved, _gpu()
    run = loop.Run(plan.budget_s, plan.steps)
    state = None if plan.out is None else _state_file(plan.out)
    best = None
    if plan.resume:
        if state is None or not state.is_file():
            raise FitError(f"nothing to resume: {state} is not there", remedy="leave out --resume")
        best = loop.load_state(state, trainable, run, generators)
    loop.train(
        trainable, run, generators=generators, state_file=state, progress=progress, best=best
    )
    if run.interrupted and state is not None and run.done == 0:
        raise KeyboardInterrupt
    curve = tuple(run.curve)
    ran = _Ran(
        run.elapsed_s, run.cpu_s, run.done, trainable.queries, curve,
        trainable.masked, run.interrupted, trainable.training_arrays(), where,
    )  # fmt: skip
    return trainable.material(), ran


def _gpu() -> str:
    """torch's name of the GPU; empty without one."""
    import torch

    return "cuda" if torch.cuda.is_available() else ""


def _on_cpu(model: str) -> str:
    return f"trained on the CPU: {model} cannot use a GPU"


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
        if model not in MODELS:
            raise ValueError(f"no model {model!r}; there are auto, {', '.join(MODELS)}")
        return model, (), {}
    from btfkit.fitting.choice import choose

    choice = choose(source)
    return choice.model, choice.reasons, choice.settings


def _samples(source: BTF | QuerySet) -> int:
    return len(source) * (math.prod(source.shape[1:3]) if isinstance(source, BTF) else 1)


def _load(home: str) -> Any:
    module, name = home.split(":")
    return getattr(importlib.import_module(module), name)


def _state_file(out: Path) -> Path:
    return out.with_name(out.name + ".state")


def _provenance(
    source: BTF | QuerySet, seed: int, holdout: float, settings: Mapping[str, str], run: _Ran
) -> dict[str, Any]:
    return {
        "data": dict(source.provenance),
        "seed": seed,
        "holdout": holdout,
        "settings": dict(settings),
        "steps": run.steps,
        "btfkit": importlib.metadata.version("btfkit"),
    }


def _report(
    material: Material,
    source: BTF | QuerySet,
    test: NDArray[np.intp],
    run: _Ran,
    choice: tuple[str, ...],
    settings: Mapping[str, str],
    out: Path | None,
) -> FitReport:
    errors: Mapping[str, Any] = {}
    if len(test) and isinstance(source, BTF):
        errors = errors_on_btf(material, source, pairs=test)
    elif len(test) and isinstance(source, QuerySet):
        errors = errors_on_queries(material, source.subset(test))
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
        choice=choice,
        masked_texels=run.masked,
        interrupted=run.interrupted,
        out=None if out is None else os.fspath(out),
        settings=settings,
        device=run.device,
    )


def _write_report(report: FitReport, out: Path) -> None:
    name = out.with_name(out.name.removesuffix(".safetensors") + ".report.json")
    header = asdict(report.material.header)
    with whole(name, force=True) as partial:
        text = json.dumps(plain({**report.as_dict(), "header": header}), indent=1)
        partial.write_text(text)
