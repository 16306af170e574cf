"""`btfkit render`: a material on a shape -> a picture."""

from __future__ import annotations

import time
from pathlib import Path

import click

from btfkit.cli.bar import Bar
from btfkit.cli.options import NumbersType, force_option, out_option, seed_option, stem
from btfkit.cli.outcome import Outcome, verb

_DIRECTION = NumbersType("THETA,PHI", float)


@verb(
    "render",
    example="btfkit render wool.neumip.safetensors -o wool.png --shape sphere --light 40,45",
)
@click.argument("source", metavar="MODEL_OR_BTF", type=click.Path(path_type=Path))
@out_option("*.png (sRGB) or *.exr (linear); by default the name of the source, .png, here")
@click.option("--shape", default="plane", show_default=True, help="plane, sphere, cylinder.")
@click.option("--light", "lights", type=_DIRECTION, multiple=True, help="Degrees; repeatable.")
@click.option("--env", type=click.Path(path_type=Path), help="Surroundings, *.hdr or *.exr.")
@click.option("--view", type=_DIRECTION, default="0,0", show_default=True, help="Degrees.")
@click.option("--repeat", type=click.IntRange(1, 1000), default=1, show_default=True, help="Tiles.")
@click.option("--size", type=NumbersType("WxH", int, "x"), default="512x512", show_default=True)
@click.option("--spp", type=click.IntRange(1, 65536), help="Rays a pixel.")
@click.option("--exposure", type=float, default=0.0, show_default=True, help="Stops, PNG only.")
@seed_option
@force_option
def render_verb(
    bar: Bar,
    *,
    source: Path,
    out: Path | None,
    shape: str,
    lights: tuple[tuple[float, float], ...],
    env: Path | None,
    view: tuple[float, float],
    repeat: int,
    size: tuple[int, int],
    spp: int | None,
    exposure: float,
    seed: int,
    force: bool,
) -> Outcome:
    """Draw a material on a shape.

    A white surface that faces one --light is 1. Directions are in the object's frame: x
    right, y up, z towards the viewer; THETA from z, PHI from x towards y.
    """
    import numpy as np

    from btfkit import directions
    from btfkit.cli.sources import material_of
    from btfkit.files import refuse_existing
    from btfkit.render import picture
    from btfkit.render.environment import Environment
    from btfkit.render.preview import Scene, render
    from btfkit.render.catalogue import shape_of

    w, h = size
    if min(size) < 1:
        raise click.BadParameter(f"{w}x{h}; expected WxH, both positive", param_hint="--size")
    final = out or Path(stem(source) + ".png")
    refuse_existing(final, force=force)
    material = material_of(source)
    if not lights and env is None:
        lights = ((40.0, 45.0),)
    scene = Scene(
        material,
        shape_of(shape, repeat=repeat, aspect=material.header.aspect, picture=w / h),
        directions.from_angles(*np.radians(np.reshape(lights, (-1, 2))).T),
        None if env is None else Environment(picture.read(env)),
    )
    start = time.perf_counter()
    seen = render(
        scene,
        view=directions.from_angles(*np.radians(view)),
        size=(h, w),
        samples=spp or (1 if env is None else 64),
        seed=seed,
        progress=bar,
    )
    seconds = time.perf_counter() - start
    picture.write(seen, final, channels=material.header.channels, exposure=exposure, force=force)
    return Outcome(
        f"{final}: {w} x {h}, {seen.asked} queries, {seconds:.1f} s",
        {"out": final, "queries": seen.asked, "seconds": seconds},
    )
