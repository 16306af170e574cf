"""Chords: the circle that a march is told of stands for the way of a ray through a body."""

from __future__ import annotations

import numpy as np
import pytest

from btfkit.directions import rotation
from btfkit.render.chords import chords, half_turn
from btfkit.render.gaze import dot, uv_step
from btfkit.shapes.catalogue import shape_of
from btfkit.shapes.closed import Shape, Surface
from btfkit.shapes.mesh import Mesh
from btfkit.shapes.obj import read
from btfkit.shapes.torus import Torus


def looked_at(shape: Shape, view: np.ndarray, count: int) -> tuple[Surface, np.ndarray]:
    """Places that a distant eye sees, and the directions towards it."""
    rng = np.random.default_rng(1)
    side = np.cross(view, [0.1, 1.0, 0.2])
    side /= np.linalg.norm(side)
    place = rng.uniform(-1, 1, (count, 2)) @ np.stack([side, np.cross(view, side)])
    origin, direction = place + 8 * view, np.tile(-view, (count, 1))
    met = shape.meet(origin, direction, np.full(count, -np.inf))
    hit = np.isfinite(met.distance)
    part = type(met)(met.distance[hit], met.part[hit])
    return shape.surface(origin[hit], direction[hit], part), np.tile(view, (hit.sum(), 1))


def asked(shape: Shape, surface: Surface, toward: np.ndarray, thickness: float):
    x = surface.du / np.linalg.norm(surface.du, axis=1, keepdims=True)
    y = np.cross(surface.normal, x)
    view = np.stack([dot(x, toward), dot(y, toward), dot(surface.normal, toward)], axis=1)
    step = uv_step(surface, dot(surface.normal, toward)[:, None] * surface.normal - toward)
    x2, xy, y2 = (surface.bend * shape.tile).T
    flat = np.maximum(view[:, 0] ** 2 + view[:, 1] ** 2, 1e-12)
    bend = x2 * view[:, 0] ** 2 + 2 * xy * view[:, 0] * view[:, 1] + y2 * view[:, 1] ** 2
    found = chords(
        shape, surface, toward, view, step, bend / flat, aspect=1.0, thickness=thickness
    )  # fmt: skip
    return found, view


def test_on_a_sphere_the_circle_is_the_great_circle() -> None:
    shape = shape_of("sphere", repeat=4)
    surface, toward = looked_at(shape, np.array([0.0, 0.0, 1.0]), 9000)
    # Near the equator, where tiles have their proportions.
    flat = np.abs(surface.point[:, 1]) < 0.02
    surface = Surface(*(part[flat] for part in surface))
    found, view = asked(shape, surface, toward[flat], 0.3)
    assert found is not None
    assert len(found.rows) > 10
    # Of radius 1: the whole chord has the curvature and the angle of its entry. cos at |y| < 0.02.
    np.testing.assert_allclose(found.curvature, shape.tile, rtol=2e-3)
    np.testing.assert_allclose(found.view, view[found.rows], atol=0.02)


def test_on_a_torus_chords_lie_between_their_ends_and_end_where_rays_do() -> None:
    shape = Torus(tube=0.25, tiles=(3, 1))
    surface, toward = looked_at(shape, np.array([0.48, -0.36, 0.8]), 3000)
    found, view = asked(shape, surface, toward, 0.14)
    assert found is not None
    assert len(found.rows) > 100
    np.testing.assert_allclose(np.linalg.norm(found.view, axis=1), 1, atol=1e-9)
    assert (found.view[:, 2] > 0).all()
    assert (found.curvature > 0).all()
    # What is told differs from the entry's where curvature changes: else nothing would be gained.
    assert np.abs(found.view - view[found.rows]).max() > 0.05


def test_steep_views_planes_and_materials_of_no_thickness_keep_the_entry() -> None:
    for shape, thickness in ((shape_of("plane"), 0.1), (shape_of("sphere"), 0.0)):
        surface, toward = looked_at(shape, np.array([0.0, 0.0, 1.0]), 500)
        assert asked(shape, surface, toward, thickness)[0] is None
    shape = shape_of("sphere")
    surface, toward = looked_at(shape, np.array([0.0, 0.0, 1.0]), 500)
    # The circle of the entry takes them deeper than two thicknesses of 0.1 tiles of pi: 1 - 0.63.
    steep = surface.normal[:, 2] > 0.94
    surface = Surface(*(part[steep] for part in surface))
    assert asked(shape, surface, toward[steep], 0.1)[0] is None
    # Half as steep a ray under a thick material may still pass.
    assert asked(shape, surface, toward[steep], 0.25)[0] is not None


def test_a_seam_of_uv_is_no_chord(tmp_path) -> None:
    # Two walls of a roof, whose texture coordinates have nothing to do with each other.
    roof = tmp_path / "roof.obj"
    roof.write_text(
        "v 0 0 1\nv 0 2 1\nv -1 0 0\nv -1 2 0\nv 1 0 0\nv 1 2 0\n"
        "vt 0 0\nvt 0.1 0\nvt 0 0.1\nvt 0.1 0.1\nvt 0.6 0.47\nvt 0.63 0.4\nvt 0.6 0.9\nvt 0.7 0.7\n"
        "f 1/1 2/2 4/4\nf 1/1 4/4 3/3\nf 1/5 5/7 6/8\nf 1/5 6/8 2/6\n"
    )
    shape = Mesh(read(roof))
    surface, toward = looked_at(shape, np.array([-0.8, 0.0, 0.6]), 800)
    found, _ = asked(shape, surface, toward, 5.0)
    assert found is None or np.isfinite(found.view).all()


@pytest.mark.parametrize("turn", [1e-5, 0.01, 0.3, 0.9, 1.4])
def test_half_turns_give_back_their_arcs(turn) -> None:
    ratio = np.array([2 * np.sin(turn / 2) ** 2 / (2 * turn)])
    np.testing.assert_allclose(half_turn(ratio), turn, rtol=2e-3)
    assert half_turn(np.array([5.0])) == pytest.approx(1.5)


def test_a_rotation_takes_the_view_where_it_shall_be_and_keeps_angles() -> None:
    rng = np.random.default_rng(3)
    start, end, light = (rng.normal(size=(50, 3)) for _ in range(3))
    start, end = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (start, end))
    turn = rotation(start, end)
    np.testing.assert_allclose(np.einsum("ijk,ik->ij", turn, start), end, atol=1e-9)
    turned = np.einsum("ijk,ik->ij", turn, light)
    np.testing.assert_allclose(dot(turned, end), dot(light, start), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(turn), 1, atol=1e-9)
