"""`three`: a JSON and its numbers for three.js, a module that reads them, and a page.

As a shader of WebGLRenderer (GLSL), and as a node material of WebGPURenderer (TSL around WGSL).
"""

from __future__ import annotations

import html
import json
from pathlib import Path
from typing import Any

from btfkit.export.ball import tiles_around
from btfkit.export.glsl import drawable, rgb
from btfkit.export.glsl.atlas import atlas, quantised
from btfkit.export.sections import filled, sections
from btfkit.export.shading import shaded
from btfkit.materials.base import Material
from btfkit.program import Program

# The release that the page and its tests were run with.
THREE = "0.187.0"


def write(material: Material, program: Program, folder: Path) -> None:
    """`material.json`, `material.bin`, `btfkit.js`, `index.html`, `package.json`, `check.mjs`."""
    made = drawable(program, model=material.model)
    # Of the textures that the file holds, so that both shaders answer alike.
    near = shaded(quantised(program, "half"), "wgsl", model=material.model, in_textures=True)
    starts = [start for name in atlas(program, "half").places for start in near.starts[name]]
    h, w = program.grid
    around = tiles_around(program)
    down = around / 2 * program.aspect
    parts: dict[str, Any] = {}
    at = 0
    held = made.data | {"numbers": near.buffers.get("weights", b"")}
    for name, data in held.items():
        parts[name] = [at, len(data)]
        at += len(data)
    texel = material.header.texel_mm
    described = {
        "model": material.model,
        "channels": list(program.channels),
        "grid": [w, h],
        "aspect": program.aspect,
        # Tiles around the ball of the page, and from pole to pole.
        "ball": [around, max(1, round(down)) if program.wrap else down],
        "tile_mm": None if texel is None else [w * texel, h * texel],
        "textures": made.about,
        "parts": parts,
        "rgb": rgb(program.channels),
        "bends": program.bends,
        "passes": program.opacity != "none",
        "source": made.source,
        "wgsl": {"source": near.text, "starts": starts},
    }
    (folder / "material.json").write_text(json.dumps(described) + "\n")
    (folder / "material.bin").write_bytes(b"".join(held.values()))
    package = {
        "name": "btfkit-material",
        "private": True,
        "type": "module",
        "scripts": {"check": "node check.mjs"},
        "dependencies": {"three": THREE},
    }
    (folder / "package.json").write_text(json.dumps(package, indent=1) + "\n")
    texts = sections("three.js.txt")
    title = html.escape(f"btfkit {material.model}")
    for name in ("btfkit.js", "index.html", "check.mjs"):
        (folder / name).write_text(filled(texts[name], title=title))
