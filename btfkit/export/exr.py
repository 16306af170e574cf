"""`exr`: textures as EXR mips with a JSON of layers, and a reader in numpy.

The layout is the one that published samples of neural appearance models read: `model.json` with
`layers` of `num_inputs`, `num_outputs`, `weights` and `biases`, and `latents.mipN.exr` for level
N of the latent texture.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit.export.arrays import narrowed
from btfkit.export.npz import reader
from btfkit.io.images.encoding import write_exr
from btfkit.materials.base import Material
from btfkit.program import (
    Cover,
    Dense,
    DepthNetwork,
    Heights,
    OffsetNetwork,
    Program,
    Texture,
)

VERSION = 1
_LEFT = ("textures", "layers", "scaling", "depth", "cover", "heads")


def write(material: Material, program: Program, folder: Path) -> None:
    """`model.json`, an EXR for each level of each texture, and `evaluate.py`."""
    found: dict[str, Any] = {"version": VERSION, "model": material.model}
    found |= {n: getattr(program, n) for n in program.__dataclass_fields__ if n not in _LEFT}
    found["heads"] = [{"kind": head.kind, "count": head.count} for head in program.heads]
    found["textures"] = [
        _texture(texture, "latents" if k == 0 else f"latents{k + 1}", folder)
        for k, texture in enumerate(program.textures)
    ]
    if program.scaling:
        found["scaling"] = _texture(program.scaling, "scaling", folder)
    if program.depth is not None:
        found["depth"] = _depth(program.depth, folder)
    if program.cover is not None:
        kind = program.cover.kind
        found["cover"] = {"kind": kind, **_network(program.cover, "cover", folder)}
    found["layers"] = [layer_described(layer) for layer in program.layers]
    (folder / "model.json").write_text(json.dumps(found, indent=1) + "\n")
    (folder / "evaluate.py").write_text(reader(program, material.model, arrays="exr"))


def layer_described(layer: Dense) -> dict[str, Any]:
    """A layer in JSON types; weights row by row, a row for each output."""
    found: dict[str, Any] = {
        "num_inputs": layer.weight.shape[1],
        "num_outputs": layer.weight.shape[0],
        "activation": layer.activation,
        "omega": layer.omega,
        "residual": layer.residual,
        "weights": _numbers(layer.weight),
        "biases": _numbers(layer.bias),
    }
    if layer.gain is not None and layer.centre is not None:
        found |= {"gains": _numbers(layer.gain), "centres": _numbers(layer.centre)}
    return found


def _depth(depth: Heights | DepthNetwork | OffsetNetwork, folder: Path) -> dict[str, Any]:
    if isinstance(depth, Heights):
        (name,) = _mips("heights", (depth.heights[..., None],), folder)
        found: dict[str, Any] = {"heights": name, "scale": depth.scale, "curved": depth.curved}
        if depth.curved:
            found["looks"] = depth.looks
        if depth.opacity is not None:
            (found["opacity"],) = _mips("opacity", (depth.opacity[..., None],), folder)
        return found
    found = _network(depth, "offset", folder)
    if isinstance(depth, DepthNetwork):
        found["scale"] = depth.scale
    return found


def _network(part: DepthNetwork | OffsetNetwork | Cover, name: str, folder: Path) -> dict[str, Any]:
    """A network with a texture of its own, which becomes the files of this name."""
    return {
        "texture": _texture(part.texture, name, folder),
        "inputs": list(part.inputs),
        "layers": [layer_described(layer) for layer in part.layers],
    }


def _texture(texture: Texture, name: str, folder: Path) -> dict[str, Any]:
    return {
        "name": texture.name,
        "view": texture.view,
        "light": texture.light,
        "shift": texture.shift,
        "levels": _mips(name, texture.levels, folder),
    }


def _mips(name: str, levels: tuple[NDArray[Any], ...], folder: Path) -> list[str]:
    """Names of the files of a texture's levels, finest first."""
    found = []
    for n, level in enumerate(levels):
        file = f"{name}.mip{n}.exr"
        # Programs sort channels by name.
        channels = [f"{name}.{k:03d}" for k in range(level.shape[-1])]
        write_exr(folder / file, narrowed(level), channels)
        found.append(file)
    return found


def _numbers(values: NDArray[Any]) -> list[float]:
    """Decimal numbers that are read as the same float32, however numpy is set to print."""
    flat = np.asarray(values, np.float32).reshape(-1)
    return [float(np.format_float_scientific(value, unique=True)) for value in flat]
