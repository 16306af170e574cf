"""`btfkit render`: a material on a shape -> a picture."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from btfkit.cli.bar import Bar
from btfkit.cli.guessed import of_coverage
from btfkit.cli.options import NumbersType, force_option, out_option, seed_option, stem
from btfkit.cli.outcome import Outcome, verb
from btfkit.jsonvalues import plain

if TYPE_CHECKING:
    from btfkit.materials.base import Material
    from btfkit.shapes.closed import Floats

_ANGLES = NumbersType("THETA,PHI", float)
_MOST_SIDE = 16384
_SIDE = 512
# Bytes of a BTF that is read as a whole.
_IN_MEMORY = 1 << 30


@verb(
    "render",
    example="""btfkit render wool.neumip.safetensors -o wool.png --shape sphere --light 40,45
btfkit render wool.btf.zarr -o wool.exr --shape torus --env hall.hdr --repeat 3""",
)
@click.argument("source", metavar="MODEL_OR_BTF", type=click.Path(path_type=Path))
@out_option("*.png or *.jpg (sRGB), *.exr (linear); by default the source's name with .png, here")
@click.option("--shape", default="plane", show_default=True,
              help="plane, sphere, cylinder, torus or FILE.obj.")  # fmt: skip
@click.option("--light", "lights", type=_ANGLES, multiple=True,
              help="Far away, degrees; repeatable. Key, fill and rim where none is.")  # fmt: skip
@click.option("--env", type=click.Path(path_type=Path), help="Surroundings, *.hdr or *.exr.")
@click.option("--env-turn", type=float, default=0.0, help="Turn them about y, degrees.")
@click.option("--view", type=_ANGLES, default="0,0", show_default=True, help="To the eye, degrees.")
@click.option("--repeat", type=click.IntRange(1, 1000), default=1, show_default=True,
              help="Tiles across the front of the shape.")  # fmt: skip
@click.option(
    "--size", type=NumbersType("WxH", int, "x"), help="Pixels; by default 512 on the longer side."
)
@click.option("--spp", type=click.IntRange(1, 65536), help="Rays a pixel; as needed by default.")
@click.option("--exposure", type=float, default=0.0, show_default=True, help="Stops, PNG only.")
@click.option("--background", type=NumbersType("R,G,B", float),
              help="Linear, PNG only; black, or grey without --light and --env.")  # fmt: skip
@click.option("--show-confidence", is_flag=True,
              help="Grey where answers were measured, orange where they are guessed.")  # fmt: skip
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
    env_turn: float,
    view: tuple[float, float],
    repeat: int,
    size: tuple[int, int] | None,
    spp: int | None,
    exposure: float,
    background: tuple[float, float, float] | None,
    show_confidence: bool,
    seed: int,
    force: bool,
) -> Outcome:
    """Draw a model, a BTF or a relief on a shape, seen from far away.

    Angles are in the object's frame: x right, y up, z towards the viewer of --view 0,0; THETA from
    z, PHI from x towards y. A white surface that faces one --light is 1. A plane fills the picture.
    Without --light and --env a studio lights it: key, fill and rim light before grey.
    """
    from btfkit import sources
    from btfkit.files import refuse_existing
    from btfkit.render import picture, studio
    from btfkit.render.environment import Environment
    from btfkit.render.preview import Scene, enough_samples, render
    from btfkit.shapes.catalogue import shape_of

    start = time.perf_counter()
    if size is not None:
        _check_size(size)
    if not all(math.isfinite(number) for number in (env_turn, exposure, *(background or ()))):
        raise click.UsageError("--env-turn, --exposure and --background take finite numbers")
    final = out or Path(stem(source) + ".png")
    picture.check_name(final)
    refuse_existing(final, force=force)
    material = sources.material(source, curved=shape != "plane")
    guessed = of_coverage(material.header.coverage)
    if show_confidence:
        from btfkit.render.confidence import Confidence

        material = Confidence(material)
    elif env is not None or shape != "plane":
        # Such a picture needs most of the textures anyway.
        material = _at_hand(material)
    # A plane fills the picture, which by default has the shape of the material.
    w, h = size or _shaped(material.header.aspect if shape == "plane" else 1.0)
    channels = material.header.channels
    in_studio = not lights and env is None
    if in_studio:
        lights = studio.ANGLES
    irradiance = studio.IRRADIANCE if in_studio else (1.0,) * len(lights)
    surroundings = None
    if env is not None:
        radiance = picture.read_surroundings(env, channels=channels)
        surroundings = Environment(radiance, turn=math.radians(env_turn))
    scene = Scene(
        material,
        shape_of(shape, repeat=repeat, aspect=material.header.aspect, picture=w / h),
        _directions("--light", lights),
        surroundings,
        irradiance,
    )
    eye = _directions("--view", (view,))[0]
    samples = spp or enough_samples(scene, eye, (h, w))
    seen = render(scene, view=eye, size=(h, w), samples=samples, seed=seed, progress=bar)
    about = {
        "source": source, "model": material.model, "licence": material.header.licence,
        "quantity": "radiance; 1 is a white diffuser that faces one light",
        "shape": shape, "lights_deg": lights, "irradiance": irradiance,
        "env": env, "env_turn_deg": env_turn,
        "view_deg": view, "repeat": repeat, "spp": samples, "seed": seed,
        "show_confidence": show_confidence,
    }  # fmt: skip
    picture.write(
        seen, final, channels=channels, exposure=exposure,
        background=background or (studio.GREY if in_studio else (0, 0, 0)),
        about=plain(about), force=force,
    )  # fmt: skip
    seconds = time.perf_counter() - start
    return Outcome(
        f"{final}: {w} x {h}, {samples} rays a pixel, {seen.asked} queries, {seconds:.1f} s"
        f"{guessed.line}",
        {"out": final, "size": (w, h), "queries": seen.asked, "seconds": seconds,
         "cover": float(seen.cover.mean()), **about, **guessed.data},
        then="open it; --env FILE.hdr lights it by surroundings, --repeat tiles it",
    )  # fmt: skip


def _shaped(aspect: float) -> tuple[int, int]:
    """Width and height of a picture of that shape, at most `_SIDE` pixels a side."""
    short = max(1, round(_SIDE * min(aspect, 1 / aspect)))
    return (_SIDE, short) if aspect >= 1 else (short, _SIDE)


def _check_size(size: tuple[int, int]) -> None:
    if not all(1 <= side <= _MOST_SIDE for side in size):
        raise click.BadParameter(
            f"{size[0]}x{size[1]}; expected sides of 1 to {_MOST_SIDE} pixels", param_hint="--size"
        )


def _directions(option: str, angles: tuple[tuple[float, float], ...]) -> Floats:
    """(n, 3) unit vectors of angles in degrees."""
    import numpy as np

    from btfkit.directions import from_angles

    degrees = np.reshape(np.array(angles, float), (-1, 2))
    if not np.isfinite(degrees).all():
        raise click.BadParameter("expected finite angles in degrees", param_hint=option)
    return from_angles(*np.radians(degrees).T)


def _at_hand(material: Material) -> Material:
    """The same material, in memory where it is a small BTF that is read lazily."""
    import numpy as np

    from btfkit.materials.measured.interpolation import Interpolation
    from btfkit.textures import Textures

    lazy: Any = material.weights.get("texture")
    if not (isinstance(material, Interpolation) and isinstance(lazy, Textures)):
        return material
    if 4 * math.prod(lazy.shape) > _IN_MEMORY:
        return material
    texture = lazy.batch(np.arange(len(lazy)))
    return Interpolation(material.spec, {**material.weights, "texture": texture}, material.header)
