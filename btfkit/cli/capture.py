"""`btfkit capture`: a measurement, on a rig or on its twin."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from btfkit.cli.bar import Bar
from btfkit.cli.options import force_option, out_option
from btfkit.cli.outcome import Outcome, verb

if TYPE_CHECKING:
    from btfkit.devices.capture.plan import Plan
    from btfkit.devices.twin.log import Twin

_TWIN = ("--fault", "--truth", "--perfect", "--without", "--sample", "--seed")


@verb(
    "capture",
    writes=("out", "truth"),
    example="""btfkit capture --device mock --plan demo -o run --truth truth.btf.zarr
btfkit capture --device usb:RIG7 --plan bonn81 --dry-run
btfkit capture --device usb:RIG7 -o run --resume""",
)
@click.option("--device", required=True, help="mock, mock:WxH (its sensor), usb or usb:SERIAL.")
@click.option("--plan", "plan_name", help="A JSON file, demo, bonn81 or bonn151.")
@out_option("Folder of the sequence")
@click.option("--resume", is_flag=True, help="Go on with the run in the folder.")
@click.option("--dry-run", is_flag=True, help="Order, time and storage; nothing moves.")
@click.option("--watch", is_flag=True, help="Keep watch.html in the folder up to date.")
@click.option("--fault", "faults", multiple=True, metavar="NAME[:N[@K]]",
              help="mock: what goes wrong, N times (from the K-th chance on).")  # fmt: skip
@click.option("--truth", type=click.Path(path_type=Path),
              help="mock: *.btf.zarr of what a perfect rig would have measured.")  # fmt: skip
@click.option("--perfect", is_flag=True, help="mock: no imperfection.")
@click.option("--without", multiple=True, metavar="IMPERFECTION", help="mock: all but this one.")
@click.option("--sample", metavar="NAME|RELIEF.exr", help="mock: what lies on the holder. [woven]")
@click.option("--seed", type=int, help="mock: of all that is drawn. [0]")
@force_option
def capture_verb(
    bar: Bar,
    *,
    device: str,
    plan_name: str | None,
    out: Path | None,
    resume: bool,
    dry_run: bool,
    watch: bool,
    faults: tuple[str, ...],
    truth: Path | None,
    perfect: bool,
    without: tuple[str, ...],
    sample: str | None,
    seed: int | None,
    force: bool,
) -> Outcome:
    """Run a measurement: a plan in, a folder of raw frames with poses out.

    A run that ends early, for whatever reason, goes on with --resume.
    """
    from btfkit.devices import DRIVERS

    driver, _, where = device.partition(":")
    given = {
        "--fault": faults, "--truth": truth, "--perfect": perfect, "--without": without,
        "--sample": sample, "--seed": seed is not None,
    }  # fmt: skip
    wrong = [name for name in _TWIN if given[name]]
    if driver != "mock" and wrong:
        raise click.UsageError(f"{wrong[0]} is for --device mock")
    if driver not in DRIVERS:
        raise click.UsageError(f"--device {device}: expected {' or '.join(DRIVERS)}")
    if perfect and without:
        raise click.UsageError("--perfect leaves nothing for --without")
    from btfkit.devices.capture import plan as plans
    from btfkit.devices.capture.store import PLAN

    if plan_name is None and resume and out is not None:
        if not (out / PLAN).is_file():
            raise FileNotFoundError(f"{out}: no run to resume; leave out --resume to begin one")
        plan_name = str(out / PLAN)
    if plan_name is None:
        raise click.UsageError("Missing option '--plan'.")
    plan = plans.read(plan_name)
    twin = _twin(where, perfect, without, sample, seed, resume) if driver == "mock" else None
    if dry_run:
        return _rehearsed(plan, driver, twin, where)
    if out is None:
        raise click.UsageError("Missing option '-o' / '--out'.")
    return _measured(plan, out, driver, twin, where, bar, resume=resume, watch=watch,
                     faults=faults, truth=truth, force=force)  # fmt: skip


def _twin(
    where: str,
    perfect: bool,
    without: tuple[str, ...],
    sample: str | None,
    seed: int | None,
    resume: bool,
) -> Twin | None:
    """Which twin is asked for; None where a resumed run's own is."""
    from btfkit.devices.twin.log import Twin, everything

    if resume and not (where or perfect or without or sample or seed is not None):
        return None
    match = re.fullmatch(r"(\d{2,4})x(\d{2,4})", where or "640x480")
    if not match:
        raise click.UsageError(f"--device mock:{where}: expected mock:WxH")
    return Twin(
        sample=sample or "woven",
        width=int(match[1]),
        height=int(match[2]),
        seed=seed or 0,
        without=everything() if perfect else tuple(sorted(without)),
    )


