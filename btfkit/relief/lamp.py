"""Lamps of finite size: what a relief answers to lights over a disk in the sky.

NeuMIP trains on lights that are smoothed so; the quantity stays pi x radiance per unit irradiance
on a surface that faces the lamp's middle.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit import directions
from btfkit.btf import BTF
from btfkit.queries import QuerySet
from btfkit.relief.relief import Relief
from btfkit.relief.trace import answer, traced_btf
from btfkit.textures import Array, Textures

# Directions that stand for the disk, and the fewest rays of each: one ray knows no footprint.
_FEWEST, _MOST, _RAYS = 4, 16, 4
_GOLDEN = math.pi * (3 - math.sqrt(5))


def spread(light: NDArray[np.floating], degrees: float, count: int) -> NDArray[np.float32]:
    """(count, n, 3) directions over the disk of a lamp around each of n lights, evenly.

    Args:
        light: (n, 3) unit vectors to its middle. degrees: its angular diameter.

    Raises:
        ValueError: a diameter that is not within 0 to 90.
    """
    if not 0 <= degrees <= 90:
        raise ValueError(f"a lamp of {degrees:g} degrees; expected a diameter of 0 to 90")
    k = np.arange(count)
    z = 1 - (1 - math.cos(math.radians(degrees / 2))) * (k + 0.5) / count
    around = directions.from_angles(np.arccos(z), k * _GOLDEN)
    middle = directions.normalize(light)
    axis = np.eye(3)[np.abs(middle).argmin(axis=1)]
    x = directions.normalize(np.cross(axis, middle))
    y = np.cross(middle, x)
    found = (
        around[:, None, :1] * x + around[:, None, 1:2] * y + around[:, None, 2:] * middle
    )  # fmt: skip
    return found.astype(np.float32)


def _shares(samples: int) -> tuple[int, int]:
    """How many directions of a lamp, and rays of each: as many in all, and 16 at least."""
    count = min(max(samples // _RAYS, _FEWEST), _MOST)
    return count, max(math.ceil(samples / count), _RAYS)


def lamp_queries(
    queries: QuerySet, relief: Relief, degrees: float, *, samples: int, bounces: int, seed: int
) -> QuerySet:
    """Queries of a relief answered anew under a lamp of `degrees` across."""
    relief = relief if queries.curvature is None else relief.under_surface()[0]
    count, rays = _shares(samples)
    blur = 0.5 if queries.footprint is None else queries.footprint
    bend = 0.0 if queries.curvature is None else queries.curvature
    parts = [
        answer(relief, queries.uv, light, queries.view, blur, bend, samples=rays, bounces=bounces,
               seed=seed + 104729 * k)
        for k, light in enumerate(spread(queries.light, degrees, count))
    ]  # fmt: skip
    opacity = np.mean([part.opacity for part in parts], axis=0)
    whole = np.sum([part.reflectance * part.opacity[:, None] for part in parts], axis=0)
    rgb = whole / np.maximum(count * opacity, 1e-9)[:, None]
    told = {**queries.provenance, "samples": samples, "lamp_degrees": degrees}
    seen = None if queries.opacity is None else opacity
    return replace(queries, rgb=rgb, opacity=seen, provenance=told)


def lamp_btf(
    btf: BTF, relief: Relief, degrees: float, *, samples: int, bounces: int, seed: int
) -> BTF:
    """A BTF traced anew with the same pairs under a lamp of `degrees` across."""
    count, rays = _shares(samples)
    parts = [
        traced_btf(relief, light, btf.view, samples=rays, bounces=bounces, seed=seed + 104729 * k)
        for k, light in enumerate(spread(btf.light, degrees, count))
    ]
    return replace(
        btf,
        textures=_Mean([part.textures for part in parts]),
        provenance={**btf.provenance, "samples": samples, "lamp_degrees": degrees},
        history=(*btf.history, f"under a lamp {degrees:g} degrees across"),
    )


@final
class _Mean(Textures):
    """The mean of lists of textures of one shape."""

    def __init__(self, parts: list[Textures]) -> None:
        self._parts, self.shape = parts, parts[0].shape

    def _read(self, index: int) -> Array:
        return np.asarray(np.mean([part[index] for part in self._parts], axis=0), np.float32)
