"""Relief files: EXR with heights, normals and reflectance maps as named channels.

    Z  N.X N.Y N.Z  confidence  albedo.R/G/B  specular.R/G/B
    roughness  roughness_across  tangent  opacity

Attributes, each behind "btfkit:": unit ("tile", "texel", "mm"), texel_mm, offset, wrap, provenance.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from btfkit.errors import FormatError
from btfkit.files import whole
from btfkit.io import images
from btfkit.relief.relief import Relief

_PREFIX = "btfkit:"
UNITS = ("tile", "texel", "mm")
_SINGLE = ("confidence", "roughness", "roughness_across", "tangent", "opacity")
# What a relief from elsewhere is taken for where its file does not say.
_GREY, _GLOSS, _ROUGH = 0.5, 0.0, 0.5


def read(path: Path) -> Relief:
    """A relief from an EXR; maps that are missing are a grey Lambert surface.

    Raises:
        FileNotFoundError: there is no such file.
        FormatError: damaged, without Z, or values that no relief has.
    """
    values, channels, attributes = images.read_exr(os.fspath(path), Path(path).read_bytes())
    maps = {name: values[..., index] for index, name in enumerate(channels)}
    if "Z" not in maps:
        raise FormatError(path, f"no channel Z; it has {', '.join(channels)}")
    h, w = maps["Z"].shape
    unit = str(attributes.get(_PREFIX + "unit", "texel"))
    if unit not in UNITS:
        raise FormatError(path, f"unit {unit!r}; expected {', '.join(UNITS)}")
    try:
        edge = attributes.get(_PREFIX + "texel_mm")
        height = maps["Z"] / np.float32(_tile_width(unit, w, None if edge is None else float(edge)))
        provenance = json.loads(attributes.get(_PREFIX + "provenance", "{}"))
        texel_mm = attributes.get(_PREFIX + "texel_mm")
        return Relief(
            height=height,
            albedo=_coloured(maps, "albedo", _GREY, (h, w)),
            specular=_coloured(maps, "specular", _GLOSS, (h, w)),
            texel_mm=None if texel_mm is None else float(texel_mm),
            wrap=attributes.get(_PREFIX + "wrap", "clamp"),
            name=Path(path).stem,
            provenance={"source": os.fspath(path), **provenance},
            roughness=maps.get("roughness", np.full((h, w), _ROUGH, np.float32)),
            roughness_across=maps.get("roughness_across"),
            tangent=maps.get("tangent"),
            opacity=maps.get("opacity"),
            confidence=maps.get("confidence"),
        )
    except (TypeError, ValueError) as error:
        raise FormatError(path, str(error)) from error


def write(
    relief: Relief,
    path: str | os.PathLike[str],
    *,
    unit: str = "tile",
    offset: float = 0.0,
    force: bool = False,
) -> None:
    """Write a relief as a float32 EXR.

    Args:
        relief: what to write, of three channels.
        path: `*.exr`.
        unit: of Z in the file: "tile" widths, "texel", or "mm" where the scale is known.
        offset: how far the plane was moved, in the same unit; recorded.
        force: whether an existing file is replaced.

    Raises:
        ValueError: not three channels, or mm without an edge of a texel.
        FileExistsError: `path` exists and `force` is False.
    """
    if len(relief.channels) != 3:
        raise ValueError(f"relief files hold RGB; the relief has {relief.channels}")
    scale = _tile_width(unit, relief.size[1], relief.texel_mm)
    planes: dict[str, Any] = {"Z": relief.height * np.float32(scale)}
    normals = relief.normals()
    planes |= {f"N.{axis}": normals[..., index] for index, axis in enumerate("XYZ")}
    for name in ("albedo", "specular"):
        value = getattr(relief, name)
        planes |= {f"{name}.{c}": value[..., index] for index, c in enumerate("RGB")}
    planes |= {n: v for n in _SINGLE if (v := getattr(relief, n)) is not None}
    attributes: dict[str, Any] = {
        _PREFIX + "unit": unit,
        _PREFIX + "offset": float(offset),
        _PREFIX + "wrap": relief.wrap,
        _PREFIX + "provenance": json.dumps(dict(relief.provenance)),
    }
    if relief.texel_mm is not None:
        attributes[_PREFIX + "texel_mm"] = float(relief.texel_mm)
    pixels = np.stack(list(planes.values()), axis=-1).astype(np.float32)
    with whole(path, force=force) as partial:
        images.write_exr(partial, pixels, tuple(planes), attributes)


def _tile_width(unit: str, w: int, texel_mm: float | None) -> float:
    """Units to a tile width of w texels."""
    if unit == "mm" and not texel_mm:
        raise ValueError("heights in mm need texel_mm, which is not known here")
    return {"tile": 1.0, "texel": float(w), "mm": w * (texel_mm or 1.0)}[unit]


def _coloured(
    maps: dict[str, np.ndarray[Any, Any]], name: str, default: float, size: tuple[int, int]
) -> np.ndarray[Any, Any]:
    planes = [maps.get(f"{name}.{c}", np.full(size, default, np.float32)) for c in "RGB"]
    return np.stack(planes, axis=-1)
