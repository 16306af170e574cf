"""The part of a fit in which the model comes about: solved at once, or trained by steps."""

from __future__ import annotations

import ctypes
import math
import os
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast, final

import numpy as np
from numpy.typing import NDArray

from btfkit import native
from btfkit.btf import BTF
from btfkit.errors import FitError
from btfkit.files import room_for
from btfkit.fitting import CLOSED_FORM, TRAINED, gains, loaded
from btfkit.fitting.phases import Phases
from btfkit.fitting.saving import state_file
from btfkit.heldout import split
from btfkit.materials.base import Material
from btfkit.queries import QuerySet
from btfkit.relief.relief import Relief

if TYPE_CHECKING:
    from btfkit.fitting.loop import Run, Trainable

Progress = Callable[[int, int], None]
# Of a budget, what a fit may have spent that was cut in its last step.
_SPENT = 1.5


@final
@dataclass(frozen=True)
class Ran:
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
    stated: Mapping[str, Any] = field(default_factory=dict)


@final
@dataclass(frozen=True)
class Plan:
    """What is asked of a fit, once it has been checked."""

    steps: int | None
    out: Path | None
    resume: bool
    force: bool
    seed: int
    holdout: float
    device: str


def solved(
    source: BTF | QuerySet,
    model: str,
    settings: Mapping[str, str],
    plan: Plan,
    progress: Progress | None,
) -> tuple[Material, Ran]:
    """A closed form, which reads its data as it goes."""
    if plan.resume:
        raise FitError(f"nothing to resume: {model} is solved at once", remedy="leave out --resume")
    if shared():
        raise FitError(f"{model} is fitted by one process", remedy="start it without torchrun")
    if plan.out is not None and model == "interpolation":
        room_for(plan.out, 2 * _values(source), what="an interpolation of these data")
    start, cpu = time.perf_counter(), time.process_time()
    material, found = closed_form(source, model, settings, seed=plan.seed, progress=progress)
    seconds = time.perf_counter() - start, time.process_time() - cpu
    ran = Ran(*seconds, 1, _samples(source))
    if found is not None:
        ran = replace(ran, training=found.arrays(), stated=found.stated())
    return material, ran


def closed_form(
    source: BTF | QuerySet,
    model: str,
    settings: Mapping[str, str],
    *,
    seed: int = 0,
    progress: Progress | None = None,
) -> tuple[Material, gains.Found | None]:
    """The material of a closed form, and the gains where `gains=true` asks for them."""
    function = loaded(CLOSED_FORM[model])
    own = gains.without(settings)
    if gains.wanted(settings, model, source):
        btf = cast(BTF, source)
        return gains.solved(function, btf, settings=own, progress=progress, seed=seed)
    return function(source, settings=own, progress=progress), None


def begun(
    source: BTF | QuerySet,
    model: str,
    train: NDArray[np.intp],
    test: NDArray[np.intp],
    settings: Mapping[str, str],
    generators: Any,
    **more: Any,
) -> Trainable:
    """What is trained: the model's own trainable, with gains where `gains=true` asks for them.

    Args:
        generators: `loop.Generators`. more: what the trainable takes beside.
    """
    from btfkit.fitting.alternating import Gained

    finds = gains.wanted(settings, model, source)
    data = gains.prepared(cast(BTF, source), generators.seed) if finds else source
    kind = loaded(TRAINED[model])
    _limit_threads()
    trainable: Trainable = kind(
        data, train, test, settings=gains.without(settings), generators=generators, **more
    )
    _limit_threads()
    return Gained(trainable, gains.Found(cast(BTF, data), train)) if finds else trainable


