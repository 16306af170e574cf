"""`maps`: pictures of albedo, normal, roughness, height and opacity, and a MaterialX file of them.

OpenPBR's roughness is the root of alpha; its normal map is that of OpenGL (y up); heights are in
tile widths. Everything is linear BT.709 in EXR; PNG beside them for programs that read nothing
else: base colour in sRGB, all other numbers as they are.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from btfkit import jsonvalues
from btfkit.btf import RGB
from btfkit.export.baked import Baked, bake, metalness
from btfkit.io import images
from btfkit.materials.base import Material
from btfkit.program import Program

Array = NDArray[np.float32]


def write(material: Material, program: Program, folder: Path) -> None:
    """EXR and PNG of every map, `material.mtlx` and `maps.json`."""
    baked = bake(material)
    shown = pictures(baked)
    for name, values in shown.items():
        channels = RGB if values.shape[2] == 3 else ("Y",)
        images.write_exr(folder / f"{name}.exr", values, channels)
        if name not in ("albedo", "specular", "height"):
            (folder / f"{name}.png").write_bytes(_png(values, encoded=name == "base_color"))
    header = material.header
    h, w = header.grid
    size = None if header.texel_mm is None else (w * header.texel_mm, h * header.texel_mm)
    (folder / "material.mtlx").write_text(materialx(set(shown), size_mm=size, wrap=header.wrap))
    span = None if baked.height is None else float(np.ptp(baked.height))
    said = {
        "maps": {name: _MEANING[name] for name in shown},
        "loss": baked.loss,
        "loss_is": "of re-rendering one tile under random pairs that the maps were not fitted to",
        "height_range_tiles": span,
        "height_range_mm": None if span is None or size is None else span * size[0],
        "colour": "linear BT.709 in EXR; sRGB in base_color.png; other PNG are data",
        "not_carried": "gloss that one GGX lobe is not, light between fibres, change with angle "
        "beyond Fresnel's; shadows and parallax without displacement",
    }
    (folder / "maps.json").write_text(json.dumps(jsonvalues.plain(said), indent=1) + "\n")


_MEANING = {
    "albedo": "diffuse reflectance, fitted",
    "specular": "reflectance of the gloss at normal incidence (F0), fitted",
    "base_color": "of a metalness workflow: albedo and F0 of metals in one",
    "metalness": "share of the surface that is metal",
    "specular_weight": "of the lobe of a dielectric of index 1.5",
    "roughness": "root of GGX's alpha",
    "normal": "(n + 1) / 2, x right, y up (OpenGL)",
    "height": "tile widths, 0 is the plane of uv",
    "opacity": "seen from above",
}


def pictures(baked: Baked) -> dict[str, Array]:
    """Every map (h, w, 1 or 3) by name, as files hold it."""
    base, metal, weight = metalness(baked.albedo, baked.specular)
    found = {
        "albedo": baked.albedo,
        "specular": baked.specular,
        "base_color": base,
        "metalness": metal[..., None],
        "specular_weight": weight[..., None],
        "roughness": np.sqrt(baked.alpha)[..., None],
        "normal": baked.normal / 2 + 0.5,
    }
    if baked.height is not None:
        found["height"] = baked.height[..., None]
    if baked.opacity is not None:
        found["opacity"] = baked.opacity[..., None]
    return {name: np.ascontiguousarray(values, np.float32) for name, values in found.items()}


def materialx(
    maps: set[str],
    *,
    size_mm: tuple[float, float] | None,
    wrap: str,
    folder: str = "",
) -> str:
    """The text of a MaterialX file of an OpenPBR surface.

    Args:
        maps: which there are. size_mm: width and height of the tile, where known.
        wrap: "wrap" or "clamp".
        folder: before the names of the pictures.
    """
    mode = "periodic" if wrap == "wrap" else "clamp"
    kinds = {"base_color": "color3", "normal": "vector3"}
    inputs = {"base_color": "base_color", "metalness": "base_metalness",
              "specular_weight": "specular_weight", "roughness": "specular_roughness",
              "opacity": "geometry_opacity"}  # fmt: skip
    # What a file says of itself stays in JSON, where it is escaped.
    about = "baked by btfkit"
    if size_mm:
        about += f"; one tile is {size_mm[0]:g} mm x {size_mm[1]:g} mm"
    lines = [
        '<?xml version="1.0"?>',
        f'<materialx version="1.39" colorspace="lin_rec709" doc="{about}">',
    ]
    for name in sorted((maps & inputs.keys()) | {"normal"}):
        kind = kinds.get(name, "float")
        space = ' colorspace="lin_rec709"' if name == "base_color" else ""
        lines += [
            f'  <image name="{name}_map" type="{kind}">',
            f'    <input name="file" type="filename" value="{folder}{name}.exr"{space}/>',
            f'    <input name="uaddressmode" type="string" value="{mode}"/>',
            f'    <input name="vaddressmode" type="string" value="{mode}"/>',
            "  </image>",
        ]
    lines += [
        '  <normalmap name="normal_frame" type="vector3">',
        '    <input name="in" type="vector3" nodename="normal_map"/>',
        "  </normalmap>",
    ]
    shared = [
        '    <input name="specular_ior" type="float" value="1.5"/>',
        *(
            f'    <input name="{inputs[name]}" type="{kinds.get(name, "float")}" '
            f'nodename="{name}_map"/>'
            for name in sorted(maps & inputs.keys())
        ),
    ]
    frame = '    <input name="geometry_normal" type="vector3" nodename="normal_frame"/>'
    lines += [*_surface("surface", [*shared, frame]), *_material("material", "surface", [])]
    if "height" in maps:
        # Displaced and with a normal map, slopes would count twice: a surface of its own.
        moved = '    <input name="displacementshader" type="displacementshader" nodename="relief"/>'
        lines += [
            '  <image name="height_map" type="float">',
            f'    <input name="file" type="filename" value="{folder}height.exr"/>',
            f'    <input name="uaddressmode" type="string" value="{mode}"/>',
            f'    <input name="vaddressmode" type="string" value="{mode}"/>',
            "  </image>",
            '  <displacement name="relief" type="displacementshader">',
            '    <input name="displacement" type="float" nodename="height_map"/>',
            # One unit of uv is one unit of the scene, unless it says otherwise.
            '    <input name="scale" type="float" value="1"/>',
            "  </displacement>",
            *_surface("surface_of_relief", shared),
            *_material("displaced", "surface_of_relief", [moved]),
        ]
    return "\n".join([*lines, "</materialx>", ""])


def _surface(name: str, inputs: list[str]) -> list[str]:
    head = f'  <open_pbr_surface name="{name}" type="surfaceshader">'
    return [head, *inputs, "  </open_pbr_surface>"]


def _material(name: str, surface: str, more: list[str]) -> list[str]:
    shader = f'    <input name="surfaceshader" type="surfaceshader" nodename="{surface}"/>'
    head = f'  <surfacematerial name="{name}" type="material">'
    return [head, shader, *more, "  </surfacematerial>"]


def _png(values: Array, *, encoded: bool) -> bytes:
    """8 bits of sRGB, or 16 of the numbers themselves."""
    if encoded:
        return images.encode_png(values)
    return images.encode_png_numbers(values)
