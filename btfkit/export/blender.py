"""`blender`: maps for Principled, two shaders in OSL, and a program that builds the .blend.

(a) Principled maps and true displacement. (b) Principled whose parameters are those of the place
where the view ray ends: a Cycles shader may look at the view and not at the light, so what the
network says of the light is lost. (c) For one distant light, emission of what the material
answers: exact, and how the other two are checked.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit import jsonvalues
from btfkit.btf import RGB
from btfkit.conventions import LOWEST_COSINE
from btfkit.errors import FormatError
from btfkit.export import osl
from btfkit.export.baked import Baked, bake, lost
from btfkit.export.maps import pictures
from btfkit.export.numbers import literal
from btfkit.export.sections import filled, sections, whole_text
from btfkit.fitting.analytic import slope_of
from btfkit.io import images
from btfkit.materials.base import Material
from btfkit.materials.evaluation import texel_centres
from btfkit.materials.lobes.sampling import seen_at
from btfkit.native.lobe import Start, shaded
from btfkit.program import Program
from btfkit.relief.stack import sampled

# A Python that has bpy, where it is not this one.
PYTHON = "BTFKIT_BLENDER_PYTHON"
_MAPS = ("base_color", "packed", "normal")


def write(material: Material, program: Program, folder: Path) -> None:
    """Textures, `view.osl`, `exact.osl`, `make_blend.py` and `check.py`."""
    written = osl.written(program)
    baked = bake(material)
    textures = folder / "textures"
    textures.mkdir()
    shown = pictures(baked)
    base = {name: shown[name] for name in ("base_color", "normal")}
    base["packed"] = np.concatenate(
        [shown[name] for name in ("metalness", "specular_weight", "roughness")], axis=2
    )
    maps = {f"map_{name}": base[name] for name in _MAPS}
    for name, values in {**written.textures, **maps}.items():
        images.write_exr(textures / f"{name}.exr", np.ascontiguousarray(values, np.float32), RGB)
    displaced = None if baked.relief is None else _displaced(baked)
    for name, values in {**shown, **(displaced or {})}.items():
        channels = RGB if values.shape[2] == 3 else ("Y",)
        images.write_exr(textures / f"{name}.exr", values, channels)
    h, w = material.header.grid
    _write_shaders(written, program, folder, size=(h, w))
    loss = dict(baked.loss)
    loss["view_dependent"] = lost(
        material, lambda light, view: _viewed(material, baked, light, view)
    )
    said = {
        "textures": [*written.textures],
        "maps": [*maps],
        "single": sorted(shown),
        "displaced": sorted(displaced or {}),
        "aspect": material.header.aspect,
        "tile_m": 1.0 if material.header.texel_mm is None else w * material.header.texel_mm / 1000,
        "texels": [w, h],
        "wrap": material.header.wrap,
        "licence": material.header.licence,
        "loss": loss,
        "lost": "a Cycles shader cannot be a function of the light: `view_dependent` has what maps "
        "have where the view ray ends, `normal_map` and `displaced` one GGX lobe a texel",
    }
    (folder / "material.json").write_text(json.dumps(jsonvalues.plain(said), indent=1) + "\n")
    for name in ("make_blend", "check"):
        (folder / f"{name}.py").write_text(whole_text(f"{name}.py.txt"))


def build(folder: Path) -> bool:
    """Build the .blend of a finished folder where there is a bpy; whether there is one.

    In a process of its own: bpy takes over how an interpreter ends.

    Raises:
        FormatError: it is there, and the program did not end well.
    """
    python = os.environ.get(PYTHON, sys.executable)
    known = subprocess.run(
        [python, "-c", "import importlib.util as u, sys; sys.exit(u.find_spec('bpy') is None)"],
        check=False, capture_output=True,
    )  # fmt: skip
    if known.returncode:
        return False
    done = subprocess.run(
        [python, folder / "make_blend.py"], check=False, capture_output=True, text=True
    )
    if done.returncode or not (folder / "material.blend").is_file():
        last = ((done.stderr or done.stdout).strip().splitlines() or ["no message"])[-1]
        raise FormatError(folder / "make_blend.py", f"bpy did not build the .blend: {last}")
    return True


def _displaced(baked: Baked) -> dict[str, NDArray[np.float32]]:
    """The maps that go with displacement, whose normals are those of the heights."""
    assert baked.relief is not None
    relief = baked.relief
    other = Baked(
        relief.albedo, relief.specular, relief.roughness, relief.normals(), None, None, None, {}
    )
    found = pictures(other)
    return {f"displaced_{n}": found[n] for n in found if n not in ("albedo", "specular", "normal")}


def _write_shaders(
    written: osl.Written, program: Program, folder: Path, *, size: tuple[int, int]
) -> None:
    parts = sections("material.osl.txt")
    values: dict[str, Any] = {
        "parameters": osl.parameters(written), "given": ", ".join(written.textures),
        "maps": "".join(f'  string map_{name} = "map_{name}.exr",\n' for name in _MAPS),
        "aspect": literal(program.aspect), "lowest": literal(LOWEST_COSINE),
        "h": size[0], "w": size[1],
    }  # fmt: skip
    for name in ("exact.osl", "view.osl"):
        (folder / name).write_text(written.text + filled(parts[name], **values))


def _viewed(material: Material, baked: Baked, light: Any, view: Any) -> NDArray[np.float32]:
    """What (b) shows under a distant light: maps where view rays end, shaded without shadows."""
    h, w = material.header.grid
    uv = texel_centres(h, w).reshape(-1, 2)
    at = seen_at(material, uv, np.tile(np.asarray(view, np.float32), (len(uv), 1)))
    wrap = material.header.wrap == "wrap"
    inside = at - np.floor(at) if wrap else np.clip(at, 0, 1)
    row, col = inside[:, 1] * h - 0.5, inside[:, 0] * w - 0.5

    def here(values: Any) -> Any:
        return sampled(values, row, col, wrap=wrap)

    lobes = Start(
        slope_of(here(baked.normal)), here(baked.alpha), here(baked.albedo), here(baked.specular)
    )
    found = shaded(lobes, np.asarray(light, np.float32)[None], np.asarray(view, np.float32)[None])
    return found[:, 0].reshape(h, w, 3)
