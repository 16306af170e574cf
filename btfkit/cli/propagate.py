"""`btfkit propagate`: a guidance image and a fitted NeuBTF -> the NeuBTF on that image."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from btfkit.cli.bar import Bar
from btfkit.cli.guessed import of_coverage
from btfkit.cli.options import FiniteType, force_option, out_option, seed_option, stem, the_only
from btfkit.cli.outcome import Outcome, verb
from btfkit.cli.preview import of_material, preview_option

if TYPE_CHECKING:
    from btfkit.relief.normalmap import Green


@verb("propagate", example="btfkit propagate guidance.png --model wool.neubtf.safetensors")
@click.argument("guidance", type=click.Path(path_type=Path))
@click.option(
    "--model",
    "models",
    type=click.Path(path_type=Path),
    multiple=True,
    help="A NeuBTF with its encoder; several with --mask.",
)
@out_option("The model to write; by default GUIDANCE.neubtf.safetensors here")
@click.option("--scale", type=FiniteType(min=0, min_open=True), default=1.0)
@click.option("--tileable", is_flag=True, help="Make the guidance tile first.")
@click.option(
    "--normals",
    type=click.Path(path_type=Path),
    help="A normal map of the guidance: heights follow its slopes.",
)
@click.option(
    "--normals-y",
    "green",
    type=click.Choice(["up", "down"]),
    default="up",
    help="Which way the map's green axis runs: up as in OpenGL, down as in DirectX.",
)
@click.option(
    "--mask",
    type=click.Path(path_type=Path),
    help="Grey labels of the guidance's size: the darkest value is the first --model.",
)
@preview_option
@seed_option
@force_option
def propagate_verb(
    bar: Bar,
    *,
    guidance: Path,
    models: tuple[Path, ...],
    out: Path | None,
    scale: float,
    tileable: bool,
    normals: Path | None,
    green: Green,
    mask: Path | None,
    preview: bool,
    seed: int,
    force: bool,
) -> Outcome:
    """Carry a fitted NeuBTF onto GUIDANCE, an image of the same or another structure.

    Without --model, the only NeuBTF with an encoder in this folder is taken.
    """
    from btfkit.propagation import consistency, has_encoder, propagate

    source = models or (
        the_only(
            (path for path in Path().glob("*.safetensors") if has_encoder(path)),
            what="NeuBTF models with an encoder",
            remedy="name one with --model",
            first="btfkit fit --model neubtf, or name one with --model",
        ),
    )
    final = out or Path(f"{stem(guidance)}.neubtf.safetensors")
    material = propagate(
        guidance, source, scale=scale, tileable=tileable, normals=normals, green=green, mask=mask,
        out=final, force=force, progress=bar,
    )  # fmt: skip
    h, w = material.header.grid
    names = " and ".join(path.name for path in source)
    line = f"{final}: {names} on {guidance.name}, {w} x {h} texels"
    named: Any = source[0] if len(source) == 1 else list(source)
    found = {"out": final, "model": named, "grid": (h, w), **material.header.provenance}
    if "copied" in found:
        line += f", {100 * found['copied']:.0f} % copied from the sample"
    if scale < 1 and len(source) == 1:
        found["consistency_db"] = alike = consistency(guidance, source[0], scale=scale)
        line += f"; {alike:.1f} dB from the material at full size, shrunk"
    guessed = of_coverage(material.header.coverage)
    line, found = line + guessed.line, {**found, **guessed.data}
    found |= of_material(material, final) if preview else {}
    then = f"btfkit view {shlex.quote(str(final))}"
    return Outcome(line, found, then=then)
