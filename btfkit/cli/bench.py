"""`btfkit bench`: time against error of models on materials, on this machine."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from btfkit.cli.bar import Bar
from btfkit.cli.options import DurationType, SettingType, out_option, seed_option
from btfkit.cli.outcome import Outcome, verb


@verb(
    "bench",
    example="""btfkit bench cobbles wool.btf.zarr --model neumip --model pca --quick
btfkit bench merge bundle rectify -o stages
btfkit bench wool.btf.zarr --questions && btfkit bench wool.btf.zarr --answers ours=answers.npz""",
)
@click.argument("names", nargs=-1)
@out_option("Folder of results, resumed where it exists; by default bench")
@click.option("--model", "models", multiple=True, help="Only these models; repeatable.")
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
    questions: bool,
    seed: int,
) -> Outcome:
    """Fit models to materials within budgets, and write what each cost and how far off it is.

    NAMES: materials of `btfkit synth --list`, or stores, query files and whatever else `ingest`
    reads; merge, bundle and rectify measure those stages of a calibration by themselves. Writes
    bench.json, tables (bench.md, bench.csv, bench.tex) and two plots of all that the folder holds:
    what former calls finished is kept and told with the rest, so that models, budgets and
    materials may be run one after the other, or by several processes at a time.

    Your own method: --questions writes FOLDER/questions/NAME.npz (uv, light, view); add rgb to each
    and name them with --answers. Without --model nothing is fitted then.
    """
    from btfkit.bench.run import QUICK, Profile, ask, run
    from btfkit.bench.stages import STAGES
    from btfkit.bench.tables import brief, stages
    from btfkit.errors import meaning
    from btfkit.relief.procedural import CATALOGUE

    profile = QUICK if quick else Profile()
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
        directions=directions or profile.directions,
        seed=seed,
    )
    folder = out or Path("bench")
    if questions:
        asked = ask(profile, folder)
        return Outcome("\n".join(map(str, asked)), {"questions": asked})
    found = run(profile, folder, progress=bar)
    files = [folder / name for name in FILES]
    told = [brief(found["cells"])] if found["cells"] else []
    told += stages({name: found["stages"][name] for name in profile.stages})
    line = f"{folder}: {len(found['cells'])} cells\n\n" + "\n".join(told)
    then = f"open {folder / 'bench.md'}; a method of your own: --questions, then --answers"
    return Outcome(line, {**found, "files": files}, then=then)


FILES = (
    "bench.json",
    "bench.md",
    "bench.csv",
    "bench.tex",
    "rate-distortion.png",
    "time-to-error.png",
)
