"""What meshes tell of how they bend."""

from __future__ import annotations

import numpy as np
import pytest

from btfkit.export.mitsuba import _ball, _floor, _grid
from btfkit.shapes.bending import vertex_curvature


@pytest.mark.parametrize("radius", [0.5, 3.0])
def test_a_ball_bends_by_the_width_of_its_tile_over_its_radius(radius: float) -> None:
    at, normal, uv, faces = _ball(1.0)
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
