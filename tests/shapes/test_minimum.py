"""The published filter of curvature: its least along a short curve past where a ray enters."""

from __future__ import annotations

import numpy as np
import pytest

from btfkit.shapes.closed import Cylinder, Shape, Sphere
from btfkit.shapes.mesh import Mesh
from btfkit.shapes.minimum import MinimumCurvature
from btfkit.shapes.swept import mesh

WIDE, FLAT = 1.0, 0.4
# An ellipse's curvature where its turn is t, and its length there, from t = 0, the sharp end.
TURN = np.linspace(0, np.pi, 20001)
SPEED = np.hypot(WIDE * np.sin(TURN), FLAT * np.cos(TURN))
BEND = WIDE * FLAT / SPEED**3
LENGTH = np.concatenate([[0], np.cumsum((SPEED[1:] + SPEED[:-1]) / 2 * np.diff(TURN))])


def rays_at(shape: Shape, point: np.ndarray, direction: np.ndarray):
    """Rays (m, 3) that meet a shape first at points (m, 3), as `surface` takes them."""
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    origin = point - 0.01 * direction
    met = shape.meet(origin, direction, np.zeros(len(point)))
    np.testing.assert_allclose(met.distance, 0.01, atol=1e-3)
    return origin, direction, met


def on_ellipse(turn: np.ndarray, forwards: float, reach: float):
    """Filtered curvature of an elliptic tube's mesh where rays along its section enter, 1/tile."""

    def tube(u, v):
        around = 2 * np.pi * u
        return np.stack([WIDE * np.cos(around), FLAT * np.sin(around), 2 - 4 * v], -1)

    shape = Mesh(mesh(tube, cells=(256, 8), tiles=(1, 1)))
    size = np.hypot(WIDE, 2)  # of half its box: a mesh is scaled to 1
    point = np.stack([WIDE * np.cos(turn), FLAT * np.sin(turn), 0 * turn + 0.1], 1) / size
    out = np.stack([np.cos(turn) / WIDE, np.sin(turn) / FLAT, 0 * turn], 1)
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    ahead = forwards * np.stack([-out[:, 1], out[:, 0], 0 * turn], 1)
    rays = rays_at(shape, point, ahead - 0.5 * out)
    filtered = MinimumCurvature(shape, reach / size / shape.tile, steps=16)
    own, found = (each.surface(*rays) for each in (shape, filtered))
    np.testing.assert_array_equal(found.uv, own.uv)
    np.testing.assert_array_equal(found.bend[:, 1], 0)
    np.testing.assert_array_equal(found.bend[:, 0], found.bend[:, 2])
    return found.bend[:, 0] / size


@pytest.mark.parametrize(("forwards", "reach"), [(1.0, 0.2), (-1.0, 0.2), (1.0, 0.6)])
def test_along_an_ellipse_it_is_the_least_of_the_way_past_the_entry(forwards, reach) -> None:
    # From past the sharp end to short of the flat middle: ways lead out of bends and into them.
    turn = np.radians([20.0, 40.0, 55.0, 70.0])
    start = np.interp(turn, TURN, LENGTH)
    truth = []
    for at in start:
        way = np.abs(at + forwards * np.linspace(0, reach, 2000))
        truth.append(np.interp(way, LENGTH, BEND).min())
    found = on_ellipse(turn, forwards, reach)
    # 256 corners around the ellipse, and sixteen chords of the way for its arc.
    np.testing.assert_allclose(found, truth, rtol=0.03)
    own = np.interp(start, LENGTH, BEND)
    if forwards > 0:  # flatter and flatter
        assert (found < 0.75 * own)[:2].all()
    else:
        np.testing.assert_allclose(found[1:], own[1:], rtol=0.03)


def test_where_curvature_does_not_change_nothing_is_filtered() -> None:
    rng = np.random.default_rng(3)
    out = rng.normal(size=(200, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    way = rng.normal(size=(200, 3))
    way -= out * np.einsum("ij,ij->i", way, out)[:, None]
    rays = rays_at(Sphere(), out, way / np.linalg.norm(way, axis=1, keepdims=True) - 0.3 * out)
    found = MinimumCurvature(Sphere(), 0.3).surface(*rays).bend
    np.testing.assert_allclose(found, np.broadcast_to([1.0, 0, 1.0], found.shape), atol=1e-9)


def test_on_a_cylinder_the_entry_is_the_least() -> None:
    # In the plane of a slanted ray the tube's curvature is 1 / (1 + tan² s cos² a), a from the
    # entry: it grows.
    slant = np.radians([0.0, 20.0, 50.0, 80.0])
    point = np.tile([0.0, 0.0, 1.0], (4, 1))
    way = np.stack([np.cos(slant), np.sin(slant), 0 * slant - 0.2], 1)
    rays = rays_at(Cylinder(), point, way)
    found = MinimumCurvature(Cylinder(), 0.2).surface(*rays).bend[:, 0]
    np.testing.assert_allclose(found, np.cos(slant) ** 2, atol=1e-9)


def test_from_behind_it_is_the_least_as_seen_from_there() -> None:
    # From within a tube bends by -1 round it: a slanted ray's is the less the further it goes.
    slant = np.radians(50.0)
    way = np.array([[np.cos(slant), np.sin(slant), 0.2]])
    shape = Cylinder()
    reach, steps = 0.2 * np.pi, 64
    rays = rays_at(shape, np.array([[0.0, 0.0, 1.0]]), way)
    found = MinimumCurvature(shape, reach / shape.tile, steps).surface(*rays).bend[0, 0]
    turn = np.linspace(0, 1, 10001)
    speed = np.sqrt(1 + np.tan(slant) ** 2 * np.cos(turn) ** 2)
    length = np.concatenate([[0], np.cumsum((speed[1:] + speed[:-1]) / 2 * np.diff(turn))])
    # Tangents' ends lie off the curve by less than half a step.
    assert found == pytest.approx(1 / np.interp(reach, length, speed) ** 2, rel=0.01)


def test_along_the_normal_and_past_an_edge_nothing_is_lost() -> None:
    shape = Cylinder()
    edge = np.pi / 2 - 1e-3
    point = np.array([[0.0, 0.0, 1.0], [0.0, edge, 1.0]])
    rays = rays_at(shape, point, np.array([[0.0, 0.0, -1.0], [0.1, 1.0, -0.2]]))
    own, found = shape.surface(*rays), MinimumCurvature(shape, 0.2).surface(*rays)
    np.testing.assert_array_equal(found.bend[0], own.bend[0])
    assert found.bend[1, 0] == pytest.approx(0.01 / 1.01)
    foot = MinimumCurvature(shape, 0.2).foot(0.9 * point[:1], point[:1])
    assert foot.depth == pytest.approx(0.1)


@pytest.mark.parametrize(("reach", "steps"), [(0.0, 8), (float("nan"), 8), (0.1, 0)])
def test_a_curve_without_length_is_refused(reach, steps) -> None:
    with pytest.raises(ValueError, match="expected a finite length"):
        MinimumCurvature(Sphere(), reach, steps)
