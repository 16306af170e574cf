"""Meshes as exporters write them: concave faces, numbers that are none, and other habits."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from btfkit.errors import FormatError
from btfkit.shapes import obj

SQUARE = "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
FACE = "f 1/1/1 2/2/1 3/3/1 4/4/1\n"


def meshed(folder: Path, text: str | bytes) -> obj.Triangles:
    path = folder / "a.obj"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return obj.read(path)


def areas(mesh: obj.Triangles) -> np.ndarray:
    edges = mesh.corner[:, 1:] - mesh.corner[:, :1]
    return np.cross(edges[:, 0], edges[:, 1])[:, 2] / 2


@pytest.mark.parametrize(
    "number",
    ["nan", "-nan", "NaN", "-nan(ind)", "nan(snan)", "1.#QNAN", "-1.#IND", "1.#INF", "inf"],
)
def test_a_normal_that_is_no_number_is_that_of_the_face(number: str, tmp_path: Path) -> None:
    mesh = meshed(tmp_path, SQUARE + f"vn {number} {number} {number}\n" + FACE)
    np.testing.assert_array_equal(mesh.normal, np.broadcast_to([0.0, 0, 1], (2, 3, 3)))


@pytest.mark.parametrize("form", [
    "\ufeff" + SQUARE + FACE, SQUARE.replace(" ", "\t") + FACE, SQUARE.replace("\n", "\r\n") + FACE,
    SQUARE.replace("\n", "\r") + FACE.replace("\n", "\r"), SQUARE.replace(" 0\nv", " 0 .5 .5 .5\nv") + FACE,
    SQUARE + "# f 9/9\n" + FACE + "   \n",
])  # fmt: skip
def test_habits_of_exporters_change_nothing(form: str, tmp_path: Path) -> None:
    mesh = meshed(tmp_path, form.replace("/1 ", " ").replace("/1\n", "\n").replace("/1\r", "\r"))
    assert areas(mesh).tolist() == [2, 2]


def test_faces_of_two_corners_are_left_out_and_told(tmp_path: Path) -> None:
    text = SQUARE + "vn 0 0 1\n" + FACE + "f 1/1 2/2\nf 3/3\n"
    with pytest.warns(UserWarning, match="2 faces of fewer than 3 corners are left out"):
        mesh = meshed(tmp_path, text)
    assert len(mesh.corner) == 2


def test_a_texture_coordinate_may_be_u_alone(tmp_path: Path) -> None:
    mesh = meshed(
        tmp_path, SQUARE.replace("vt 1 0", "vt 1").replace("vt 0 0", "vt 0") + "vn 0 0 1\n" + FACE
    )
    np.testing.assert_array_equal(mesh.uv[0], [[0, 0], [1, 0], [1, 1]])


def test_decimal_commas_in_a_mesh_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"line 1: could not convert .*'0,5'"):
        meshed(tmp_path, "v 0,5 0,5 0\n" + SQUARE + FACE)


@st.composite
def stars(draw: st.DrawFn) -> tuple[np.ndarray, int, int]:
    """Corners (n, 2) of a polygon that the origin sees whole, often concave, and how it lies."""
    n = draw(st.integers(4, 12))
    radius = draw(st.lists(st.floats(0.2, 1), min_size=n, max_size=n))
    angle = (np.arange(n) + 0.3) / n * 2 * np.pi
    flat = np.array(radius)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return flat, draw(st.integers(0, n - 1)), draw(st.integers(0, 5))


@given(star=stars())
def test_a_polygon_is_covered_once_from_whatever_corner_and_side(
    star: tuple[np.ndarray, int, int], tmp_path_factory: pytest.TempPathFactory
) -> None:
    flat, start, side = star
    flat = np.roll(flat, start, axis=0)
    if side >= 3:
        flat = flat[::-1]
    # In each of the planes, where leaving an axis out turns the others around.
    points = np.insert(flat, side % 3, 0.25, axis=1)
    lines = [f"v {x:.17g} {y:.17g} {z:.17g}" for x, y, z in points]
    lines += [f"vt {x:.17g} {y:.17g}" for x, y in flat]
    lines.append("f " + " ".join(f"{i}/{i}" for i in range(1, len(flat) + 1)))
    mesh = meshed(tmp_path_factory.mktemp("star"), "\n".join(lines))
    following = np.roll(flat, -1, axis=0)
    area = abs((flat[:, 0] * following[:, 1] - flat[:, 1] * following[:, 0]).sum()) / 2
    edges = mesh.corner[:, 1:] - mesh.corner[:, :1]
    normals = np.cross(edges[:, 0], edges[:, 1])
    # All face one side, so what they sum up to is what they cover; float64.
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1).sum() / 2, area, rtol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(normals.sum(axis=0)) / 2, area, rtol=1e-9)
    newell = np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)
    assert (normals @ newell >= 0).all()
    # Texture coordinates stay with their corners.
    kept = np.delete(mesh.corner, side % 3, axis=2)
    np.testing.assert_allclose(kept, mesh.uv, atol=1e-15)
