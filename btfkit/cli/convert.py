"""`btfkit convert`: a store -> an interchange format."""

from __future__ import annotations

import importlib
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click

from btfkit.cli.bar import Bar
from btfkit.cli.options import SettingType, force_option
from btfkit.cli.outcome import Outcome, verb

if TYPE_CHECKING:
    from btfkit.btf import BTF

WRITERS: dict[str, str] = {
    "ubo2003": "btfkit.io.ubo2003",
    "utia": "btfkit.io.utia",
    "btf": "btfkit.io.bonn.write",
    "manifest": "btfkit.io.manifest.reader",
    "merl": "btfkit.export.merl",
    "bsdf": "btfkit.export.rgl",
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

    written(btfkit.open(source), out, kind, dict(settings), force=force, progress=bar)
    return Outcome(
        f"{out}: {kind}", {"out": out, "format": kind}, then=f"btfkit info {shlex.quote(str(out))}"
    )


def written(
    btf: BTF, out: Path, kind: str, settings: Mapping[str, str], *, force: bool, progress: Bar
) -> None:
    """Write a BTF by the writer of a format, with its own options given as text."""
    from btfkit.settings import options_of

    module = importlib.import_module(WRITERS[kind])
    options = options_of(module.write, settings)
    module.write(btf, out, force=force, progress=progress, **options)
