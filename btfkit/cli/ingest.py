"""`btfkit ingest`: any readable source -> one native store."""

from __future__ import annotations

import functools
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from btfkit.cli.bar import Bar
from btfkit.cli.many import cluster_option, outputs, the_one, told
from btfkit.cli.options import (
    LocationType,
    SliceType,
    WindowType,
    completed,
    force_option,
    location_option,
    seed_option,
    source_formats,
)
from btfkit.cli.outcome import Outcome, verb
from btfkit.cli.preview import of_btf, preview_option
from btfkit.remote import Location

# A relief that is not given but found from what a first reading makes.
_FOUND = Path("auto")


@verb(
    "ingest",
    example="""btfkit ingest UBO_WALLPAPER256.zip --lights 0:81:2 -o wallpaper.btf.zarr
btfkit ingest wool/ felt.zip cord.btf --cluster local:2 -o stores""",
)
@click.argument("sources", metavar="SOURCE", nargs=-1, required=True, type=LocationType())
@location_option("The store to write; by default SOURCE.btf.zarr here; of several, their folder")
@click.option(
    "--format", "format_name", help="Read as this format instead of detecting it.",
    shell_complete=completed(source_formats),
)  # fmt: skip
@click.option("--roi", type=WindowType(), help="Read only this window of rows and columns.")
@click.option("--views", type=SliceType(), help="Read only these of the distinct views.")
@click.option("--lights", type=SliceType(), help="Read only these of the distinct lights.")
@click.option("--transfer", help="How pixel values encode light: srgb, linear or 2.2.")
@click.option("--cosine", type=click.Choice(["in", "out"]), help="Cosine of the light in the data.")
@click.option("--orientation", help="How rows and columns lie, where the format leaves it open.")
@click.option("--texel-mm", type=float, help="Edge of a texel, millimetres.")
@click.option(
    "--light-shift", type=click.Path(path_type=Path), help="Table of shifted lights (UTIA)."
)
@click.option(
    "--calibration", type=click.Path(path_type=Path), help="Calibration of a captured sequence."
)
@click.option(
    "--register/--no-register", default=None,
    help="Move each view of a sequence onto the squarest; by default where calibration is poor.",
)  # fmt: skip
@click.option(
    "--relief", type=click.Path(path_type=Path), metavar="FILE.exr|auto",
    help="Heights of a sequence's sample, to register its views; auto finds them first.",
)  # fmt: skip
@click.option("--partial", is_flag=True, default=None, help="Take a run with gaps, masking them.")
@click.option(
    "--direction-residual", type=float,
    help="Degrees that directions may be off from one position an image (HDF5; 0.2).",
)  # fmt: skip
@click.option("--dtype", type=click.Choice(["float16", "float32"]), help="Of the stored textures.")
@click.option("--jobs", type=click.IntRange(min=1), help="Workers; by default one a processor.")
@cluster_option
@preview_option
@seed_option
@force_option
def ingest_verb(
    bar: Bar,
    *,
    sources: tuple[Location, ...],
    out: Location | None,
    cluster: str | None,
    format_name: str | None,
    roi: tuple[slice, slice] | None,
    views: slice | None,
    lights: slice | None,
    dtype: str | None,
    jobs: int | None,
    preview: bool,
    seed: int,
    force: bool,
    **options: object,
) -> Outcome:
    """Read any measured source into one native store.

    SOURCE: a folder or zip of images named by their angles (UBO2003, ATRIUM, UTIA, spectral),
    a Bonn .btf, a pose manifest, an RTI .lp, and what else `btfkit info` lists. With --cluster,
    several: a task a shard, stores whole or absent, failed sources named at the end.

    -o may be a URL that fsspec reaches (s3://bucket/wool.btf.zarr; extra `remote`).
    """
    from btfkit.ingest import Part, ingest, ingest_on_found_relief, store_name

    rows, cols = roi or (slice(None), slice(None))
    everything = slice(None)
    given: dict[str, Any] = {
        "format": format_name,
        "options": options,
        "part": Part(rows, cols, lights or everything, views or everything),
    }
    if options["relief"] == _FOUND and options["register"] is False:
        raise click.UsageError("--relief auto registers views: leave out --no-register")
    if cluster and options["relief"] == _FOUND:
        raise click.UsageError("--relief auto reads a sequence twice: leave out --cluster")
    if cluster:
        from btfkit.cluster import connected
        from btfkit.shards import Asked, ingest_all

        targets = outputs(sources, out, store_name)
        for name, value in options.items():
            options[name] = value.absolute() if isinstance(value, Path) else value
        closing = functools.partial(_written, preview=preview)
        bar.phase("connecting")
        with connected(cluster) as workers:
            bar.phase("reading and writing")
            return told(ingest_all(workers, targets, Asked(given, dtype, force, closing), bar))
    writing: dict[str, Any] = {
        "dtype": dtype,
        "jobs": jobs,
        "force": force,
        "progress": bar,
        "phase": bar.phase,
    }
    source = the_one(sources, "sources")
    if options["relief"] != _FOUND:
        return _written(ingest(source, out, **writing, **given), preview=preview)
    given["options"] = {name: value for name, value in options.items() if name != "relief"}
    path, relief = ingest_on_found_relief(source, out, seed=seed, **writing, **given)
    made = _written(path, preview=preview)
    return replace(made, data={**made.data, "relief": relief})


def _written(path: Location, *, preview: bool) -> Outcome:
    """What is said of a finished store."""
    import btfkit

    btf = btfkit.open(path)
    n, h, w, c = btf.shape
    return Outcome(
        f"{path}: {n} textures of {w} x {h}, {c} channels",
        {
            "out": path,
            "shape": btf.shape,
            "channels": btf.channels,
            "format": btf.provenance["format"],
            "assumed": btf.provenance.get("assumed", {}),
            **{k: btf.provenance[k] for k in ("registration", "partial") if k in btf.provenance},
            **(of_btf(btf, path) if preview and isinstance(path, Path) else {}),
        },
        then=f"btfkit fit {shlex.quote(str(path))}",
    )
