"""`btfkit render`: a material on a shape -> a picture, a comparison, a sweep, a table of pairs."""

from __future__ import annotations

import math
import time
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from btfkit.cli.bar import Bar
from btfkit.cli.guessed import Guessed, of_coverage
from btfkit.cli.options import (
    DurationType,
    FiniteType,
    LocationType,
    NumbersType,
    force_option,
    out_option,
    seed_option,
    stem,
)
from btfkit.cli.outcome import Outcome, verb
from btfkit.jsonvalues import plain
from btfkit.remote import Location

if TYPE_CHECKING:
    from btfkit.materials.base import Material
    from btfkit.render.look import Look
    from btfkit.render.shot import Shot

_ANGLES = NumbersType("THETA,PHI", float)
_PANEL = NumbersType("THETA,PHI,W,H,DISTANCE", float)
_MOST_SIDE = 16384
# Bytes of a BTF that is read as a whole.
_IN_MEMORY = 1 << 30


@verb(
    "render",
    example="""btfkit render wool.neumip.safetensors -o wool.png --shape sphere --light 40,45
btfkit render wool.btf.zarr -o wool.exr --shape torus --env hall.hdr --repeat 3
btfkit render wool.neumip.safetensors --compare wool.btf.zarr --shape cylinder
btfkit render wool.neumip.safetensors --sweep view -o wool.webp --shape torus""",
)
@click.argument("source", metavar="MODEL_OR_BTF", type=LocationType())
@out_option("*.png, *.jpg (sRGB), *.exr (linear), *.webp, *.mp4 (sweep); default SOURCE.render.png")
@click.option("--shape", default="plane", show_default=True,
              help="plane, sphere, cylinder, torus, FILE.obj or FILE.ply.")  # fmt: skip
@click.option("--light", "lights", type=_ANGLES, multiple=True,
              help="Far away, degrees; repeatable. Key, fill and rim where none is.")  # fmt: skip
@click.option("--panel", "panels", type=_PANEL, multiple=True,
              help="An area light that faces the object, of radius 1; repeatable.")  # fmt: skip
@click.option("--env", type=click.Path(path_type=Path), help="Surroundings, *.hdr or *.exr.")
@click.option("--env-turn", type=float, default=0.0, help="Turn them about y, degrees.")
@click.option("--view", type=_ANGLES, default="0,0", show_default=True, help="To the eye, degrees.")
@click.option("--repeat", type=click.IntRange(1, 1000), default=1, show_default=True,
              help="Tiles across the front of the shape.")  # fmt: skip
@click.option(
    "--size", type=NumbersType("WxH", int, "x"), help="Pixels; by default 512 on the longer side."
)
@click.option("--spp", type=click.IntRange(1, 65536), help="Rays a pixel; as needed by default.")
@click.option("--within", "within_s", type=DurationType(),
              help="Ends with the passes finished by then; the first always is.")  # fmt: skip
@click.option(
    "--exposure",
    type=FiniteType(-100, 100),
    default=0.0,
    show_default=True,
    help="Stops, PNG only.",
)
@click.option("--background", type=NumbersType("R,G,B", float),
              help="Linear, PNG only; black, or grey without --light and --env.")  # fmt: skip
@click.option("--compare", metavar="OTHER", type=LocationType(),
              help="Side by side with another model or BTF, and the difference.")  # fmt: skip
@click.option("--sweep", type=click.Choice(["light", "view", "footprint"]),
              help="An animation: the light or the eye goes round, or detail is lost.")  # fmt: skip
@click.option("--frames", type=click.IntRange(2, 10000), default=36, show_default=True,
              help="Pictures of a sweep.")  # fmt: skip
@click.option("--fps", type=FiniteType(1, 120), default=12, show_default=True,
              help="Of a sweep.")  # fmt: skip
@click.option("--pairs", type=click.IntRange(2, 16),
              help="A table of so many views by so many lights, texel by texel.")  # fmt: skip