def _rehearsed(plan: Plan, driver: str, twin: Twin | None, where: str) -> Outcome:
    from btfkit import devices
    from btfkit.devices import mock
    from btfkit.devices.capture.steps import estimate, steps_of
    from btfkit.devices.twin.log import Twin

    if driver != "mock":
        rig = devices.driver(driver).open_rig(where or None)
    else:
        rig = mock.open_rig((twin or Twin()).setup(blind=True))
    with rig:
        axes = list(rig.stage.axes.values())
        steps = steps_of(plan, rig.description, axes)
        found = estimate(steps, plan, rig.description, axes)
    kinds: dict[str, int] = {}
    for step in steps:
        kinds[step.kind] = kinds.get(step.kind, 0) + 1
    order = [step.pair for step in steps if step.pair is not None]
    line = (
        f"{plan.name}: {found['poses']:.0f} poses, at most {found['frames']:.0f} frames, about "
        f"{_span(found['seconds'])} (of which {_span(found['travel_s'])} of travel), at most "
        f"{_size(found['bytes'])}\n"
        + ", ".join(f"{count} {kind}" for kind, count in kinds.items())
        + f"\nfirst pairs: {', '.join(map(str, order[:12]))}"
    )
    return Outcome(line, {"plan": plan.name, "hash": plan.hash, **found, "kinds": kinds,
                          "order": order})  # fmt: skip


def _span(seconds: float) -> str:
    """A time as one plans with it."""
    return f"{seconds / 3600:.1f} h" if seconds >= 7200 else f"{seconds / 60:.0f} min"


def _size(count: float) -> str:
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.0f} MB"


def _measured(
    plan: Plan,
    out: Path,
    driver: str,
    twin: Twin | None,
    where: str,
    bar: Bar,
    *,
    resume: bool,
    watch: bool,
    faults: tuple[str, ...],
    truth: Path | None,
    force: bool,
) -> Outcome:
    from btfkit import devices
    from btfkit.cli.live import Live
    from btfkit.devices import mock
    from btfkit.devices.capture.live import Page
    from btfkit.devices.capture.progress import Progress
    from btfkit.devices.capture.run import measure
    from btfkit.devices.capture.store import refuse_begun
    from btfkit.devices.faults import Faults
    from btfkit.devices.twin.log import TwinLog
    from btfkit.files import refuse_existing

    if truth is not None:
        refuse_existing(truth, force=force)
    striking = Faults(faults, seed=(twin.seed if twin else 0))
    if not resume:
        refuse_begun(out)
    if driver != "mock":
        rig = devices.driver(driver).open_rig(where or None)
    else:
        log = TwinLog(out, twin)
        rig = mock.open_rig(log.begin(), faults=striking, log=log)
    shown: list[Callable[[Progress], None]] | None = None

    def observe(progress: Progress) -> None:
        nonlocal shown
        if shown is None:
            # The sensor's levels are known once the rig is open.
            levels = {name: rig.camera.sensor[name] for name in ("black", "white")}
            shown = [Page(out, **levels)] if watch else []
            shown += [] if bar.silent else [screen.enter_context(Live(**levels))]
        for show in shown:
            show(progress)

    with ExitStack() as screen:
        report = measure(rig, plan, out, resume=resume, faults=striking, observer=observe,
                         synthetic=driver == "mock")  # fmt: skip
    data: dict[str, Any] = {"out": out, **report.__dict__, "faults": dict(striking.struck)}
    line = (
        f"{out}: {report.frames} frames of {report.groups} poses, {report.taken} taken now, "
        f"{report.retries} repeats" + (", synthetic" if driver == "mock" else "")
    )
    if truth is not None:
        from btfkit.devices.twin.truth import truth as traced
        from btfkit.io.store import writer

        writer.write(traced(out), truth, force=force, progress=bar)
        data["truth"] = truth
        line += f"; truth in {truth}"
    return Outcome(line, data, then=f"btfkit calibrate {shlex.quote(str(out))}")
