"""What meshes tell of how they bend."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from btfkit.export.mitsuba import _ball, _floor, _grid
from btfkit.shapes.bending import principal, vertex_curvature, vertex_forms, vertices
from btfkit.shapes.closed import Meeting
from btfkit.shapes.mesh import Mesh
from btfkit.shapes.swept import CLOSED, Floats, mesh
from btfkit.shapes.triangles import Triangles


def ball(u: Floats, v: Floats) -> Floats:
    around, polar = 2 * np.pi * u, np.pi * v
    flat = 2 * np.sin(polar)
    return np.stack([flat * np.sin(around), 2 * np.cos(polar), flat * np.cos(around)], -1)


def tube(u: Floats, v: Floats) -> Floats:
    around = 2 * np.pi * u
    return np.stack([0.5 * np.cos(around), 0.5 * np.sin(around), -2 * v], -1)


def torus(u: Floats, v: Floats) -> Floats:
    around, across = 2 * np.pi * u, 2 * np.pi * v
    away = 2 + 0.5 * np.cos(across)
    return np.stack([away * np.cos(around), away * np.sin(around), 0.5 * np.sin(across)], -1)


def saddle(u: Floats, v: Floats) -> Floats:
    x, y = u - 0.5, v - 0.5
    return np.stack([x, y, (x**2 - y**2) / 2], -1)


def bent(place: Callable[[Floats, Floats], Floats], cells: tuple[int, int]):
    """Principal curvatures at the vertices of a mesh, and where these are (v, 3)."""
    made = mesh(place, cells=cells, tiles=(1, 1))
    return bent_of(made)


def bent_of(made: Triangles):
    index = vertices(made.corner, made.normal)
    count = int(index.max()) + 1
    form = vertex_forms(made.corner, made.normal, index, count)
    at, normal = np.zeros((count, 3)), np.zeros((count, 3))
    at[index], normal[index] = made.corner, made.normal
    return principal(form, normal), at, normal, form


@pytest.mark.parametrize("radius", [0.5, 3.0])
def test_a_ball_bends_by_the_width_of_its_tile_over_its_radius(radius: float) -> None:
    at, normal, uv, faces = _ball(1.0, 4)
    found = vertex_curvature(at * radius, normal, uv, faces)
    band = np.abs(at[:, 2]) < 0.8
    # The mean width of a tile by area: 2 pi r / 4 cos(latitude), whose mean is pi / 4 of that.
    wanted = 2 * np.pi / 4 * np.pi / 4
    np.testing.assert_allclose(found[band, 0], wanted, rtol=0.02)
    np.testing.assert_allclose(found[band, 2], wanted, rtol=0.02)
    np.testing.assert_allclose(found[band, 1], 0, atol=0.02)


def test_a_cylinder_bends_around_and_not_along_and_a_plane_not_at_all() -> None:
    u, v = np.meshgrid(np.linspace(0, 1, 65), np.linspace(0, 1, 5))
    normal = np.stack([np.cos(2 * np.pi * u), np.sin(2 * np.pi * u), 0 * u], -1).reshape(-1, 3)
    at = 2 * normal + np.stack([0 * u, 0 * u, v], -1).reshape(-1, 3)
    # u runs aslant, so that the form has an xy.
    uv = np.stack([u + v, v], -1).reshape(-1, 2)
    found = vertex_curvature(at, normal, uv, _grid(4, 64))
    np.testing.assert_allclose(
        found[:, 0] + found[:, 2], found[:, 0].mean() * 1.0 + found[:, 2].mean(), rtol=1e-3
    )
    determinant = found[:, 0] * found[:, 2] - found[:, 1] ** 2
    np.testing.assert_allclose(determinant, 0, atol=1e-3)
    assert found[:, 0].mean() == pytest.approx(2 * np.pi * 2 / 2, rel=0.01)
    at, normal, uv, faces = _floor(1.0, 2.0)
    np.testing.assert_allclose(vertex_curvature(at, normal, uv, faces), 0, atol=1e-6)


def test_triangles_without_area_tell_nothing() -> None:
    at = np.zeros((3, 3))
    found = vertex_curvature(
        at, np.tile([0, 0, 1.0], (3, 1)), np.zeros((3, 2)), np.array([[0, 1, 2]])
    )
    np.testing.assert_array_equal(found, 0)


def test_umbilic_points_bend_alike_in_two_directions_at_right_angles() -> None:
    found, _at, normal, _ = bent(ball, (64, 32))
    # A sphere of radius 2; steps of 6 degrees: cosines of them to 0.5 %.
    np.testing.assert_allclose(found.most, 0.5, rtol=0.01)
    np.testing.assert_allclose(found.least, 0.5, rtol=0.01)
    for along in (found.along_most, found.along_least):
        np.testing.assert_allclose(np.linalg.norm(along, axis=1), 1, atol=1e-9)
        np.testing.assert_allclose(np.einsum("ij,ij->i", along, normal), 0, atol=1e-9)
    np.testing.assert_allclose(
        np.einsum("ij,ij->i", found.along_most, found.along_least), 0, atol=1e-9
    )


def test_a_cylinder_bends_around_its_axis() -> None:
    found, _at, _, _ = bent(tube, (96, 8))
    np.testing.assert_allclose(found.most, 2, rtol=0.01)
    np.testing.assert_allclose(found.least, 0, atol=1e-6)
    np.testing.assert_allclose(np.abs(found.along_least[:, 2]), 1, atol=1e-6)


def test_a_torus_bends_by_its_tube_and_by_its_ring() -> None:
    found, at, _, _ = bent(torus, (128, 48))
    away = np.hypot(at[:, 0], at[:, 1])
    # Across the tube 1 / 0.5; around the ring its cosine over the distance from the axis.
    np.testing.assert_allclose(found.most, 2, rtol=0.01)
    np.testing.assert_allclose(found.least, (away - 2) / 0.5 / away, atol=0.01)
    around = np.stack([-at[:, 1], at[:, 0], 0 * away], 1) / away[:, None]
    aligned = np.abs(np.einsum("ij,ij->i", found.along_least, around))
    assert aligned.min() > 0.999


def test_a_saddle_bends_up_one_way_and_down_the_other_and_its_border_is_open() -> None:
    found, at, normal, _ = bent(saddle, (32, 32))
    # In the middle -1 along x (towards the normal is concave) and 1 along y, or the other way up.
    middle = np.flatnonzero(np.hypot(at[:, 0], at[:, 1]) < 0.1)
    np.testing.assert_allclose(found.most[middle], 1, rtol=0.03)
    np.testing.assert_allclose(found.least[middle], -1, rtol=0.03)
    up = normal[middle[0], 2] > 0
    along = found.along_most[middle]
    assert np.abs(along[:, 1 if up else 0]).min() > 0.99
    # Vertices of the border know their own triangles alone, and are right to the first order.
    border = np.abs(at[:, :2]).max(axis=1) > 0.499
    assert np.abs(found.most[border] - found.most[middle].mean()).max() < 0.8
    assert np.isfinite(found.most).all()


def test_seams_of_uv_and_non_manifold_edges_do_not_part_vertices_and_creases_do() -> None:
    made = mesh(torus, cells=(16, 12), tiles=(3, 1))
    # The grid is closed: its seam is one row of vertices.
    assert vertices(made.corner, made.normal).max() + 1 == 16 * 12
    # A third triangle on an edge that two share already, with the same normals.
    fin = made.corner[:1].copy()
    fin[0, 2] += 0.3 * made.normal[0, 2]
    normal = np.concatenate([made.normal, made.normal[:1]])
    index = vertices(np.concatenate([made.corner, fin]), normal)
    assert index.max() + 1 == 16 * 12 + 1
    form = vertex_forms(np.concatenate([made.corner, fin]), normal, index, int(index.max()) + 1)
    assert np.isfinite(form).all()
    cube = Triangles(
        np.array([[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 0, 0], [1, 0, -1]]], float),
        np.zeros((2, 3, 2)),
        np.array([[[0, 0, 1.0]] * 3, [[0, -1.0, 0]] * 3]),
    )
    assert vertices(cube.corner, cube.normal).max() + 1 == 6


def test_flat_and_degenerate_triangles_and_such_uv_give_a_mesh_without_curvature() -> None:
    corner = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[1, 0, 0], [1, 1, 0], [0, 1, 0]]], float)
    normal = np.tile([0, 0, 1.0], (2, 3, 1))
    for uv in (corner[..., :2], np.zeros((2, 3, 2))):
        shape = Mesh(Triangles(corner, uv, normal))
        origin = np.array([[0.1, 0.05, 5.0], [-0.2, 0.1, 5.0]])
        down = np.tile([0, 0, -1.0], (2, 1))
        met = shape.meet(origin, down, np.zeros(2))
        surface = shape.surface(origin, down, met)
        np.testing.assert_allclose(surface.bend, 0, atol=1e-12)
    sliver = np.concatenate([corner, corner[:1] * [1, 0, 0]])
    form = vertex_forms(sliver, np.tile([0, 0, 1.0], (3, 3, 1)),
                        vertices(sliver, np.tile([0, 0, 1.0], (3, 3, 1))), 4)  # fmt: skip
    np.testing.assert_array_equal(form, 0)


@pytest.mark.parametrize("wound", [1, -1])
def test_a_mesh_tells_what_its_shape_does_whichever_way_it_is_wound(wound: int) -> None:
    made = mesh(torus, cells=(160, 64), tiles=(6, 2))
    made = Triangles(*(part[:, ::wound] for part in made))
    shape, rng = Mesh(made), np.random.default_rng(0)
    face, weight = rng.integers(len(made.corner), size=300), rng.dirichlet([1, 1, 1], 300)
    point = np.einsum("ij,ijk->ik", weight, shape._corner[face])
    surface = shape.surface(point, np.tile([0, 0, 1.0], (300, 1)), Meeting(np.zeros(300), face))
    # Scaled into the unit sphere, of which the torus had radius 2.5.
    across, away = surface.bend[:, 2] / 2.5, 2.5 * np.hypot(point[:, 0], point[:, 1])
    np.testing.assert_allclose(across, 2, rtol=0.02)
    np.testing.assert_allclose(surface.bend[:, 0] / 2.5, (away - 2) / 0.5 / away, atol=0.03)
    # du is that of a triangle, which turns by up to 2 degrees against the ring.
    np.testing.assert_allclose(surface.bend[:, 1] / 2.5, 0, atol=0.06)


@pytest.mark.parametrize("name", CLOSED)
def test_irregular_closed_surfaces_face_outwards(name: str) -> None:
    made = mesh(CLOSED[name], cells=(48, 24), tiles=(1, 1))
    flat = np.cross(made.corner[:, 1] - made.corner[:, 0], made.corner[:, 2] - made.corner[:, 0])
    volume = np.einsum("ij,ij->", made.corner.mean(axis=1), flat) / 6
    facing = np.einsum("ij,ikj->i", flat, made.normal)
    assert (np.sign(facing) == np.sign(volume)).mean() > 0.99