@click.option("--show-confidence", is_flag=True,
              help="Grey where answers were measured, orange where they are guessed.")  # fmt: skip
@seed_option
@force_option
def render_verb(
    bar: Bar,
    *,
    source: Location,
    out: Path | None,
    size: tuple[int, int] | None,
    exposure: float,
    background: tuple[float, float, float] | None,
    compare: Location | None,
    sweep: Any,
    frames: int,
    fps: float,
    pairs: int | None,
    show_confidence: bool,
    force: bool,
    **chosen: Any,
) -> Outcome:
    """Draw a model, a BTF or a relief on a shape, seen from far away.

    Angles are in the object's frame: x right, y up, z towards the viewer of --view 0,0; THETA from
    z, PHI from x towards y. A white surface that faces one --light is 1. A plane fills the picture.
    Without --light, --panel and --env a studio lights it: key, fill and rim light before grey.
    An interruption keeps the rays that were finished.
    """
    from btfkit.files import refuse_existing, whole
    from btfkit.render import animation, picture
    from btfkit.render.look import Look

    start = time.perf_counter()
    if sum(each is not None for each in (compare, sweep, pairs)) > 1:
        raise click.UsageError("--compare, --sweep and --pairs exclude each other")
    if compare and show_confidence:
        raise click.UsageError("--compare compares answers: leave out --show-confidence")
    if size is not None:
        _check_size(size)
    if not all(
        math.isfinite(number) for number in (chosen["env_turn"], exposure, *(background or ()))
    ):
        raise click.UsageError("--env-turn, --exposure and --background take finite numbers")
    shot = _shot(size, **chosen)
    kind = "compare" if compare else "pairs" if pairs else None
    # SOURCE.png might be the photograph that it was made of.
    suffix = ".sweep.webp" if sweep else f".{kind or 'render'}.png"
    final = out or Path(stem(source) + suffix)
    if sweep:
        animation.check_name(final)
    else:
        picture.check_name(final)
    if kind and final.suffix.lower() == ".exr":
        raise ValueError(f"{final}: a sheet of --{kind} is *.png or *.jpg")
    refuse_existing(final, force=force)
    material = _material(source, shot)
    guessed = of_coverage(material.header.coverage)
    if show_confidence:
        from btfkit.render.confidence import Confidence

        material = Confidence(material)
    look = Look(material.header.channels, exposure, background or shot.background)
    if sweep:
        shots = animation.shots(shot, sweep, frames, material)
        seen = [look.codes(each) for each in animation.frames(shots, material, bar)]
        made: dict[str, Any] = {"sweep": sweep, "frames": frames, "fps": fps}
        with whole(final, force=force) as partial:
            animation.write(partial, seen, fps=fps)
    elif pairs:
        made = _pairs_sheet(material, look, pairs, final, bar, force)
    elif compare:
        made = _comparison(source, material, compare, shot, look, final, bar, force)
    else:
        return _still(source, material, shot, look, final, bar, force, start, guessed)
    seconds = time.perf_counter() - start
    said = "".join(f", {key} {made[key]:.4g}" for key in ("psnr", "mae") if key in made)
    return Outcome(
        f"{final}: {seconds:.1f} s{said}{guessed.line}",
        {
            "out": final,
            "source": source,
            "model": material.model,
            **made,
            "seconds": seconds,
            **guessed.data,
        },
        then="open it",
    )


