"""`btfkit tile`: an image, a BTF or a NeuBTF -> its tileable version."""

from __future__ import annotations

from pathlib import Path

import click

from btfkit.cli.bar import Bar
from btfkit.cli.options import force_option, out_option
from btfkit.cli.outcome import Outcome, verb


@verb("tile", example="btfkit tile brick.png -o brick.tile.png")
@click.argument("source", metavar="INPUT", type=click.Path(path_type=Path))
@out_option("To write; by default INPUT with .tile before its suffix, here")
@force_option
def tile_verb(bar: Bar, *, source: Path, out: Path | None, force: bool) -> Outcome:
    """Make INPUT tile: an image, a BTF store or a NeuBTF model."""
    from btfkit.cli.tiling import tile_file

    found, final = tile_file(source, out, force=force, progress=bar)
    (rows, cols), (p, q) = found.period, found.index.size
    what = "tiles as it is" if found.drift is None else f"tile of {p} x {q}"
    return Outcome(
        f"{final}: {what}, period {rows} x {cols} texels, seam ratio {found.seam_ratio:.3f}",
        {"out": final, **found.record(), "seam_ratio": found.seam_ratio},
    )
