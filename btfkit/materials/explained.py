"""What a material is made of, in numbers for people: textures, layers, heights, work a query."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from btfkit.materials.base import Material
from btfkit.program import Cover, DepthNetwork, Heights, OffsetNetwork, Program, Texture

# Queries whose time is measured.
_TIMED = 1 << 15


def explained(material: Material) -> dict[str, Any]:
    """Parts of a material and their sizes.

    Returns:
        parameters, bytes; can: what it answers beside colour; and of models with a program:
        textures (name, size, channels, levels, texels), networks (widths by name), multiply_adds
        a query, heights (lowest, highest, standard deviation; tile widths, mm where known).
    """
    arrays = {k: v for k, v in material.weights.items() if isinstance(v, np.ndarray)}
    found: dict[str, Any] = {
        "parameters": sum(array.size for array in arrays.values()),
        "bytes": sum(array.nbytes for array in arrays.values()),
        "can": [
            name
            for name, has in (
                ("levels of detail", material.has_levels),
                ("curvature and opacity", material.has_curvature),
                ("light from below the horizon", material.full_sphere),
            )
            if has
        ],
    }
    program = program_of(material)
    if program is None:
        return found
    found["textures"] = [
        {
            "name": texture.name,
            "size": list(texture.levels[0].shape[1::-1]),
            "channels": texture.levels[0].shape[2],
            "levels": len(texture.levels),
            "texels": sum(level.shape[0] * level.shape[1] for level in texture.levels),
        }
        for texture in textures_of(program)
    ]
    networks = {"decoder": program.layers}
    if isinstance(program.depth, (DepthNetwork, OffsetNetwork)):
        networks["depth" if isinstance(program.depth, DepthNetwork) else "offset"] = (
            program.depth.layers
        )
    if isinstance(program.cover, Cover):
        networks["cover"] = program.cover.layers
    found["networks"] = {
        name: [layers[0].weight.shape[1], *(layer.weight.shape[0] for layer in layers)]
        for name, layers in networks.items()
        if layers
    }
    found["multiply_adds"] = sum(
        layer.weight.size for layers in networks.values() for layer in layers
    )
    if isinstance(program.depth, Heights):
        found["heights"] = heights_of(material, program)
    return found


def program_of(material: Material) -> Program | None:
    """The program of a material, None of one that blends measurements."""
    try:
        return material.program()
    except TypeError:
        return None


def textures_of(program: Program) -> tuple[Texture, ...]:
    """Every texture of features: the decoder's, and those of depth, offset and cover."""
    more = []
    if isinstance(program.depth, (DepthNetwork, OffsetNetwork)):
        more.append(program.depth.texture)
    if isinstance(program.cover, Cover):
        more.append(program.cover.texture)
    return (*program.textures, *more)


def heights_of(material: Material, program: Program) -> dict[str, Any]:
    """Range of the heights that rays meet: tile widths and, where a texel's edge is known, mm."""
    assert isinstance(program.depth, Heights)
    tiles = program.depth.heights.astype(float) * program.depth.scale
    said = {
        "lowest": float(tiles.min()),
        "highest": float(tiles.max()),
        "deviation": float(tiles.std()),
    }
    found: dict[str, Any] = {"tiles": said}
    if material.header.texel_mm is not None:
        width = material.header.grid[1] * material.header.texel_mm
        found["mm"] = {name: value * width for name, value in said.items()}
    return found


def run_time(material: Material, *, seed: int = 0) -> dict[str, float]:
    """CPU nanoseconds of a query, at random places and directions: the least of three runs.

    Returns:
        single: every query has its own light; shared: sixteen lights a view; detail: footprints
        of 1 to 8 texels.
    """
    rng = np.random.default_rng(seed)

    def ways(*shape: int) -> np.ndarray:
        vectors = rng.normal(size=(*shape, 3))
        vectors[..., 2] = np.abs(vectors[..., 2]) + 0.3
        return (vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)).astype(np.float32)

    uv, view = rng.random((_TIMED, 2)).astype(np.float32), ways(_TIMED)
    blur = np.exp2(rng.uniform(0, 3, _TIMED)).astype(np.float32)
    few = slice(0, _TIMED // 16)
    settings: dict[str, tuple[Any, ...]] = {
        "single": (uv, ways(_TIMED), view),
        "shared": (uv[few], ways(16)[:, None], view[few]),
    }
    if material.has_levels:
        settings["detail"] = (uv, ways(_TIMED), view, blur)
    found = {}
    for name, parts in settings.items():
        spent = []
        for _ in range(3):
            start = time.process_time()
            answered = material.evaluate(*parts).opacity.size
            spent.append((time.process_time() - start) / answered)
        found[name] = 1e9 * min(spent)
    return found
