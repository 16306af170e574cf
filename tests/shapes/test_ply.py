"""PLY meshes: what exporters write is read as the same mesh, what is not understood is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from btfkit.errors import FormatError
from btfkit.relief import procedural
from btfkit.relief.mesh import write_mesh
from btfkit.shapes import obj, ply
from btfkit.shapes.catalogue import shape_of
from btfkit.shapes.triangles import Triangles

SQUARE = ("0 0 0 0 0", "1 0 0 1 0", "1 1 0 1 1", "0 1 0 0 1")
LIST = "property list uchar int vertex_indices"


def written(
    folder: Path, vertices: tuple[str, ...], faces: tuple[str, ...], *, uv: str = "s t",
    lists: str = LIST, counts: tuple[int, int] | None = None,
) -> Path:  # fmt: skip
    n, m = counts or (len(vertices), len(faces))
    header = ["ply", "format ascii 1.0", f"element vertex {n}"]
    header += [f"property float {name}" for name in ("x", "y", "z", *uv.split())]
    header += [f"element face {m}", *lists.splitlines(), "end_header"]
    path = folder / "a.ply"
    path.write_text("\n".join([*header, *vertices, *faces, ""]))
    return path


def area(mesh: Triangles) -> float:
    edges = mesh.corner[:, 1:] - mesh.corner[:, :1]
    return float(np.cross(edges[:, 0], edges[:, 1])[:, 2].sum() / 2)


@pytest.mark.parametrize("uv", ["s t", "u v", "texture_u texture_v"])
@pytest.mark.parametrize("faces", [
    ("4 0 1 2 3",), ("3 0 1 2", "3 0 2 3"), ("3 0 1 2", "4 0 1 2 3", "3 3 2 0", "2 0 1"),
])  # fmt: skip
def test_texture_coordinates_by_any_of_their_names(
    uv: str, faces: tuple[str, ...], tmp_path: Path
) -> None:
    mesh = ply.read(written(tmp_path, SQUARE, faces, uv=uv))
    # The last list turns one triangle around: it counts against.
    assert area(mesh) == pytest.approx(1)
    np.testing.assert_array_equal(mesh.corner[..., :2], mesh.uv)


def test_concave_polygons_are_covered_once(tmp_path: Path) -> None:
    dented = (*SQUARE, "0.5 0.25 0 0.5 0.25")
    mesh = ply.read(written(tmp_path, dented, ("5 0 1 2 4 3",)))
    # The square without the triangle that the dent takes from above.
    assert area(mesh) == pytest.approx(1 - 0.75 / 2)


def test_texture_coordinates_of_corners(tmp_path: Path) -> None:
    lists = LIST + "\nproperty list uchar float texcoord"
    faces = ("3 0 1 2 6 0 0 .5 0 .5 .5", "3 0 2 3 6 0 .5 .5 1 0 1")
    mesh = ply.read(written(tmp_path, tuple(v[:5] for v in SQUARE), faces, uv="", lists=lists))
    np.testing.assert_array_equal(mesh.uv[1], [[0, 0.5], [0.5, 1], [0, 1]])
    short = ("3 0 1 2 6 0 0 .5 0 .5 .5", "3 0 2 3 0")
    with pytest.raises(FormatError, match="1 of 2 triangles have no texture coordinates"):
        ply.read(written(tmp_path, tuple(v[:5] for v in SQUARE), short, uv="", lists=lists))


@pytest.mark.parametrize(("vertices", "faces", "options", "message"), [
    (SQUARE, ("3 0 1 2",), {"counts": (4, 2)}, "early end-of-file"),
    (SQUARE[:2], (), {"counts": (4, 1)}, "early end-of-file"),
    (SQUARE, ("3 0 1 9",), {}, "names vertex 9; there are 4"),
    (SQUARE, ("3 0 1 -1",), {}, "names vertex -1"),
    (SQUARE, ("2 0 1",), {}, "no faces of 3 corners"),
    (SQUARE, (), {}, "no faces"),
    (("nan 0 0 0 0", *SQUARE[1:]), ("3 0 1 2",), {}, "v holds values that are not finite"),
    (("0 0 0 inf 0", *SQUARE[1:]), ("3 0 1 2",), {}, "vt holds values that are not finite"),
    (SQUARE, ("3 0 0 1",), {}, "no triangle has an area"),
    (SQUARE, ("3 0 1 2",), {"uv": "a b"}, "have no texture coordinates; unwrap the mesh"),
    (SQUARE, ("3 0 1 2",), {"counts": (10**12, 1)}, "1000000000000 of vertex; at most"),
    (SQUARE, ("3 0 1 two",), {}, "malformed"),
])  # fmt: skip
def test_what_is_no_mesh_is_refused(
    vertices: tuple[str, ...], faces: tuple[str, ...], options: dict[str, object], message: str,
    tmp_path: Path,
) -> None:  # fmt: skip
    with pytest.raises(FormatError, match=message):
        ply.read(written(tmp_path, vertices, faces, **options))  # type: ignore[arg-type]


def test_other_bytes_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    for text in (b"", b"hello", b"\xff\xfe\x00ply", b"ply\nformat ascii 1.0\nend_header\n"):
        path.write_bytes(text)
        with pytest.raises(FormatError, match=r"no PLY|has no vertex"):
            ply.read(path)


def test_a_relief_is_the_same_mesh_as_obj_and_as_ply(tmp_path: Path) -> None:
    made = procedural.make("knit", 24)
    for name in ("m.obj", "m.ply"):
        write_mesh(made, tmp_path / name)
    first, second = obj.read(tmp_path / "m.obj"), ply.read(tmp_path / "m.ply")
    for one, other in zip(first, second, strict=True):
        # Seven digits in the OBJ, float32 in the PLY.
        np.testing.assert_allclose(one, other, atol=2e-6 * np.abs(one).max())
    assert shape_of(str(tmp_path / "m.PLY".lower())).tile > 0