def trained(
    source: BTF | QuerySet,
    model: str,
    settings: Mapping[str, str],
    plan: Plan,
    phases: Phases,
    progress: Progress | None,
    relief: Relief | None = None,
    teacher: Material | None = None,
) -> tuple[Material, Ran]:
    """A model trained by steps, until they or the budget are spent, or Ctrl-C ends it.

    Args:
        relief: what the source was traced from, if it was.
        teacher: whose answers the model learns, if it does.
    """
    from btfkit.fitting import loop

    if plan.device == "cuda" and not gpu():
        raise FitError("no CUDA device is available", remedy="use --device cpu")
    # Processes that fit together draw other queries, of other textures where not all have room.
    generators = loop.Generators(plan.seed + int(os.environ["RANK"] if shared() else 0))
    if isinstance(source, QuerySet):
        phases.begin("starting")
    train, test = split(len(source), plan.holdout, plan.seed)
    trainable = begun(
        source, model, train, test, settings, generators,
        progress=phases.reading(progress), **({} if teacher is None else {"teacher": teacher}),
    )  # fmt: skip
    if relief is not None:
        trainable.know(relief)
    where = "cpu"
    if plan.device != "cpu" and gpu() and (moved := trainable.on_device(gpu())):
        trainable, where = moved, gpu()
    if shared():
        from btfkit.fitting.processes import Processes

        trainable.join(Processes(where))
        if following():
            # It has taken its last step with the first.
            sys.exit(0)
    run = loop.Run(None, plan.steps)
    state, best = None if plan.out is None else state_file(plan.out), None
    if state is not None:
        held = sum(tensor.nbytes for tensor in trainable.state().values())
        # The present state, the best one, and the model itself.
        room_for(state, 3 * held, what="what a fit can be resumed from")
        if plan.resume:
            best = loop.load_state(state, trainable, run, generators)
    phases.begin("training")
    if plan.steps is None:
        run.budget_s = phases.training_s()
    if plan.resume:
        _check_left(run)
    try:
        loop.train(
            trainable, run, generators=generators, state_file=state, progress=progress, best=best
        )
    finally:
        trainable.part()
    if run.interrupted and state is not None and run.done == 0:
        raise KeyboardInterrupt
    ran = Ran(
        run.elapsed_s, run.cpu_s, run.done, trainable.queries, tuple(run.curve),
        run.interrupted, trainable.training_arrays(), where, trainable.untrained(),
        trainable.stated(),
    )  # fmt: skip
    return trainable.material(), ran


def _check_left(run: Run) -> None:
    """Refuse to go on with less than was spent, which would end the fit where it was cut.

    One that was killed at its very end has spent all, or a step more, and is finished.
    """
    if run.steps is not None and run.done > run.steps:
        spent, given = f"{run.done} steps", f"{run.steps}"
    elif run.budget_s is not None and run.elapsed_s > _SPENT * run.budget_s:
        spent, given = f"{run.elapsed_s:.1f} s of training", f"{run.budget_s:.1f}"
    else:
        return
    raise FitError(
        f"the state that is resumed has had {spent}, and {given} are left by what is given now",
        remedy="give more than were spent (--budget, --steps); the state is as it was",
    )


def shared(environment: Mapping[str, str] = os.environ) -> bool:
    """Whether torchrun started this process beside others."""
    return environment.get("WORLD_SIZE", "1") not in ("", "1") and "RANK" in environment


def following(environment: Mapping[str, str] = os.environ) -> bool:
    """Whether it started another one first, which decides what is done."""
    return shared(environment) and environment["RANK"] != "0"


def _limit_threads() -> None:
    """Let torch use as many threads as kernels do, where it was loaded at all."""
    if "torch" in sys.modules:
        import torch

        torch.set_num_threads(native.threads())


def gpu() -> str:
    """torch's name of the GPU; empty without one.

    torch takes two seconds to load: where there is no driver it is not asked.
    """
    if "torch" not in sys.modules and not _driver():
        return ""
    import torch

    return "cuda" if torch.cuda.is_available() else ""


def _driver() -> bool:
    """Whether a driver of CUDA, or of ROCm, which torch calls the same, may be installed."""
    if Path("/dev/kfd").exists():
        return True
    try:
        ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return False
    return True


def _samples(source: BTF | QuerySet) -> int:
    return len(source) * (math.prod(source.shape[1:3]) if isinstance(source, BTF) else 1)


def _values(source: BTF | QuerySet) -> int:
    return math.prod(source.shape) if isinstance(source, BTF) else 0
