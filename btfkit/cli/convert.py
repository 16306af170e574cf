"""`btfkit convert`: a store -> an interchange format."""

from __future__ import annotations

import importlib
from pathlib import Path

import click

from btfkit.cli.bar import Bar
from btfkit.cli.options import SettingType, force_option
from btfkit.cli.outcome import Outcome, verb

WRITERS: dict[str, str] = {
    "ubo2003": "btfkit.io.ubo2003",
    "utia": "btfkit.io.utia",
    "btf": "btfkit.io.bonn_write",
    "manifest": "btfkit.io.manifest",
}


@verb("convert", example="btfkit convert wool.btf.zarr -o wool.btf --as btf --set rank=64")
@click.argument("source", metavar="STORE", type=click.Path(path_type=Path))
@click.option("-o", "--out", required=True, type=click.Path(path_type=Path), help="To write.")
@click.option("--as", "kind", required=True, type=click.Choice(list(WRITERS)), help="Format.")
@click.option(
    "--set", "settings", type=SettingType(), multiple=True, help="An option of the writer."
)
@force_option
def convert_verb(
    bar: Bar,
    *,
    source: Path,
    out: Path,
    kind: str,
    settings: tuple[tuple[str, str], ...],
    force: bool,
) -> Outcome:
    """Write STORE, or anything `btfkit ingest` reads, in an interchange format."""
    import btfkit
    from btfkit.cli.settings import matched

    module = importlib.import_module(WRITERS[kind])
    options = matched(module.write, dict(settings))
    module.write(btfkit.open(source), out, force=force, progress=bar, **options)
    return Outcome(f"{out}: {kind}", {"out": out, "format": kind})
