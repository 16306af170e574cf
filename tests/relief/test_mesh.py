"""Reliefs as meshes: what other programs read is the surface, the right way round."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from btfkit.relief import procedural
from btfkit.relief.mesh import vertices, write_mesh
from btfkit.relief.relief import Relief
from btfkit.shapes import obj


def relief(texel_mm: float | None = 0.1) -> Relief:
    made = procedural.make("knit", 16)
    return Relief(made.height[:12], made.albedo[:12], made.specular[:12], made.roughness[:12],
                  texel_mm=texel_mm, wrap="clamp")  # fmt: skip


def test_stl_faces_up_and_covers_the_sample(tmp_path: Path) -> None:
    write_mesh(relief(), tmp_path / "m.stl")
    raw = (tmp_path / "m.stl").read_bytes()
    count = int(np.frombuffer(raw, "<u4", 1, 80)[0])
    rows = np.frombuffer(
        raw, [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")], count, 84
    )
    assert count == 2 * 11 * 15
    assert len(raw) == 84 + 50 * count
    assert (rows["normal"][:, 2] > 0).all()
    flat = rows["corners"][..., :2].astype(float)
    a, b = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    area = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum() / 2
    assert area == pytest.approx(1.1 * 1.5, rel=1e-5)


def test_ply_holds_heights_in_millimetres_row_by_row(tmp_path: Path) -> None:
    made = relief()
    write_mesh(made, tmp_path / "m.ply")
    head, _, body = (tmp_path / "m.ply").read_bytes().partition(b"end_header\n")
    assert b"element vertex 192" in head
    rows = np.frombuffer(body, "<f4", 192 * 8).reshape(192, 8)
    np.testing.assert_allclose(rows[:, 2], made.height.reshape(-1) * 16 * 0.1, rtol=1e-5)
    # The first texel is the upper left one.
    np.testing.assert_allclose(rows[0, :2], [-0.75, 0.55], rtol=1e-5)
    np.testing.assert_allclose(rows[:, 3:6], made.normals().reshape(-1, 3), atol=1e-6)
    assert len(body) == 192 * 32 + 2 * 11 * 15 * 13


def test_obj_is_read_back_by_our_own_reader(tmp_path: Path) -> None:
    made = relief(None)
    write_mesh(made, tmp_path / "m.obj")
    mesh = obj.read(tmp_path / "m.obj")
    assert len(mesh.corner) == 2 * 11 * 15
    assert np.ptp(vertices(made)[:, 2]) == pytest.approx(16 * np.ptp(made.height), rel=1e-5)


def test_names_and_reliefs_without_triangles_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"meshes are written as \.obj, \.ply, \.stl"):
        write_mesh(relief(), tmp_path / "m.fbx")
    line = relief()
    thin = Relief(line.height[:1], line.albedo[:1], line.specular[:1], line.roughness[:1])
    with pytest.raises(ValueError, match="1 x 16 texels has no triangles"):
        write_mesh(thin, tmp_path / "m.stl")
