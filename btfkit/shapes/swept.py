"""Closed irregular surfaces as meshes with tiles on them, and the same displaced by heights.

They are what outlines are compared on where no shape in closed form will do: the displaced mesh is
the truth of a material that lies under the smooth one.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from btfkit.shapes.triangles import Triangles

Floats = NDArray[np.floating]
# u and v (...) from 0 to 1 -> points (..., 3), counter-clockwise in u, v as seen from outside.
Place = Callable[[Floats, Floats], Floats]
_STEP = 1e-4


def dented(u: Floats, v: Floats) -> Floats:
    """A ring that is no circle, of a tube that is thick in three places; u runs along it."""
    around, across = 2 * np.pi * u, 2 * np.pi * v
    ring = 1 + 0.15 * np.cos(2 * around)
    tube = 0.34 * (1 + 0.2 * np.cos(3 * around) + 0.1 * np.sin(across + around))
    away = ring + tube * np.cos(across)
    lift = tube * np.sin(across) + 0.15 * np.sin(2 * around)
    return np.stack([away * np.cos(around), away * np.sin(around), lift], axis=-1)


def knot(u: Floats, v: Floats) -> Floats:
    """A trefoil knot of a tube that swells and narrows; u runs along it."""
    t = 2 * np.pi * u

    def curve(t: Floats) -> Floats:
        return np.stack(
            [np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)], axis=-1
        )

    ahead = _unit(curve(t + _STEP) - curve(t - _STEP))
    bend = curve(t + _STEP) - 2 * curve(t) + curve(t - _STEP)
    side = _unit(bend - ahead * (bend * ahead).sum(axis=-1, keepdims=True))
    up = np.cross(ahead, side)
    radius = 0.5 * (1 + 0.2 * np.sin(3 * t))[..., None]
    across = (2 * np.pi * v)[..., None]
    return curve(t) + radius * (np.cos(across) * side + np.sin(across) * up)


def pear(u: Floats, v: Floats) -> Floats:
    """A ball with a waist and a bulge, its poles in y; u runs around it."""
    around, polar = 2 * np.pi * u, np.pi * v
    radius = 1 + 0.25 * np.cos(polar) ** 2 - 0.2 * np.cos(polar) * np.sin(polar)
    radius = radius + 0.12 * np.sin(polar) ** 2 * np.cos(3 * around)
    flat = radius * np.sin(polar)
    return np.stack([flat * np.sin(around), radius * np.cos(polar), flat * np.cos(around)], axis=-1)


CLOSED: dict[str, Place] = {"dented": dented, "knot": knot, "pear": pear}


def mesh(
    place: Place,
    *,
    cells: tuple[int, int],
    tiles: tuple[int, int],
    heights: Callable[[Floats], Floats] | None = None,
) -> Triangles:
    """A surface as triangles, with texture coordinates in tiles as mesh files have them.

    Args:
        place: of the surface. cells: steps in u and v. tiles: whole ones, in u and in v.
        heights: displaces along the normals: uv (..., 2), tiles, -> (...) in the lengths of
            `place`. Normals stay those of the surface that is displaced.
    """
    u, v = np.meshgrid(*(np.arange(n + 1) / n for n in cells), indexing="ij")
    normal = _normals(place, u, v)
    at = place(u, v)
    uv = np.stack([u * tiles[0], v * tiles[1]], axis=-1)
    if heights is not None:
        at = at + heights(uv)[..., None] * normal

    def corners(values: Floats) -> Floats:
        a, b, c, d = values[:-1, :-1], values[1:, :-1], values[1:, 1:], values[:-1, 1:]
        pairs = np.stack([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)], axis=2)
        return pairs.reshape(-1, 3, values.shape[-1])

    corner = corners(at)
    area = np.linalg.norm(
        np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1
    )
    # At a pole one of the two triangles of a cell is none.
    whole = area > 1e-12 * area.max()
    up = uv * [1, -1] + [0, 1]
    return Triangles(corner[whole], corners(up)[whole], corners(normal)[whole])


def _normals(place: Place, u: Floats, v: Floats) -> Floats:
    """Outward unit normals; where u has no length, at poles, those just beside."""
    inner = np.clip(v, _STEP, 1 - _STEP) if _has_poles(place) else v
    along = place(u + _STEP, inner) - place(u - _STEP, inner)
    across = place(u, inner + _STEP / 2) - place(u, inner - _STEP / 2)
    normal = _unit(np.cross(along, across))
    # Of a closed surface the mean of point . normal is positive where normals point outwards.
    weight = np.linalg.norm(np.cross(along, across), axis=-1)
    sign = np.sign(((place(u, inner) * normal).sum(axis=-1) * weight).sum())
    return normal * sign


def _has_poles(place: Place) -> bool:
    ends = np.linspace(0, 1, 5)
    return bool(np.ptp(place(ends, 0 * ends), axis=0).max() < 1e-9)


def _unit(vector: Floats) -> Floats:
    return vector / np.maximum(np.linalg.norm(vector, axis=-1, keepdims=True), 1e-300)
