"""Procedural materials as anything the toolkit reads: reliefs, BTFs in any format, queries."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit import directions
from btfkit.btf import BTF
from btfkit.relief import procedural
from btfkit.relief.relief import Relief
from btfkit.relief.trace import traced_btf

# Steeper directions are not measured by any of the rigs whose formats are written.
_STEEPEST_DEG = 75.0


def direction_set(name: str) -> NDArray[np.float32]:
    """(n, 3) directions: "bonn81", "bonn151", or a number of well spread ones up to 75 degrees.

    The spread ones lie on a Fibonacci spiral of equal areas, rounded to whole degrees so that file
    names can hold them, the pole first.

    Raises:
        ValueError: neither a name nor a positive number.
    """
    if name == "bonn81":
        return directions.bonn81().astype(np.float32)
    if name == "bonn151":
        return directions.bonn151().astype(np.float32)
    if not name.isdigit() or not 1 <= int(name) <= 10000:
        raise ValueError(f"directions {name!r}; expected bonn81, bonn151 or a number to 10000")
    count = int(name)
    lowest = np.cos(np.radians(_STEEPEST_DEG))
    z = 1 - (1 - lowest) * np.arange(count) / max(count - 1, 1)
    azimuth = np.arange(count) * 360 * (2 - (1 + 5**0.5) / 2)
    theta = np.rint(np.degrees(np.arccos(z)))
    return directions.from_angles(np.radians(theta), np.radians(np.rint(azimuth % 360))).astype(
        np.float32
    )


def known(provenance: Mapping[str, Any], size: tuple[int, int]) -> Relief | None:
    """The relief of `size` (h, w) that a provenance names: of a traced BTF, or a model of one.

    None where it names none, one of another size, or one that this version cannot make.
    """
    recipe = provenance.get(procedural.RECIPE)
    if isinstance(recipe, Mapping):
        if size != (recipe.get("size"),) * 2:
            return None
        try:
            return procedural.make(
                str(recipe["name"]), size[0], relief_texels=float(recipe["relief_texels"]),
                seed=int(recipe["seed"]), wrap=recipe["wrap"],
            )  # fmt: skip
        except (KeyError, TypeError, ValueError):
            return None
    data = provenance.get("data")
    return known(data, size) if isinstance(data, Mapping) else None


def synth_btf(
    name: str,
    *,
    size: int = 128,
    lights: str = "bonn81",
    views: str = "bonn81",
    relief_texels: float | None = None,
    samples: int = 4,
    bounces: int = 0,
    seed: int = 0,
) -> BTF:
    """A traced BTF of a material of the catalogue; light runs fastest.

    Args:
        name: of the material. size: texels a side.
        lights, views: as `direction_set` takes them.
        relief_texels: height of the structure, texels; None takes its default.
        samples: rays a texel. bounces: interreflections. seed: of all randomness.
    """
    relief = procedural.make(name, size, relief_texels=relief_texels, seed=seed)
    return relief_btf(
        relief, lights=lights, views=views, samples=samples, bounces=bounces, seed=seed
    )


def relief_btf(
    relief: Relief,
    *,
    lights: str = "bonn81",
    views: str = "bonn81",
    samples: int = 4,
    bounces: int = 0,
    seed: int = 0,
) -> BTF:
    """The same of any relief."""
    light_table, view_table = direction_set(lights), direction_set(views)
    light = np.tile(light_table, (len(view_table), 1))
    view = np.repeat(view_table, len(light_table), axis=0)
    return traced_btf(relief, light, view, samples=samples, bounces=bounces, seed=seed)
