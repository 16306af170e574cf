"""A material baked into maps: what programs without its networks shade, and what that loses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit import directions
from btfkit.errors import FitError
from btfkit.fitting.analytic import fit_maps
from btfkit.fitting.heightfield.parallax import heights_of
from btfkit.fitting.heightfield.readout import answered_btf
from btfkit.materials.base import Material
from btfkit.materials.evaluation import texel_centres
from btfkit.metrics import psnr
from btfkit.relief.relief import Relief
from btfkit.relief.stack import spread
from btfkit.relief.trace import answer
from btfkit.render.studio import visible

Array = NDArray[np.float32]
_LIGHTS, _VIEWS = 24, 10
# Pairs that no map was fitted to, drawn at random above 75 degrees.
_HELD_OUT, _LOWEST = 24, 0.26
# F0 of a dielectric of index 1.5: what the parameters of shaders count in.
PLASTIC = 0.04


@final
@dataclass(frozen=True, eq=False)
class Baked:
    """Maps of one tile, linear RGB.

    Attributes:
        albedo: (h, w, 3) diffuse reflectance. specular: (h, w, 3) F0. Both 0..1.
        alpha: (h, w) of GGX; shaders take its root for roughness.
        normal: (h, w, 3) unit, x right, y up.
        height: (h, w) tile widths, or None where the material has none.
        opacity: (h, w) seen from above, or None where it is opaque throughout.
        relief: with normals of its heights instead: what is displaced; None without heights.
        loss: of re-rendering the maps, by how they are shown; see `lost`.
    """

    albedo: Array
    specular: Array
    alpha: Array
    normal: Array
    height: Array | None
    opacity: Array | None
    relief: Relief | None
    loss: dict[str, Any]


def bake(material: Material) -> Baked:
    """Maps fitted to a material's own answers: Lambert under one GGX lobe a texel.

    Where it has heights, each view sees a texel where they put it, and what they hide is left
    out. Other channels than RGB are made RGB.
    """
    table = directions.bonn81().astype(np.float32)
    lights, views = table[spread(table, _LIGHTS)], table[spread(table[:37], _VIEWS)]
    btf = answered_btf(material, lights, views)
    try:
        height = heights_of(material) / np.float32(material.header.grid[1])
    except FitError:
        height = None
    maps = fit_maps(btf, heights=height)
    to = visible(material.header.channels)
    opacity = _opacity(material)
    relief = None
    if height is not None:
        bare = _relief(height, material.header.wrap)
        shaped = fit_maps(btf, heights=height, normals=bare.normals())
        relief = Relief(
            height=height, albedo=np.clip(shaped.albedo @ to, 0, 1),
            specular=np.clip(shaped.specular @ to, 0, 1), roughness=shaped.roughness,
            opacity=opacity, texel_mm=material.header.texel_mm, wrap=material.header.wrap,
        )  # fmt: skip
    found = Baked(
        np.clip(maps.albedo @ to, 0, 1), np.clip(maps.specular @ to, 0, 1), maps.roughness,
        maps.normal, height, opacity, relief, {},
    )  # fmt: skip

    def shaded(light: Array, view: Array) -> Array:
        return np.asarray(maps.shaded(light[None], view[None])[:, :, 0] @ to)

    found.loss["normal_map"] = lost(material, shaded)
    if relief is not None:
        uv = texel_centres(*relief.size)
        found.loss["displaced"] = lost(
            material, lambda light, view: answer(relief, uv, light, view, samples=4).reflectance
        )
    return found


def lost(material: Material, shown: Any) -> dict[str, float]:
    """How far pictures of one tile, shown (light, view) -> (h, w, 3), are from the material's.

    Over random pairs that nothing was fitted to, down to 75 degrees: `psnr` in dB, linear, of peak
    1; `mae`, and `relative` of the mean answer.
    """
    rng = np.random.default_rng(1)
    uv, to = texel_centres(*material.header.grid), visible(material.header.channels)
    square, off, bright = [], [], []
    for _ in range(_HELD_OUT):
        light, view = _drawn(rng), _drawn(rng)
        wanted = material.evaluate(uv, light, view).reflectance @ to
        error = np.asarray(shown(light, view), float) - wanted
        square.append(np.square(error).mean())
        off.append(np.abs(error).mean())
        bright.append(wanted.mean())
    return {
        "psnr": float(psnr(float(np.mean(square)))),
        "mae": float(np.mean(off)),
        "relative": float(np.mean(off) / max(np.mean(bright), 1e-9)),
        "pairs": _HELD_OUT,
    }


def metalness(albedo: Array, specular: Array) -> tuple[Array, Array, Array]:
    """Base colour (h, w, 3), metalness and weight of the specular lobe (h, w) of shaders.

    Their diffuse part is base x (1 - m), their F0 m x base + 0.04 x weight x (1 - m): the pair
    that gives a diffuse part and a mean F0.
    """
    d, f = albedo.mean(axis=2).astype(float), specular.mean(axis=2).astype(float)
    total = d + f
    # 0.04 x^2 - (d + f) x + d = 0 of x = 1 - m, written so that a black albedo loses no digits.
    root = np.sqrt(np.maximum(total**2 - 4 * PLASTIC * d, 0))
    rest = np.where(f > PLASTIC, 2 * d / np.maximum(total + root, 1e-9), 1)
    rest = np.clip(rest, 0, 1)
    weight = np.where(f > PLASTIC, 1, f / PLASTIC)
    base = albedo + (specular - PLASTIC * (rest * weight)[..., None]) * (f > PLASTIC)[..., None]
    parts = np.clip(base, 0, 1), 1 - rest, np.clip(weight, 0, 1)
    return tuple(part.astype(np.float32) for part in parts)  # type: ignore[return-value]


def _opacity(material: Material) -> Array | None:
    uv = texel_centres(*material.header.grid)
    found = material.evaluate(uv, [0, 0, 1], [0, 0, 1]).opacity
    return None if (found >= 0.999).all() else found.astype(np.float32)


def _relief(height: Array, wrap: Any) -> Relief:
    h, w = height.shape
    ones = np.ones((h, w, 3), np.float32)
    return Relief(height, ones, 0 * ones, ones[..., 0], wrap=wrap)


def _drawn(rng: np.random.Generator) -> Array:
    z, turn = rng.uniform(_LOWEST, 1), 2 * np.pi * rng.random()
    radius = np.sqrt(1 - z * z)
    return np.array([radius * np.cos(turn), radius * np.sin(turn), z], np.float32)
