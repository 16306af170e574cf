"""`glsl`: one function in GLSL ES 3.00, its textures, and a page that draws with it."""

from __future__ import annotations

import base64
import html
import json
from pathlib import Path
from typing import Any, NamedTuple

from btfkit.export import lobes
from btfkit.export.glsl.atlas import Texels, atlas
from btfkit.export.glsl.code import shader
from btfkit.export.numbers import literal
from btfkit.export.sections import filled, sections, whole_text
from btfkit.materials.base import Material
from btfkit.program import Program
from btfkit.render.studio import visible


class Drawable(NamedTuple):
    """A material as WebGL2 takes it.

    Attributes:
        source: the function `btfkit_evaluate`, GLSL ES 3.00 without a version line.
        about: how the textures are uploaded; JSON types.
        data: bytes of `texels`, and of `heights` and `weights` where there are any.
    """

    source: str
    about: dict[str, Any]
    data: dict[str, bytes]


def drawable(program: Program, *, model: str, texels: Texels = "half") -> Drawable:
    """The shader and textures of a program.

    Args:
        texels: half floats, or bytes between the ends of each channel.
    """
    textures = atlas(program, texels)
    made = shader(program, textures, model=model)
    data = {"texels": textures.data.tobytes()}
    if textures.heights is not None:
        data["heights"] = textures.heights.tobytes()
    if made.weights is not None:
        data["weights"] = made.weights.tobytes()
    rows = 0 if made.weights is None else len(made.weights)
    return Drawable(
        made.text, {**textures.described(), "weights": rows, "wrap": program.wrap}, data
    )


def write(material: Material, program: Program, folder: Path) -> None:
    """`material.glsl`, `material.json`, its textures, `upload.js` and `example.html`."""
    made = drawable(program, model=material.model)
    (folder / "material.glsl").write_text(made.source)
    (folder / "lobes.glsl").write_text(lobes.shader(material, "glsl"))
    (folder / "material.json").write_text(json.dumps(made.about) + "\n")
    for name, data in made.data.items():
        (folder / f"{name}.bin").write_bytes(data)
    (folder / "upload.js").write_text(whole_text("upload.js"))
    c = len(program.channels)
    # Other than RGB: the first, the middle and the last channel.
    shown = (0, 1, 2) if c == 3 else (0, c // 2, c - 1)
    texel = max(0.5, max(program.grid) / 1024)
    page = filled(
        sections("example.html.txt")["page"],
        title=html.escape(f"btfkit {material.model}"), upload=whole_text("upload.js"),
        about=json.dumps(made.about), source=made.source, channels=c,
        rgb=", ".join(f"value[{k}]" for k in shown), footprint=f"{texel:.4f}",
        **{name: encoded(made.data.get(name, b"")) for name in ("texels", "heights", "weights")},
    )  # fmt: skip
    (folder / "example.html").write_text(page)


def encoded(data: bytes) -> str:
    """Bytes as base64."""
    return base64.b64encode(data).decode()


def rgb(channels: tuple[str, ...]) -> str:
    """A vec3 of the channels' linear RGB in `value`; of channels without colour their mean."""
    rows = [
        " + ".join(f"{literal(m)} * value[{k}]" for k, m in enumerate(column) if m)
        for column in visible(channels).T
    ]
    return f"vec3({', '.join(row or '0.0' for row in rows)})"
