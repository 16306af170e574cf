"""`btfkit calibrate`: a sequence -> its calibration; photographs of mirror spheres -> lights."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import click

from btfkit.cli.bar import Bar
from btfkit.cli.many import cluster_option, over, the_one
from btfkit.cli.options import force_option, out_option
from btfkit.cli.outcome import Outcome, verb
from btfkit.cli.preview import preview_option


@verb(
    "calibrate",
    example="""btfkit calibrate run/
btfkit calibrate photographs/ --sphere-mm 25 -o coin.lp
btfkit calibrate monday/ tuesday/ --cluster local:2""",
)
@click.argument(
    "sources", metavar="SEQUENCE", nargs=-1, required=True, type=click.Path(path_type=Path)
)
@out_option("By default SEQUENCE/calibration.json, or NAME.lp in a folder of photographs")
@click.option(
    "--spheres", type=click.Path(path_type=Path), help="Photographs of the spheres, taken first."
)
@click.option(
    "--white", type=click.Path(path_type=Path), help="White frames, one a light, or a single one."
)
@click.option("--sphere-mm", type=float, help="Diameter of the largest sphere, millimetres.")
@click.option("--focal-px", type=float, help="Focal length of a near camera, pixels.")
@click.option(
    "--transfer", default="srgb", show_default=True, help="Of photographs: srgb, linear or 2.2."
)
@cluster_option
@preview_option
@force_option
def calibrate_verb(
    bar: Bar,
    *,
    sources: tuple[Path, ...],
    out: Path | None,
    cluster: str | None,
    preview: bool,
    force: bool,
    **options: Any,
) -> Outcome:
    """Calibrate a captured sequence, or find the lights of photographs (RTI).

    SEQUENCE: a folder with sequence.csv; stages whose frames and settings did not change are not
    run again. A folder of photographs with one or several mirror spheres in view gives their
    light directions (.lp), and positions where several spheres tell them. With --cluster, several,
    a task each; `btfkit ingest SEQUENCE… --cluster` then rectifies, a task a shard.
    """
    if not cluster:
        return _calibrated(the_one(sources, "sequences"), out, force, options, bar, preview)
    if out and len(sources) > 1:
        raise click.UsageError("each of several sequences keeps its calibration: leave out -o")
    given = {n: v.absolute() if isinstance(v, Path) else v for n, v in options.items()}
    target = out.absolute() if out else None
    tasks = {str(source.absolute()): (target, force, given, preview) for source in sources}
    return over(cluster, tasks, _task, bar)


def _task(
    source: str, out: Path | None, force: bool, options: Mapping[str, Any], preview: bool
) -> Outcome:
    return _calibrated(Path(source), out, force, options, _unheard, preview)


def _unheard(done: float, total: float) -> None:
    """What a worker does is told by the list's progress."""


def _calibrated(
    source: Path,
    out: Path | None,
    force: bool,
    options: Mapping[str, Any],
    bar: Callable[[float, float], None],
    preview: bool,
) -> Outcome:
    """Calibrate one folder."""
    from btfkit.calibration.calibration import NAME
    from btfkit.calibration.folders import Photographs, calibrate_photographs, calibrate_sequence
    from btfkit.sequence import TABLE, refuse_unended

    if not source.is_dir():
        raise FileNotFoundError(f"{source} is not a folder")
    if (source / TABLE).exists():
        data = calibrate_sequence(source, out, force=force, progress=bar, preview=preview)
        then = f"btfkit ingest {shlex.quote(str(source))}"
        # A document elsewhere is not read along with the sequence.
        if data["out"] != source / NAME:
            then += f" --calibration {shlex.quote(str(data['out']))}"
        return Outcome(_of_sequence(data), data, then=then)
    refuse_unended(source)
    how = Photographs(**options)
    data = calibrate_photographs(source, out, how, force=force, progress=bar, preview=preview)
    return Outcome(_of_lights(data), data, then=f"btfkit ingest {shlex.quote(str(data['out']))}")


def _of_sequence(data: dict[str, Any]) -> str:
    found = data["figures"]
    parts = ["no photon noise"]
    if found["photon_noise"]:
        parts = [
            f"gain {found['gain_e_per_count']:.3f} e/count, read noise {found['read_e']:.2f} e"
        ]
    if "corner_px" in found:
        parts.append(f"corners {found['corner_px']:.3f} px")
    if "lamp_drift" in found:
        parts.append(f"lamp drift {100 * found['lamp_drift']:.2f} %")
    if "scale_sd" in found:
        parts.append(f"white {100 * found['scale_sd']:.2f} %")
    if "delta_e" in found:
        parts.append(f"dE2000 {found['delta_e']:.2f}")
    lines = [f"{data['out']}: {', '.join(parts)}"]
    lines.append(f"  ran {', '.join(data['ran']) or 'nothing: all inputs are unchanged'}")
    if data["gone"]:
        gone = f"{len(data['gone'])} listed frames are not there (first: {data['gone'][0]})"
        lines.append(f"  {gone}; what was made of them before is kept")
    lines += [f"  missing {name}: {why}" for name, why in data["missing"].items()]
    return "\n".join(lines)


def _of_lights(data: dict[str, Any]) -> str:
    line = (
        f"{data['out']}: {data['lights']} lights from {data['spheres']} spheres, "
        f"error {data['error_deg']:.2f} degrees"
    )
    if data["positions"]:
        line += f", {data['positions']} positions in {data['unit']}"
    if data["corrected"] and data["falloff_rms"] is None:
        line += f"; developed in {data['corrected']}"
    if data["falloff_rms"] is not None:
        line += (
            f"; fall-off divided out to {100 * data['falloff_rms']:.2f} % in {data['corrected']}"
        )
    return line