def _still(
    source: Location, material: Material, shot: Shot, look: Look, final: Path, bar: Bar,
    force: bool, start: float, guessed: Guessed,
) -> Outcome:  # fmt: skip
    from btfkit.render import picture, studio
    from btfkit.render.confidence import Confidence

    seen = shot.taken(shot.scene(material), bar)
    w, h = shot.size_of(material)
    lights = studio.ANGLES if shot.in_studio else shot.lights
    irradiance = studio.IRRADIANCE if shot.in_studio else (1.0,) * len(lights)
    about = {
        "source": source, "model": material.model, "licence": material.header.licence,
        "quantity": "radiance; 1 is a white diffuser that faces one light",
        "shape": shot.shape, "lights_deg": lights, "irradiance": irradiance,
        "panels": shot.panels, "env": shot.env, "env_turn_deg": shot.env_turn,
        "view_deg": shot.view, "repeat": shot.repeat, "spp": seen.samples, "seed": shot.seed,
        "show_confidence": isinstance(material, Confidence),
    }  # fmt: skip
    picture.write(
        seen, final, channels=look.channels, exposure=look.exposure,
        background=look.background, about=plain(about), force=force,
    )  # fmt: skip
    if seen.interrupted:
        raise KeyboardInterrupt
    if not seen.asked:
        warnings.warn("no light reaches what is seen: the picture is black", stacklevel=2)
    seconds = time.perf_counter() - start
    return Outcome(
        f"{final}: {w} x {h}, {seen.samples} rays a pixel, {seen.asked} queries, {seconds:.1f} s"
        f"{guessed.line}",
        {"out": final, "size": (w, h), "queries": seen.asked, "seconds": seconds,
         "cover": float(seen.cover.mean()), **about, **guessed.data},
        then="open it; --env FILE.hdr lights it by surroundings, --repeat tiles it",
    )  # fmt: skip


def _comparison(
    source: Location, material: Material, compare: Location, shot: Shot, look: Look,
    final: Path, bar: Bar, force: bool,
) -> dict[str, Any]:  # fmt: skip
    """Writes two materials side by side and their difference; the figures."""
    from dataclasses import replace

    from btfkit.render import sheets

    other = _material(compare, shot)
    if other.header.channels != material.header.channels:
        raise ValueError(
            f"{source} has channels {', '.join(material.header.channels)}, {compare} "
            f"{', '.join(other.header.channels)}: they cannot be compared"
        )
    # One size and one number of rays for both, so that pixels answer pixels.
    same = replace(shot, size=shot.size_of(material))
    first = same.taken(same.scene(material), bar)
    same = replace(same, samples=first.samples)
    second = same.taken(same.scene(other), bar)
    figures = sheets.compared(first, second)
    sheet = sheets.side_by_side(
        (look.linear(first), look.linear(second)), (stem(source), stem(compare)), figures
    )
    look.write(sheet, final, force=force)
    return {"compare": compare, "spp": first.samples, **figures}


def _pairs_sheet(
    material: Material, look: Look, count: int, final: Path, bar: Bar, force: bool
) -> dict[str, Any]:
    from btfkit.render import sheets

    sheet, angles = sheets.direction_pairs(
        material, look.to_rgb, count=count, exposure=look.exposure, progress=bar
    )
    look.write(sheet, final, force=force)
    return {"pairs": count, "directions_deg": angles}


def _shot(size: tuple[int, int] | None, *, spp: int | None, **chosen: Any) -> Shot:
    from btfkit.render.shot import Shot

    for name in ("lights", "panels"):
        _check_finite("--" + name.rstrip("s"), chosen[name])
    _check_finite("--view", (chosen["view"],))
    return Shot(size=size, samples=spp, **chosen)


def _material(source: Location, shot: Shot) -> Material:
    """What is drawn; in memory where a picture needs most of it anyway."""
    from btfkit import sources

    material = sources.material(source, curved=shot.shape != "plane")
    if shot.env is not None or shot.panels or shot.shape != "plane":
        return _at_hand(material)
    return material


def _check_size(size: tuple[int, int]) -> None:
    if not all(1 <= side <= _MOST_SIDE for side in size):
        raise click.BadParameter(
            f"{size[0]}x{size[1]}; expected sides of 1 to {_MOST_SIDE} pixels", param_hint="--size"
        )


def _check_finite(option: str, numbers: Any) -> None:
    if not all(math.isfinite(number) for each in numbers for number in each):
        raise click.BadParameter("expected finite angles in degrees", param_hint=option)


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
