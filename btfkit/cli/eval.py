"""`btfkit eval`: a model and a truth -> errors."""

from __future__ import annotations

from pathlib import Path

import click

from btfkit.cli.bar import Bar
from btfkit.cli.outcome import Outcome, verb


@verb("eval", example="btfkit eval wool.neubtf.safetensors wool.btf.zarr --json")
@click.argument("model", type=click.Path(path_type=Path))
@click.argument("source", type=click.Path(path_type=Path))
def eval_verb(bar: Bar, *, model: Path, source: Path) -> Outcome:
    """Errors of MODEL on SOURCE, a BTF or a query file with answers."""
    from btfkit import sources
    from btfkit.btf import BTF
    from btfkit.materials import evaluation
    from btfkit.queries import QuerySet

    material, truth = sources.material(model), sources.measured(source)
    if isinstance(truth, BTF):
        errors = evaluation.errors_on_btf(material, truth, progress=bar)
    elif isinstance(truth, QuerySet):
        errors = evaluation.errors_on_queries(material, truth)
    else:
        raise ValueError(f"{source} is a relief; trace it first: btfkit synth or ingest")
    line = "  ".join(f"{k} {v:.6g}" for k, v in errors.items() if isinstance(v, (int, float)))
    return Outcome(line, {"model": model, "source": source, **errors})
