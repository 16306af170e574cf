"""A program as names and arrays: what stands in a JSON, and what beside it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit.program import Heights, Program, Texture

Array = NDArray[Any]


def named(program: Program) -> tuple[dict[str, Any], dict[str, Array]]:
    """The program in JSON types with names for arrays, and the arrays by these names.

    A name is the way to the array: `layers.0.weight`, `textures.1.levels.2`. What a program has
    not is left out. Arrays are float16 where that loses nothing, else float32.
    """
    arrays: dict[str, Array] = {}
    return _named(program, "", arrays), arrays


def narrowed(array: Array) -> Array:
    """The array as float16 where every number stays what it is, else as float32."""
    wide = np.asarray(array, np.float32)
    with np.errstate(over="ignore"):
        half = wide.astype(np.float16)
    return half if np.array_equal(half.astype(np.float32), wide) else wide


def textures(program: Program) -> Iterator[Texture]:
    """Every texture that features or numbers are read from, heights left out."""
    yield from program.textures
    if program.scaling:
        yield program.scaling
    yield from (part.texture for part in program.networks)
    yield from holes(program)


def holes(program: Program) -> list[Texture]:
    """The opacity of heights as a texture; none where they have none."""
    found = program.depth
    if not isinstance(found, Heights) or found.opacity is None:
        return []
    return [Texture("opacity", (found.opacity[..., None],))]


def _named(value: Any, name: str, arrays: dict[str, Array]) -> Any:
    if isinstance(value, np.ndarray):
        arrays[name] = narrowed(value)
        return name
    if isinstance(value, tuple):
        return [_named(item, _joined(name, k), arrays) for k, item in enumerate(value)]
    if hasattr(value, "__dataclass_fields__"):
        fields = {field: getattr(value, field) for field in value.__dataclass_fields__}
        return {
            field: _named(item, _joined(name, field), arrays)
            for field, item in fields.items()
            if item is not None
        }
    return value


def _joined(name: str, part: object) -> str:
    return f"{name}.{part}" if name else str(part)
