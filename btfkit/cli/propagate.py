"""`btfkit propagate`: a guidance image and a fitted NeuBTF -> the NeuBTF on that image."""

from __future__ import annotations

import shlex
from pathlib import Path

import click

from btfkit.cli.bar import Bar
from btfkit.cli.guessed import of_coverage
from btfkit.cli.options import force_option, out_option, seed_option, stem, the_only
from btfkit.cli.outcome import Outcome, verb
from btfkit.cli.preview import of_material, preview_option


@verb("propagate", example="btfkit propagate guidance.png --model wool.neubtf.safetensors")
@click.argument("guidance", type=click.Path(path_type=Path))
@click.option("--model", type=click.Path(path_type=Path), help="A NeuBTF with its encoder.")
@out_option("The model to write; by default GUIDANCE.neubtf.safetensors here")
@click.option("--scale", type=click.FloatRange(min=0, min_open=True), default=1.0)
@click.option("--tileable", is_flag=True, help="Make the guidance tile first.")
@preview_option
@seed_option
@force_option
def propagate_verb(
    bar: Bar,
    *,
    guidance: Path,
    model: Path | None,
    out: Path | None,
    scale: float,
    tileable: bool,
    preview: bool,
    seed: int,
    force: bool,
) -> Outcome:
    """Carry a fitted NeuBTF onto GUIDANCE, an image of the same or another structure.

    Without --model, the only NeuBTF with an encoder in this folder is taken.
    """
    from btfkit.propagation import consistency, has_encoder, propagate

    source = model or the_only(
        (path for path in Path().glob("*.safetensors") if has_encoder(path)),
        what="NeuBTF models with an encoder",
        remedy="name one with --model",
        first="btfkit fit --model neubtf, or name one with --model",
    )
    final = out or Path(f"{stem(guidance)}.neubtf.safetensors")
    material = propagate(
        guidance, source, scale=scale, tileable=tileable, out=final, force=force, progress=bar
    )
    h, w = material.header.grid
    line = f"{final}: {source.name} on {guidance.name}, {w} x {h} texels"
    found = {"out": final, "model": source, "grid": (h, w), **material.header.provenance}
    if scale < 1:
        found["consistency_db"] = alike = consistency(guidance, source, scale=scale)
        line += f"; {alike:.1f} dB from the material at full size, shrunk"
    guessed = of_coverage(material.header.coverage)
    line, found = line + guessed.line, {**found, **guessed.data}
    found |= of_material(material, final) if preview else {}
    then = f"btfkit view {shlex.quote(str(final))}"
    return Outcome(line, found, then=then)
