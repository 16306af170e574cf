"""`btfkit tile`: an image, a BTF or a NeuBTF -> its tileable version."""

from __future__ import annotations

import shlex
from pathlib import Path

import click

from btfkit.cli.bar import Bar
from btfkit.cli.options import force_option, out_option
from btfkit.cli.outcome import Outcome, verb
from btfkit.cli.preview import of_btf, of_material, preview_option

# Below this nobody sees that a drift was taken away.
_SEEN = 0.005


@verb("tile", example="btfkit tile brick.png -o brick.tile.png")
@click.argument("source", metavar="INPUT", type=click.Path(path_type=Path))
@out_option("To write; by default INPUT with .tile before its suffix, here")
@click.option("--drift/--no-drift", default=True, show_default=True,
              help="Take away what makes one end brighter than the other.")  # fmt: skip
@preview_option
@force_option
def tile_verb(
    bar: Bar, *, source: Path, out: Path | None, drift: bool, preview: bool, force: bool
) -> Outcome:
    """Make INPUT tile: an image, a BTF store or a NeuBTF model."""
    from btfkit.cli.tiling import tile_file

    found, final = tile_file(source, out, drift=drift, force=force, progress=bar)
    (rows, cols), (p, q) = found.period, found.index.size
    what = "tiles as it is" if found.drift is None else f"tile of {q} x {p}"
    line = f"{final}: {what}, period {cols} x {rows} texels, seam ratio {found.seam_ratio:.3f}"
    if found.bent > _SEEN:
        line += (
            f"; brightness that drifts by up to {100 * found.bent:.0f} % taken away "
            f"(--no-drift leaves it)"
        )
    return Outcome(
        line,
        {
            "out": final,
            **found.record(),
            "seam_ratio": found.seam_ratio,
            **(_pictured(final) if preview else {}),
        },
        then=_next(final),
    )


def _pictured(final: Path) -> dict[str, Path]:
    """The preview of a tile that is no picture itself."""
    if final.suffix == ".zarr":
        from btfkit.io import open as open_btf

        return of_btf(open_btf(final), final)
    if final.suffix == ".safetensors":
        from btfkit.materials.file import load

        return of_material(load(final), final)
    return {}


def _next(final: Path) -> str:
    """What one does with a tile of its kind."""
    out = shlex.quote(str(final))
    if final.suffix == ".zarr":
        return f"btfkit fit {out}"
    if final.suffix == ".safetensors":
        return f"btfkit render {out} --shape sphere --repeat 3"
    return f"btfkit propagate {out}"
