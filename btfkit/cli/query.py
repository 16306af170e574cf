"""`btfkit query`: a model and questions -> answers."""

from __future__ import annotations

import shlex
import time
from dataclasses import replace
from pathlib import Path

import click

from btfkit.cli.bar import Bar
from btfkit.cli.options import force_option, out_option, stem
from btfkit.cli.outcome import Outcome, verb


@verb("query", example="btfkit query wool.neubtf.safetensors queries.npz -o answers.npz")
@click.argument("model", type=click.Path(path_type=Path))
@click.argument("queries", type=click.Path(path_type=Path))
@out_option("To write; by default QUERIES.answers.npz here")
@force_option
def query_verb(bar: Bar, *, model: Path, queries: Path, out: Path | None, force: bool) -> Outcome:
    """Evaluate MODEL on a query file; OUT holds the queries with `rgb` and `opacity` added."""
    from btfkit import sources
    from btfkit.files import refuse_existing
    from btfkit.io import queryfile

    final = refuse_existing(out or Path(f"{stem(queries)}.answers.npz"), force=force)
    material, asked = sources.material(model), queryfile.read(queries)
    bar(0, len(asked))
    # Kernels are loaded for the first query there is: the time stated is that of the answers.
    material.evaluate([0.5, 0.5], [0, 0, 1], [0, 0, 1])
    start = time.perf_counter()
    rgb, opacity = material.evaluate(
        asked.uv,
        asked.light,
        asked.view,
        0.5 if asked.footprint is None else asked.footprint,
        0.0 if asked.curvature is None else asked.curvature,
    )
    ns = 1e9 * (time.perf_counter() - start) / max(len(asked), 1)
    answered = replace(asked, rgb=rgb, opacity=opacity, channels=material.header.channels)
    queryfile.write(answered, final, force=force)
    return Outcome(
        f"{final}: {len(asked)} queries, {ns:.0f} ns each",
        {"out": final, "queries": len(asked), "ns_per_query": ns},
        then=f"btfkit eval {shlex.quote(str(model))} TRUTH",
    )
