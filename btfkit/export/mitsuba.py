"""`mitsuba`: the model, meshes that tell their curvature, a scene and a program that renders it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from btfkit.export.ball import tiles_around
from btfkit.export.sections import filled, whole_text
from btfkit.materials.base import Material
from btfkit.materials.file import save
from btfkit.program import Program
from btfkit.shapes.bending import vertex_curvature

# Vertices of the ball around and from pole to pole.
_AROUND, _DOWN = 128, 64
_FLOOR = 5.0


def write(material: Material, program: Program, folder: Path) -> None:
    """`material.safetensors`, `scene.xml`, `ball.ply`, `floor.ply` and `render.py`."""
    save(material, folder / "material.safetensors", lobes=True)
    aspect, tiles = material.header.aspect, tiles_around(program)
    # What does not tile covers the floor once.
    tile = 2 * np.pi / tiles if program.wrap else 2 * _FLOOR * max(1, aspect)
    for name, mesh in (("ball", _ball(aspect, tiles)), ("floor", _floor(tile, aspect))):
        write_ply(folder / f"{name}.ply", *mesh)
    # Light that passes a null lobe is only seen by the integrator of volumes.
    integrator = "path" if program.opacity == "none" else "volpath"
    scene = filled(whole_text("mitsuba.xml"), integrator=integrator)
    (folder / "scene.xml").write_text(scene)
    (folder / "render.py").write_text(whole_text("mitsuba.py.txt"))


Mesh = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.intp]]


def _ball(aspect: float, tiles: float) -> Mesh:
    """Positions, normals, uv and faces of the unit sphere, poles on z, `tiles` around it."""
    u, v = np.meshgrid(np.linspace(0, 1, _AROUND + 1), np.linspace(0, 1, _DOWN + 1))
    theta, phi = np.pi * (1 - v), 2 * np.pi * u
    at = np.stack(
        [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1
    ).reshape(-1, 3)
    uv = np.stack([tiles * u, tiles / 2 * aspect * v], axis=-1).reshape(-1, 2)
    return at, at.copy(), uv, _grid(_DOWN, _AROUND)


def _floor(tile: float, aspect: float) -> Mesh:
    """The same of a square below it, tiles `tile` wide."""
    x, y = np.meshgrid([-_FLOOR, _FLOOR], [-_FLOOR, _FLOOR])
    at = np.stack([x, y, np.full((2, 2), -1.0)], axis=-1).reshape(-1, 3)
    uv = np.stack([(x + _FLOOR) / tile, (y + _FLOOR) / tile * aspect], axis=-1).reshape(-1, 2)
    return at, np.tile([0.0, 0.0, 1.0], (4, 1)), uv, _grid(1, 1)


def _grid(rows: int, columns: int) -> NDArray[np.intp]:
    """(f, 3) triangles, counter-clockwise where rows run up and columns to the right."""
    at = np.arange((rows + 1) * (columns + 1)).reshape(rows + 1, columns + 1)
    a, b, c, d = at[:-1, :-1], at[:-1, 1:], at[1:, :-1], at[1:, 1:]
    return np.stack([np.stack([a, b, d], -1), np.stack([a, d, c], -1)], axis=2).reshape(-1, 3)


def write_ply(
    path: Path,
    position: NDArray[np.floating],
    normal: NDArray[np.floating],
    uv: NDArray[np.floating],
    faces: NDArray[np.intp],
) -> None:
    """A mesh as Mitsuba reads it, its curvature as the attribute `vertex_curvature`."""
    bend = vertex_curvature(position, normal, uv, faces)
    table = np.concatenate([position, normal, uv, bend], axis=1).astype("<f4")
    names = ("x", "y", "z", "nx", "ny", "nz", "s", "t", *(f"curvature_{k}" for k in range(3)))
    header = [
        "ply", "format binary_little_endian 1.0", f"element vertex {len(table)}",
        *(f"property float {name}" for name in names),
        f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", "",
    ]  # fmt: skip
    corners = np.empty(len(faces), [("count", "u1"), ("at", "<i4", 3)])
    corners["count"], corners["at"] = 3, faces
    path.write_bytes("\n".join(header).encode() + table.tobytes() + corners.tobytes())
