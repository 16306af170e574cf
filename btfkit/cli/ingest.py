"""`btfkit ingest`: any readable source -> one native store."""

from __future__ import annotations

import shlex
from pathlib import Path

import click

from btfkit.cli.bar import Bar
from btfkit.cli.options import SliceType, WindowType, force_option, out_option, seed_option
from btfkit.cli.outcome import Outcome, verb
from btfkit.cli.preview import of_btf, preview_option


@verb(
    "ingest",
    example="btfkit ingest UBO_WALLPAPER256.zip --lights 0:81:2 -o wallpaper.btf.zarr",
)
@click.argument("source", type=click.Path(path_type=Path))
@out_option("The store to write; by default SOURCE.btf.zarr here")
@click.option("--format", "format_name", help="Read as this format instead of detecting it.")
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
    "--direction-residual", type=float,
    help="Degrees that directions may be off from one position an image (HDF5; 0.2).",
)  # fmt: skip
@click.option("--dtype", type=click.Choice(["float16", "float32"]), help="Of the stored textures.")
@click.option("--jobs", type=click.IntRange(min=1), help="Workers; by default one a processor.")
@preview_option
@seed_option
@force_option
def ingest_verb(
    bar: Bar,
    *,
    source: Path,
    out: Path | None,
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
    a Bonn .btf, a pose manifest, an RTI .lp, and what else `btfkit info` lists.
    """
    import btfkit
    from btfkit.ingest import Part, ingest

    rows, cols = roi or (slice(None), slice(None))
    everything = slice(None)
    path = ingest(
        source,
        out,
        format=format_name,
        options=options,
        part=Part(rows, cols, lights or everything, views or everything),
        dtype=dtype,
        jobs=jobs,
        force=force,
        progress=bar,
        phase=bar.phase,
    )
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
            **(of_btf(btf, path) if preview else {}),
        },
        then=f"btfkit fit {shlex.quote(str(path))}",
    )
