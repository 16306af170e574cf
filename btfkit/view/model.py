"""A material as a page: its program as a shader, its textures within, nothing from elsewhere."""

from __future__ import annotations

from btfkit.btf import BTF
from btfkit.export.glsl import drawable, encoded, rgb
from btfkit.export.package import about
from btfkit.export.sections import filled, whole_text
from btfkit.materials.base import Material
from btfkit.view import slices
from btfkit.view.page import composed, in_script, section


def page(
    material: Material, *, title: str, small: bool = False, measured: BTF | None = None
) -> str:
    """One HTML page, which draws a material on simple shapes by WebGL2.

    Args:
        material: one that has a program.
        title: shown, and escaped.
        small: textures as bytes between the ends of each channel instead of half floats.
        measured: of which some textures lie behind a slider.

    Raises:
        TypeError: the material has no program.
        ValueError: textures that a browser cannot hold.
    """
    program = material.program()
    made = drawable(program, model=material.model, texels="byte" if small else "half")
    c = len(program.channels)
    scene = filled(
        section("scene.glsl.txt", "scene"),
        channels=c, rgb=rgb(program.channels), curvature="curvature, " if program.bends else "",
    )  # fmt: skip
    h, w = program.grid
    carried = {
        "aspect": program.aspect,
        "grid": [w, h],
        "leveled": program.leveled,
        "about": _said(material),
        "measured": None if measured is None else slices.carried(material, measured),
        "textures": made.about,
        "data": {name: encoded(data) for name, data in made.data.items()},
        "fragment": "#version 300 es\nprecision highp float;\nprecision highp int;\n"
        + made.source + scene,
    }  # fmt: skip
    return composed(
        "model", "model.js", title=title,
        upload=whole_text("upload.js"), mesh=section("mesh.js.txt", "mesh"),
        material=in_script(carried),
    )  # fmt: skip


def _said(material: Material) -> list[tuple[str, str]]:
    """Rows of names and values that the page shows about a material."""
    known = about(material)
    tile = known["tile_mm"]
    w, h = known["texels"]
    channels = ", ".join(known["channels"])
    return [
        ("model", known["model"]),
        ("texels", f"{w} x {h}"),
        ("tile", "size unknown" if tile is None else f"{tile[0]:.4g} x {tile[1]:.4g} mm"),
        ("channels", channels if len(channels) <= 40 else f"{len(known['channels'])}"),
        ("borders", "tile" if known["wrap"] == "wrap" else "do not tile"),
        ("licence", known["licence"] or "not stated"),
    ]
