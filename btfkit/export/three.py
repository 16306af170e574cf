"""`three`: a JSON and its numbers for three.js, a module that reads them, and a page."""

from __future__ import annotations

import html
import json
from pathlib import Path
from typing import Any

from btfkit.export.glsl import drawable, rgb
from btfkit.export.sections import filled, sections
from btfkit.materials.base import Material
from btfkit.program import Program

# The release that the page and its tests were run with.
THREE = "0.187.0"


def write(material: Material, program: Program, folder: Path) -> None:
    """`material.json`, `material.bin`, `btfkit.js`, `index.html`, `package.json`, `check.mjs`."""
    made = drawable(program, model=material.model)
    h, w = program.grid
    parts: dict[str, Any] = {}
    at = 0
    for name, data in made.data.items():
        parts[name] = [at, len(data)]
        at += len(data)
    texel = material.header.texel_mm
    described = {
        "model": material.model,
        "channels": list(program.channels),
        "grid": [w, h],
        "aspect": program.aspect,
        "tile_mm": None if texel is None else [w * texel, h * texel],
        "textures": made.about,
        "parts": parts,
        "rgb": rgb(program.channels),
        "source": made.source,
    }
    (folder / "material.json").write_text(json.dumps(described) + "\n")
    (folder / "material.bin").write_bytes(b"".join(made.data.values()))
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
