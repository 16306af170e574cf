"""`btfkit synth`: a procedural material with known relief, in any form."""

from __future__ import annotations

from pathlib import Path

import click

from btfkit.cli.bar import Bar
from btfkit.cli.options import force_option, out_option, seed_option
from btfkit.cli.outcome import Outcome, verb

KINDS = ("relief", "zarr", "ubo2003", "ubo2014", "utia", "manifest", "queries")


@verb("synth", example="btfkit synth woven -o woven.btf.zarr --as zarr --size 128")
@click.argument("name", required=False)
@out_option("To write")
@click.option("--list", "listing", is_flag=True, help="List the materials.")
@click.option("--as", "kind", type=click.Choice(KINDS), default="zarr", show_default=True)
@click.option("--size", type=click.IntRange(8, 4096), default=128, show_default=True)
@click.option("--views", default="bonn81", show_default=True, help="bonn81, bonn151 or a number.")
@click.option("--lights", default="bonn81", show_default=True, help="bonn81, bonn151 or a number.")
@click.option("--relief", "relief_texels", type=float, help="Height of the structure, texels.")
@click.option("--bounces", type=click.IntRange(0, 16), default=0, help="Interreflections.")
@click.option("--samples", type=click.IntRange(1, 4096), default=4, help="Rays a texel.")
@click.option("--count", type=click.IntRange(min=1), default=1_000_000, help="Queries to answer.")
@seed_option
@force_option
def synth_verb(
    bar: Bar,
    *,
    name: str | None,
    out: Path | None,
    listing: bool,
    kind: str,
    size: int,
    views: str,
    lights: str,
    relief_texels: float | None,
    bounces: int,
    samples: int,
    count: int,
    seed: int,
    force: bool,
) -> Outcome:
    """Make the procedural material NAME: known relief and reflectance, so errors can be known.

    What it writes is synthetic, and says so.
    """
    from btfkit.relief import procedural
    from btfkit.relief.synth import synth_btf

    if listing or name is None:
        return Outcome("\n".join(procedural.CATALOGUE), {"materials": list(procedural.CATALOGUE)})
    if out is None:
        raise click.UsageError("Missing option '-o' / '--out'.")
    if kind in ("relief", "queries"):
        relief = procedural.make(name, size, relief_texels=relief_texels, seed=seed)
        if kind == "relief":
            from btfkit.relief.file import write

            write(relief, out, force=force)
        else:
            from btfkit.io import queryfile
            from btfkit.relief.trace import random_queries

            queries = random_queries(relief, count, seed=seed, bounces=bounces)
            queryfile.write(queries, out, force=force)
    else:
        btf = synth_btf(
            name, size=size, lights=lights, views=views, relief_texels=relief_texels,
            samples=samples, bounces=bounces, seed=seed,
        )  # fmt: skip
        if kind == "zarr":
            from btfkit.io import store_write

            store_write.write(btf, out, force=force, progress=bar)
        else:
            from btfkit.cli.convert import written

            written(btf, out, {"ubo2014": "btf"}.get(kind, kind), {}, force=force, progress=bar)
    return Outcome(f"{out}: {name}, synthetic, as {kind}", {"out": out, "name": name, "as": kind})
