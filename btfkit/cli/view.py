"""`btfkit view`: a model or a BTF -> one page for any browser."""

from __future__ import annotations

from pathlib import Path

import click

from btfkit.cli.bar import Bar
from btfkit.cli.options import LocationType, force_option, out_option, stem
from btfkit.cli.outcome import Outcome, verb
from btfkit.remote import Location


@verb("view", example="btfkit view wool.neumip.safetensors -o wool.html")
@click.argument("source", metavar="MODEL_OR_BTF", type=LocationType())
@out_option("*.html; by default the source's name with .html, here")
@click.option("--small", is_flag=True, help="Textures of a model in 8 bits: half the bytes.")
@click.option("--measured", metavar="BTF", type=LocationType(),
              help="Of a model: a slider between it and this measurement.")  # fmt: skip
@force_option
def view_verb(
    bar: Bar,
    *,
    source: Location,
    out: Path | None,
    small: bool,
    measured: Location | None,
    force: bool,
) -> Outcome:
    """One self-contained page: a model on shapes to turn and light, or a BTF pair by pair.

    Nothing is loaded from a network; the page may be mailed, or opened from a disc.
    """
    from btfkit import sources
    from btfkit.btf import BTF
    from btfkit.errors import FormatError
    from btfkit.files import refuse_existing, whole
    from btfkit.materials.base import Material
    from btfkit.view import model, store

    final = out or Path(stem(source) + ".html")
    if final.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"{final}: a page is *.html")
    refuse_existing(final, force=force)
    found = sources.read(source)
    title = stem(source)
    truth = None if measured is None else sources.measured(measured)
    if truth is not None and not isinstance(truth, BTF):
        raise FormatError(str(measured), "has no textures to lay beside a model; expected a BTF")
    if isinstance(found, Material):
        kind, text = "model", model.page(found, title=title, small=small, measured=truth)
    elif truth is not None:
        raise ValueError(f"--measured is for the page of a model; {source} is none")
    elif isinstance(found, BTF):
        kind, text = "btf", store.page(found, title=title, progress=bar)
    else:
        raise FormatError(str(source), "has no page; expected a fitted model or a BTF")
    with whole(final, force=force) as partial:
        partial.write_text(text, encoding="utf-8")
    size = final.stat().st_size
    return Outcome(
        f"{final}: {size:,} bytes",
        {"out": final, "kind": kind, "bytes": size},
        then=f"open {final} in a browser",
    )
