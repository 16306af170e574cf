"""Ways of rays through bodies that are no cylinders: what is told of them is where they go."""

from __future__ import annotations

import numpy as np
import pytest
from sbtfs import random_sbtf

from btfkit.native.neural import bent
from btfkit.program import Heights
from btfkit.render.gaze import gaze
from btfkit.shapes.catalogue import shape_of
from btfkit.shapes.closed import NEAR, Meeting, Shape
from btfkit.shapes.mesh import Mesh
from btfkit.shapes.swept import CLOSED, mesh
from btfkit.shapes.torus import Torus

DEPTH = 0.14
HEIGHTS = Heights(np.full((4, 4), np.float32(-DEPTH)), 1.0, curved=True)


def rays(shape: Shape, view: list[float], count: int = 6000):
    """Rays from a far eye that meet the shape, and where."""
    toward = np.array(view) / np.linalg.norm(view)
    side = np.cross(toward, [0.1, 1.0, 0.2])
    side /= np.linalg.norm(side)
    rng = np.random.default_rng(1)
    place = rng.uniform(-1, 1, (count, 2)) @ np.stack([side, np.cross(toward, side)])
    origin, direction = place + 8 * toward, np.tile(-toward, (count, 1))
    met = shape.meet(origin, direction, np.full(count, -np.inf))
    hit = np.isfinite(met.distance)
    return origin[hit], direction[hit], Meeting(met.distance[hit], met.part[hit])


def strayed(shape: Shape, view: list[float], *, drifts: bool) -> tuple[np.ndarray, np.ndarray]:
    """How far, tiles, marches are off the places (uv, height) of the very rays, in rows x 7."""
    origin, direction, met = rays(shape, view)
    surface = shape.surface(origin, direction, met)
    material = random_sbtf(np.full((8, 8), np.float32(-DEPTH)))
    seen = gaze(material, shape, surface, -direction, np.zeros((2, 3)))
    rows = np.flatnonzero(seen.drift.any(axis=1) & seen.outside)
    off = seen.drift[rows] if drifts else None
    march = bent.rays_of(HEIGHTS, seen.view[rows], seen.curvature[rows], 1.0, off)
    start = surface.point[rows]
    far = shape.meet(start, direction[rows], np.full(len(rows), NEAR))
    end = shape.surface(start, direction[rows], far).normal
    wide, high = [], []
    whole = 2 * np.arcsin(np.clip(seen.view[rows, 2], 0, 1)) / seen.curvature[rows]
    for share in np.linspace(0.1, 0.9, 17):
        point = start + (share * far.distance)[:, None] * direction[rows]
        up = (1 - share) * surface.normal[rows] + share * end
        foot = shape.foot(point, up / np.linalg.norm(up, axis=1, keepdims=True))
        # Where the march is as far along its way in uv.
        moved = foot.uv - surface.uv[rows]
        moved -= np.round(moved)
        along = march.along / np.linalg.norm(march.along, axis=1, keepdims=True)
        way = (moved * along).sum(axis=1) / np.linalg.norm(march.along, axis=1)
        place = way[:, None] * march.along
        if march.drift is not None:
            place = place + bent.aside(march.drift, way)
        good = (way > 0.05 * whole) & (way < 0.95 * whole) & (foot.depth < DEPTH * shape.tile)
        wide.append(np.where(good, np.linalg.norm(place - moved, axis=1), np.nan))
        height = bent.height_at(march, way)
        high.append(np.where(good, np.abs(height + foot.depth / shape.tile), np.nan))
    return np.array(wide), np.array(high)


SHAPES = {
    "torus": lambda: Torus(tube=0.25, tiles=(3, 1)),
    "sphere": lambda: shape_of("sphere", repeat=2),
    "cylinder": lambda: shape_of("cylinder", repeat=2),
    "mesh": lambda: Mesh(mesh(CLOSED["dented"], cells=(96, 32), tiles=(3, 1))),
}


@pytest.mark.parametrize("name", SHAPES)
def test_ways_are_where_the_rays_are(name: str) -> None:
    told, circle = (strayed(SHAPES[name](), [0.48, 0.6, 0.64], drifts=d) for d in (True, False))
    # A texel is a 64th of a tile; four numbers cannot say all, a circle far less.
    for found, without, limit in zip(told, circle, (0.006, 0.004), strict=True):
        assert np.isfinite(found).sum() > 1000
        # All but a tenth: rays also leave an open tube by its end.
        assert np.nanquantile(found, 0.9) < limit
        assert np.nanquantile(found, 0.9) < 0.3 * np.nanquantile(without, 0.9)


def test_a_ray_across_a_cylinder_does_not_drift() -> None:
    shape = shape_of("cylinder", repeat=2)
    wide, high = strayed(shape, [0.0, 0.0, 1.0], drifts=True)
    assert not np.isfinite(wide).any() or np.nanmax(wide) < 1e-6
    assert not np.isfinite(high).any() or np.nanmax(high) < 1e-6


@pytest.mark.parametrize("name", ["torus", "sphere", "cylinder"])
def test_feet_that_are_sought_are_those_in_closed_form(name: str) -> None:
    shape = SHAPES[name]()
    origin, direction, met = rays(shape, [0.48, 0.36, 0.8], 800)
    surface = shape.surface(origin, direction, met)
    inner = np.abs(surface.point[:, 1]) < 0.8
    rng = np.random.default_rng(2)
    depth = rng.uniform(0.02, 0.1, inner.sum())
    point = surface.point[inner] - depth[:, None] * surface.normal[inner]
    up = surface.normal[inner] + 0.1 * rng.normal(size=point.shape)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    exact, sought = shape.foot(point, up), Shape.foot(shape, point, up)
    np.testing.assert_allclose(exact.depth, depth, atol=1e-9)
    # One of Newton's steps from a tenth of a radian off leaves its square, in tiles.
    assert np.abs(exact.uv - surface.uv[inner]).max() < 1e-9
    assert np.quantile(np.abs(sought.uv - exact.uv), 0.95) < 2e-3
    assert np.quantile(np.abs(sought.depth - depth), 0.95) < 1e-4
