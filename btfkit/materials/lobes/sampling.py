"""Lights drawn for a material, and how densely: what `Material.sample` and `Material.pdf` do."""

from __future__ import annotations

import math
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from btfkit import queries
from btfkit.materials.lobes import density
from btfkit.materials.lobes.fit import fit
from btfkit.materials.lobes.table import LobeTable
from btfkit.native.neural import plain

if TYPE_CHECKING:
    from btfkit.materials.base import Material

Floats = NDArray[Any]
_UP = np.array([0.0, 0.0, 1.0])


def derived(material: Material) -> LobeTable:
    """Lobes fitted to the material's answers."""

    def answers(uv: Floats, light: Floats, view: Floats) -> Floats:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            rgb = material.evaluate(uv, light, view).reflectance
        grey = np.nan_to_num(rgb, posinf=0, neginf=0).astype(float).mean(axis=1)
        return np.maximum(grey, 0) * (light[:, 2] > 0)

    header = material.header
    return fit(
        lambda uv, view: seen_at(material, uv, view), answers, grid=header.grid, wrap=header.wrap
    )


def sample(
    material: Material, uv: ArrayLike, view: ArrayLike, random: Any, footprint: ArrayLike
) -> tuple[Floats, Floats]:
    """As `Material.sample` says."""
    leading = [np.shape(uv)[:-1], np.shape(view)[:-1], np.shape(footprint)]
    if isinstance(random, np.random.Generator):
        random = random.random((*np.broadcast_shapes(*leading), 3))
    numbers = _checked(np.asarray(random, float))
    parts, shape = _flat(uv, view, footprint, numbers.shape[:-1])
    place, away, wide = parts
    numbers = np.broadcast_to(numbers, (*shape, numbers.shape[-1]))
    numbers = numbers.reshape(len(place), -1)
    light, found = np.tile(_UP, (len(place), 1)), np.zeros(len(place))
    good = _answered(place, away, wide) & np.isfinite(numbers).all(axis=1)
    if good.any():
        lobe = _lobe(material, place[good], away[good], wide[good])
        light[good] = density.draw(lobe, away[good], numbers[good])
        found[good] = density.pdf(lobe, light[good], away[good])
    return light.reshape(*shape, 3), found.reshape(shape)


def pdf(
    material: Material, uv: ArrayLike, light: ArrayLike, view: ArrayLike, footprint: ArrayLike
) -> Floats:
    """As `Material.pdf` says."""
    toward = np.asarray(light, float)
    parts, shape = _flat(uv, view, footprint, toward.shape[:-1])
    place, away, wide = parts
    toward = _unit(np.broadcast_to(toward, (*shape, 3)).reshape(-1, 3))
    found = np.zeros(len(place))
    good = _answered(place, away, wide) & np.isfinite(toward).all(axis=1)
    if good.any():
        lobe = _lobe(material, place[good], away[good], wide[good])
        found[good] = density.pdf(lobe, toward[good], away[good])
    return found.reshape(shape)


def seen_at(material: Material, uv: Floats, view: Floats) -> Floats:
    """Where on the tile (b, 2) view rays that enter at uv (b, 2) end, on the plane."""
    where = uv.astype(np.float32)
    depth = material.ray_depths(where, view.astype(np.float32))
    if depth is None:
        return uv
    return uv + depth[:, None] * plain.step(view, material.header.aspect)


def _lobe(material: Material, uv: Floats, view: Floats, footprint: Floats) -> density.Lobe:
    inside = uv - np.floor(uv) if material.header.wrap == "wrap" else np.clip(uv, 0, 1)
    return material.lobes.at(seen_at(material, inside, view), footprint)


def _checked(numbers: Floats) -> Floats:
    if numbers.ndim < 1 or numbers.shape[-1] not in (2, 3):
        raise ValueError(
            f"random has shape {numbers.shape}; expected (..., 2) or (..., 3) numbers from 0 to 1, "
            "or a numpy Generator"
        )
    if numbers.size and not (np.nanmin(numbers) >= 0 and np.nanmax(numbers) <= 1):
        low, high = np.nanmin(numbers), np.nanmax(numbers)
        raise ValueError(f"random ranges {low:g}..{high:g}; expected 0..1")
    return numbers


def _flat(
    uv: ArrayLike, view: ArrayLike, footprint: ArrayLike, more: tuple[int, ...]
) -> tuple[tuple[Floats, Floats, Floats], tuple[int, ...]]:
    """uv (b, 2), unit view (b, 3) and footprint (b,), and the shape that they unfold to."""
    up = np.broadcast_to(_UP, (*more, 3))
    query, shape = queries.broadcast(uv, up, view, footprint)
    count = math.prod(shape)
    parts = query.uv.reshape(count, 2), _unit(query.view.astype(float)), query.footprint
    return parts, shape


def _unit(direction: Floats) -> Floats:
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        found: Floats = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return found


def _answered(uv: Floats, view: Floats, footprint: Floats) -> NDArray[np.bool_]:
    """(b,) what `evaluate` answers, too."""
    good = np.isfinite(uv).all(axis=1) & np.isfinite(view).all(axis=1) & ~np.isnan(footprint)
    with np.errstate(invalid="ignore"):
        return good & (view[:, 2] > 0)
