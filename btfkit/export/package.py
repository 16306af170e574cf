"""What every export is: a folder with the material, its papers, a picture and an example."""

from __future__ import annotations

import importlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from btfkit import jsonvalues
from btfkit.btf import COLOUR
from btfkit.conventions import LEAST_FACING
from btfkit.export import ASKED, TARGETS
from btfkit.export.sections import filled, whole_text
from btfkit.files import whole_folder
from btfkit.materials.base import Material
from btfkit.materials.lobes.table import COLUMNS
from btfkit.program import Program
from btfkit.render import studio

PREVIEW, LOBES = "preview.png", "lobes.bin"


def export(
    material: Material, target: str, out: str | os.PathLike[str], *, force: bool = False
) -> dict[str, Any]:
    """Write a material for another program.

    Args:
        material: one that has a program.
        target: one of `TARGETS`.
        out: the folder, which appears whole or not at all.
        force: whether an existing one is replaced.

    Returns:
        What `about.json` in it says, and `files`: bytes by name.

    Raises:
        ValueError: no such target.
        TypeError: the material has no program, or one that no export has.
        FileExistsError: `out` exists and `force` is False.
    """
    if target not in TARGETS:
        raise ValueError(f"no target {target!r}; there are {', '.join(TARGETS)}")
    program = material.program()
    module, function = TARGETS[target].split(":")
    write: Callable[[Material, Program, Path], None]
    write = getattr(importlib.import_module(module), function)
    said = {"target": target, **about(material)}
    with whole_folder(out, force=force) as folder:
        write(material, program, folder)
        if target not in ASKED:
            said["lobes"] = _lobes(material, folder)
        (folder / "about.json").write_text(json.dumps(jsonvalues.plain(said), indent=1) + "\n")
        (folder / PREVIEW).write_bytes(studio.picture(material))
    if target == "blender":
        from btfkit.export.blender import build

        # Where it lies now, since shaders know their textures by whole paths.
        build(Path(out))
    files = {str(path.relative_to(out)): path.stat().st_size
             for path in sorted(Path(out).rglob("*")) if path.is_file()}  # fmt: skip
    return {**said, "files": files, "bytes": sum(files.values())}


def _lobes(material: Material, folder: Path) -> dict[str, Any]:
    """Writes what lights are drawn from and `lobes.py`, and says how it lies in its file."""
    finest = material.lobes.levels[0]
    h, w, _ = finest.shape
    (folder / LOBES).write_bytes(finest.astype("<f2").tobytes())
    reader = filled(whole_text("lobes.py.txt"), facing=LEAST_FACING)
    (folder / "lobes.py").write_text(reader)
    return {
        "file": LOBES,
        "size": [w, h],
        "columns": list(COLUMNS),
        "numbers": "float16, little-endian, cell by cell, row by row, v = 0 first",
    }


def about(material: Material) -> dict[str, Any]:
    """What a material says of itself outside this toolkit: size, licence, colour, meaning."""
    header = material.header
    h, w = header.grid
    size_mm = None if header.texel_mm is None else [w * header.texel_mm, h * header.texel_mm]
    return {
        "model": material.model,
        "quantity": header.quantity,
        "channels": list(header.channels),
        "colour": COLOUR if len(header.channels) == 3 else None,
        "tile_mm": size_mm,
        "texels": [w, h],
        "wrap": header.wrap,
        "licence": header.licence,
        "provenance": dict(header.provenance),
        "frame": "x right, y up, z out; light and view point away; u right, v down, in tiles",
        "footprint": "standard deviation of the kernel, texels; 0.5 is one texel",
    }
