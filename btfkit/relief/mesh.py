"""A relief as a mesh of triangles, for other programs: OBJ, PLY or STL.

x right, y up, z out of the sample; millimetres where the edge of a texel is known, else texels.
The origin is the centre of the sample on the plane that uv lives in.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit.files import whole
from btfkit.relief.relief import Relief

SUFFIXES = (".obj", ".ply", ".stl")
Floats = NDArray[Any]


def check_name(path: str | os.PathLike[str]) -> None:
    """Refuse names that no mesh has.

    Raises:
        ValueError: another suffix than .obj, .ply or .stl.
    """
    if Path(path).suffix.lower() not in SUFFIXES:
        raise ValueError(f"{path}: meshes are written as {', '.join(SUFFIXES)}")


def write_mesh(relief: Relief, path: str | os.PathLike[str], *, force: bool = False) -> None:
    """Write a relief as a mesh, a vertex a texel centre, two triangles between four of them.

    Args:
        relief: of at least 2 x 2 texels. path: *.obj, *.ply or *.stl.
        force: whether an existing file is replaced.

    Raises:
        ValueError: another suffix, or a relief of one row or column.
        FileExistsError: `path` exists and `force` is False.
    """
    check_name(path)
    h, w = relief.size
    if min(h, w) < 2:
        raise ValueError(f"a relief of {h} x {w} texels has no triangles; at least 2 x 2")
    at, uv = vertices(relief), _places(h, w)
    triangles = _triangles(h, w)
    kind = Path(path).suffix.lower()
    with whole(path, force=force) as partial:
        if kind == ".obj":
            _write_obj(partial, at, uv, relief.normals().reshape(-1, 3), triangles)
        elif kind == ".ply":
            _write_ply(partial, at, relief.normals().reshape(-1, 3), uv, triangles)
        else:
            _write_stl(partial, at, triangles)


def vertices(relief: Relief) -> Floats:
    """(h w, 3) float32 texel centres on the surface, row by row, mm or texels."""
    h, w = relief.size
    edge = relief.texel_mm or 1.0
    row, col = np.mgrid[:h, :w]
    x, y = (col + 0.5 - w / 2) * edge, (h / 2 - row - 0.5) * edge
    z = relief.height.astype(float) * w * edge
    return np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(np.float32)


def _places(h: int, w: int) -> Floats:
    """(h w, 2) uv as meshes have it: v runs up."""
    row, col = np.mgrid[:h, :w]
    return np.stack([(col + 0.5) / w, 1 - (row + 0.5) / h], axis=-1).reshape(-1, 2)


def _triangles(h: int, w: int) -> NDArray[np.int32]:
    """(m, 3) vertices, counter-clockwise seen from above."""
    at = np.arange(h * w, dtype=np.int32).reshape(h, w)
    a, b, c, d = at[:-1, :-1], at[:-1, 1:], at[1:, :-1], at[1:, 1:]
    both = np.stack([np.stack([a, c, b], -1), np.stack([b, c, d], -1)], axis=-2)
    return both.reshape(-1, 3)


def _write_obj(
    path: Path, at: Floats, uv: Floats, normals: Floats, triangles: NDArray[np.int32]
) -> None:
    with path.open("w") as file:
        for mark, rows in (("v", at), ("vt", uv), ("vn", normals)):
            np.savetxt(file, rows, fmt=mark + " %.7g" * rows.shape[1])
        corner = np.repeat(triangles + 1, 3, axis=1)
        np.savetxt(file, corner, fmt="f %d/%d/%d %d/%d/%d %d/%d/%d")


def _write_ply(
    path: Path, at: Floats, normals: Floats, uv: Floats, triangles: NDArray[np.int32]
) -> None:
    names = ("x", "y", "z", "nx", "ny", "nz", "s", "t")
    header = [
        "ply", "format binary_little_endian 1.0", f"element vertex {len(at)}",
        *(f"property float {name}" for name in names),
        f"element face {len(triangles)}", "property list uchar int vertex_indices", "end_header\n",
    ]  # fmt: skip
    faces = np.zeros(len(triangles), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, triangles
    with path.open("wb") as file:
        file.write("\n".join(header).encode())
        file.write(np.concatenate([at, normals, uv], axis=1).astype("<f4").tobytes())
        file.write(faces.tobytes())


def _write_stl(path: Path, at: Floats, triangles: NDArray[np.int32]) -> None:
    corners = at[triangles].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    rows = np.zeros(
        len(triangles), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")]
    )
    rows["normal"], rows["corners"] = normal, corners
    with path.open("wb") as file:
        file.write(b"relief".ljust(80) + np.uint32(len(triangles)).tobytes() + rows.tobytes())
