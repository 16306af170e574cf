"""`btfkit synth`: a procedural material with known relief, in any form."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import click

from btfkit.cli.bar import Bar
from btfkit.cli.options import FiniteType, NumbersType, force_option, out_option, seed_option
from btfkit.cli.outcome import Outcome, verb

if TYPE_CHECKING:
    from btfkit.queries import QuerySet

KINDS = ("relief", "zarr", "ubo2003", "ubo2014", "utia", "manifest", "queries")


@final
class FloatsType(click.ParamType[tuple[float, ...]]):
    """Any number of positive numbers between commas."""

    name = "A,B,..."

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        try:
            numbers = tuple(float(part) for part in str(value).split(","))
        except ValueError:
            self.fail(f"{value!r} is no list of numbers", param, ctx)
        if not all(0 < number < 1e6 for number in numbers):
            self.fail(f"{value!r} holds numbers that are not between 0 and 1e6", param, ctx)
        return numbers


@verb("synth", example="btfkit synth woven -o woven.btf.zarr --as zarr --size 128")
@click.argument("name", required=False)
@out_option("To write")
@click.option("--list", "listing", is_flag=True, help="List the materials.")
@click.option("--as", "kind", type=click.Choice(KINDS), default="zarr", show_default=True)
@click.option("--size", type=click.IntRange(8, 4096), default=128, show_default=True)
@click.option("--views", default="19", show_default=True, help="bonn81, bonn151 or a number.")
@click.option("--lights", default="19", show_default=True, help="bonn81, bonn151 or a number.")
@click.option("--relief", "relief_texels", type=float, help="Height of the structure, texels.")
@click.option("--bounces", type=click.IntRange(0, 16), default=0, help="Interreflections.")
@click.option(
    "--samples",
    type=click.IntRange(1, 4096),
    help="Rays a texel or query.  [default: 4; queries: 16]",
)
@click.option("--clamp", is_flag=True, help="A sample that does not tile.")
@click.option("--count", type=click.IntRange(min=1), default=1_000_000, help="Queries to answer.")
@click.option(
    "--footprints",
    type=FloatsType(),
    default="0.5",
    show_default=True,
    help="Queries: footprints to draw from, texels.",
)
@click.option(
    "--curvature",
    type=NumbersType("LOW,HIGH", float),
    help="Queries: on cylinders of such |curvature|, 1/tile width, and on the plane.",
)
@click.option(
    "--lamp-degrees",
    type=FiniteType(0, 90),
    default=0.0,
    help="Angular diameter of the lamp.  [default: 0, a distant point]",
)
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
    samples: int | None,
    clamp: bool,
    count: int,
    footprints: tuple[float, ...],
    curvature: tuple[float, float] | None,
    lamp_degrees: float,
    seed: int,
    force: bool,
) -> Outcome:
    """Make the procedural material NAME: known relief and reflectance, so errors can be known.

    What it writes is synthetic, and says so.
    """
    from btfkit.relief import procedural, yarns
    from btfkit.relief.synth import relief_btf

    if listing or name is None:
        about = procedural.described() | yarns.ABOUT
        lines = [f"{each:<11}{line}" for each, line in about.items()]
        return Outcome("\n".join(lines), {"materials": list(about), "about": about})
    if out is None:
        raise click.UsageError("Missing option '-o' / '--out'.")
    if kind != "queries" and curvature is not None:
        raise click.UsageError("--curvature is for --as queries")
    if lamp_degrees and kind == "relief":
        raise click.UsageError("--lamp-degrees is for what is lit: not --as relief")
    if name in yarns.CATALOGUE:
        if kind != "queries" or lamp_degrees or bounces or clamp or relief_texels is not None:
            raise click.UsageError(
                f"{name} is no height field: --as queries alone, without --relief, --bounces, "
                "--clamp and --lamp-degrees"
            )
        bar.phase("tracing and writing")
        woven = yarns.weave_queries(
            name, count, size=size, seed=seed, footprints=footprints, curvatures=curvature,
            samples=samples or 4, lowest_z=_lowest(curvature),
        )  # fmt: skip
        return _written_queries(woven, out, name, force=force)
    bar.phase("making the relief")
    relief = procedural.make(
        name, size, relief_texels=relief_texels, seed=seed, wrap="clamp" if clamp else "wrap"
    )
    bar.phase("tracing and writing")
    if kind == "relief":
        from btfkit.relief.file import write

        write(relief, out, force=force)
    elif kind == "queries":
        from btfkit.relief.trace import SAMPLES, random_queries

        rays = samples or SAMPLES
        queries = random_queries(
            relief, count, seed=seed, bounces=bounces, samples=1 if lamp_degrees else rays,
            footprints=footprints, curvatures=curvature, lowest_z=_lowest(curvature),
        )  # fmt: skip
        if lamp_degrees:
            from btfkit.relief.lamp import lamp_queries

            queries = lamp_queries(
                queries, relief, lamp_degrees, samples=rays, bounces=bounces, seed=seed
            )
        return _written_queries(queries, out, name, force=force)
    else:
        btf = relief_btf(
            relief, lights=lights, views=views, samples=samples or 4, bounces=bounces, seed=seed
        )
        if lamp_degrees:
            from btfkit.relief.lamp import lamp_btf

            btf = lamp_btf(
                btf, relief, lamp_degrees, samples=samples or 4, bounces=bounces, seed=seed
            )
        if kind == "zarr":
            from btfkit.io.store import writer

            writer.write(btf, out, force=force, progress=bar)
        else:
            from btfkit.cli.convert import written

            written(btf, out, {"ubo2014": "btf"}.get(kind, kind), {}, force=force, progress=bar)
    return _made(out, name, kind)


def _lowest(curvature: tuple[float, float] | None) -> float:
    """Of views: on cylinders the silhouettes are the point, and they lie near the horizon."""
    return 0.1 if curvature is None else 0.02


def _written_queries(queries: QuerySet, out: Path, name: str, *, force: bool) -> Outcome:
    from btfkit.io import queryfile

    queryfile.write(queries, out, force=force)
    return _made(out, name, "queries")


def _made(out: Path, name: str, kind: str) -> Outcome:
    line = f"{out}: {name}, synthetic, as {kind}"
    return Outcome(line, {"out": out, "name": name, "as": kind}, then=_next(out, kind))


def _next(out: Path, kind: str) -> str:
    """What one does with a sample of its kind."""
    path = shlex.quote(str(out))
    if kind == "relief":
        return f"btfkit render {path} --shape sphere"
    return f"btfkit fit {path}" if kind in ("zarr", "queries") else f"btfkit ingest {path}"
