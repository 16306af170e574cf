"""`btfkit bench`: time against error of models on materials, on this machine."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from btfkit.cli.bar import Bar
from btfkit.cli.many import cluster_option, over, several
from btfkit.cli.options import (
    DurationType,
    FiniteType,
    SettingType,
    completed,
    fitted_models,
    out_option,
    seed_option,
)
from btfkit.cli.outcome import FAILED, Outcome, verb

if TYPE_CHECKING:
    from btfkit.bench.run import Profile


@verb(
    "bench",
    example="""btfkit bench cobbles wool.btf.zarr --model neumip --model pca --quick
btfkit bench merge bundle rectify heightfield -o stages
btfkit bench wool.btf.zarr --questions && btfkit bench wool.btf.zarr --answers ours=answers.npz""",
)
@click.argument("names", nargs=-1)
@out_option("Folder of results, resumed where it exists; by default bench")
@click.option(
    "--model", "models", multiple=True, help="Only these models; repeatable.",
    shell_complete=completed(fitted_models),
)  # fmt: skip
@click.option(
    "--budget", "budgets", type=DurationType(), multiple=True,
    help="CPU time of training, over all threads; repeatable.",
)  # fmt: skip
@click.option("--size", type=click.IntRange(8, 4096), help="Texels a side of traced materials.")
@click.option("--directions", type=click.IntRange(2, 151), help="Lights, and views, of these.")
@click.option("--quick", is_flag=True, help="Small materials and budgets: under two minutes.")
@click.option(
    "--answers", "answers", type=SettingType(), multiple=True, metavar="NAME=FILE.npz",
    help="Score a method from elsewhere: answered questions, rgb added; repeatable.",
)  # fmt: skip
@click.option(
    "--real", type=click.Path(path_type=Path), metavar="DIR",
    help="Every store or source of a folder; pairs held out by their angle to the nearest other.",
)  # fmt: skip
@click.option(
    "--holdout", type=FiniteType(0, 1, min_open=True, max_open=True),
    help="Share of pairs, or rows, held out; by default 0.05, with --real 0.1.",
)  # fmt: skip
@cluster_option
@click.option("--questions", is_flag=True, help="Write what such a method is asked; fit nothing.")
@seed_option
def bench_verb(
    bar: Bar,
    *,
    names: tuple[str, ...],
    out: Path | None,
    models: tuple[str, ...],
    budgets: tuple[float, ...],
    size: int | None,
    directions: int | None,
    quick: bool,
    answers: tuple[tuple[str, str], ...],
    real: Path | None,
    holdout: float | None,
    cluster: str | None,
    questions: bool,
    seed: int,
) -> Outcome:
    """Fit models to materials within budgets, and write what each cost and how far off it is.

    NAMES: materials of `btfkit synth --list`, or stores, query files and whatever else `ingest`
    reads; merge, bundle and rectify measure those stages of a calibration by themselves,
    heightfield each source of heights and all in one. Writes
    bench.json, tables (bench.md, bench.csv, bench.tex) and two plots of all that the folder holds:
    what former calls finished is kept and told with the rest, so that models, budgets and
    materials may be run one after the other, or by several processes at a time; --cluster gives
    each material to a worker, names those that fail, and ends in the same tables.

    --real DIR: every measured material of a folder. Held-out pairs are alone or in holes, errors
    are told by the angle to the nearest pair trained on and with gains; real.md, with two figures.

    Your own method: --questions writes FOLDER/questions/NAME.npz (uv, light, view); add rgb to each
    and name them with --answers. Without --model nothing is fitted then.
    """
    from btfkit.bench.real import PAGE, PICTURES, sources_in
    from btfkit.bench.run import QUICK, REAL, Profile, ask, run
    from btfkit.bench.stages import STAGES
    from btfkit.bench.tables import brief, stages
    from btfkit.errors import meaning
    from btfkit.relief.procedural import CATALOGUE

    profile = QUICK if quick else Profile()
    declined: dict[str, str] = {}
    if real is not None:
        if names:
            raise click.UsageError("NAMES and --real DIR are given; expected one of them")
        found_there, declined = sources_in(real)
        profile = replace(profile, stores=tuple(found_there), materials=(), **REAL)
        if quick:
            profile = replace(profile, budgets_cpu_s=QUICK.budgets_cpu_s)
    profile = replace(profile, stages=tuple(name for name in names if name in STAGES))
    if profile.stages and set(names) <= set(STAGES):
        profile = replace(profile, materials=(), models=(), kernel_seconds=0.0)
    elif names:
        names = tuple(name for name in names if name not in STAGES)
        stores = tuple(Path(name) for name in names if name not in CATALOGUE)
        for path in stores:
            if not path.exists():
                meant = meaning(str(path), CATALOGUE)
                raise ValueError(
                    f"{path} is neither a file nor a material{meant}; "
                    f"there are {', '.join(CATALOGUE)}"
                )
        profile = replace(
            profile, stores=stores, materials=tuple(name for name in names if name in CATALOGUE)
        )
    given = tuple((name, Path(path)) for name, path in answers)
    if given and not models:
        profile = replace(profile, models=(), kernel_seconds=0.0)
    profile = replace(
        profile,
        answers=given,
        models=models or profile.models,
        budgets_cpu_s=tuple(sorted(budgets)) or profile.budgets_cpu_s,
        size=size or profile.size,
        holdout=holdout or profile.holdout,
        directions=directions or profile.directions,
        seed=seed,
    )
    folder = out or Path("bench")
    if questions:
        asked = ask(profile, folder)
        return Outcome("\n".join(map(str, asked)), {"questions": asked})
    failed: list[dict[str, Any]] = []
    total = len(profile.sources)
    if cluster:
        profile, failed = _on_cluster(cluster, profile, folder.absolute(), bar)
    found = run(profile, folder, progress=bar)
    pages = (PAGE, *PICTURES) if real is not None else ()
    files = [folder / name for name in (*FILES, *pages)]
    told = [brief(found["cells"])] if found["cells"] else []
    told += stages({name: found["stages"][name] for name in profile.stages})
    line = f"{folder}: {len(found['cells'])} cells\n\n" + "\n".join(told)
    line += "".join(f"\nnot read: {reason}" for reason in declined.values())
    first = folder / (PAGE if real is not None else "bench.md")
    data = {**found, "files": files} | ({"declined": declined} if real is not None else {})
    if failed:
        line += "".join(f"\nfailed {each['source']}: {each['message']}" for each in failed)
        return Outcome(
            line, data | {"failed": failed, "error": several(failed, total)}, code=FAILED
        )
    then = f"open {first}; a method of your own: --questions, then --answers"
    return Outcome(line, data, then=then)


def _on_cluster(
    where: str, profile: Profile, folder: Path, bar: Bar
) -> tuple[Profile, list[dict[str, Any]]]:
    """Run every material on a worker; returns the profile of those that did not fail."""
    folder.mkdir(parents=True, exist_ok=True)
    profile = replace(profile, stores=tuple(path.absolute() for path in profile.stores))
    # Stages of a calibration are measured here, once.
    alone = replace(profile, stages=())
    tasks = {str(source): (_alone(alone, source), folder) for source in profile.sources}
    outcome = over(where, tasks, _task, bar)
    failed: list[dict[str, Any]] = list(outcome.data["failed"])
    names = {each["source"] for each in failed}
    return replace(
        profile,
        materials=tuple(name for name in profile.materials if name not in names),
        stores=tuple(path for path in profile.stores if str(path) not in names),
    ), failed


def _alone(profile: Profile, source: str | Path) -> Profile:
    """The profile of one material, without what is done once for all."""
    named = isinstance(source, str)
    return replace(
        profile,
        materials=(str(source),) if named else (),
        stores=() if named else (Path(source),),
        answers=(),
        stages=(),
        kernel_seconds=0.0,
    )


def _task(source: str, profile: Profile, folder: Path) -> Outcome:
    from btfkit.bench.run import run

    return Outcome(f"{source}: {len(run(profile, folder)['cells'])} cells")


FILES = (
    "bench.json",
    "bench.md",
    "bench.csv",
    "bench.tex",
    "rate-distortion.png",
    "time-to-error.png",
)
