"""PLY: triangles of vertices or of corners with texture coordinates.

Texture coordinates stand with the vertices (s t, u v, texture_u texture_v) or, as MeshLab writes
them, six in a row with each triangle (texcoord). Colours and materials are left out.
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit.errors import FormatError
from btfkit.shapes.polygons import cut
from btfkit.shapes.triangles import MOST_BYTES, MOST_TRIANGLES, Triangles, gathered

_UV = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
_CORNERS = ("vertex_indices", "vertex_index")
_HEADER = 1 << 16
_COUNT = re.compile(rb"element[ \t]+(vertex|face)[ \t]+(\d+)")


def read(path: Path) -> Triangles:
    """The triangles of a PLY; those without area are left out.

    Raises:
        FileNotFoundError: there is no such file.
        FormatError: damaged, too large, without faces, or without texture coordinates.
    """
    size = path.stat().st_size
    if size > MOST_BYTES:
        raise FormatError(path, f"{size} bytes; at most {MOST_BYTES} are read")
    with path.open("rb") as file:
        header = file.read(_HEADER).split(b"end_header", 1)[0]
    for name, count in _COUNT.findall(header):
        if int(count) > MOST_TRIANGLES * 3:
            raise FormatError(path, f"{int(count)} of {name.decode()}; at most {MOST_TRIANGLES}")
    vertex, face = _elements(path)
    names = vertex.dtype.names or ()
    if missing := [axis for axis in "xyz" if axis not in names]:
        raise FormatError(path, f"vertices without {', '.join(missing)}")
    key = next((name for name in _CORNERS if name in (face.dtype.names or ())), None)
    if key is None or not len(face):
        raise FormatError(path, "no faces")
    tables = {
        "v": _columns(vertex, ("x", "y", "z")),
        "vt": np.zeros((0, 2)),
        "vn": np.zeros((0, 3)),
    }
    own = next((pair for pair in _UV if set(pair) <= set(names)), None)
    if own:
        tables["vt"] = _columns(vertex, own)
    if {"nx", "ny", "nz"} <= set(names):
        tables["vn"] = _columns(vertex, ("nx", "ny", "nz"))
    corners, place = _triangulated(path, face[key], tables["v"])
    faces = np.full((len(corners), 3, 3), -1, np.intp)
    faces[..., 0] = corners
    if own:
        faces[..., 1] = corners
    elif "texcoord" in (face.dtype.names or ()):
        tables["vt"], faces[..., 1] = _of_corners(path, face["texcoord"], place)
    if len(tables["vn"]):
        faces[..., 2] = corners
    if len(faces) > MOST_TRIANGLES:
        raise FormatError(path, f"more than {MOST_TRIANGLES} triangles")
    return gathered(path, tables, faces)


def _elements(path: Path) -> tuple[NDArray[Any], NDArray[Any]]:
    """Rows of vertices and of faces."""
    from plyfile import PlyData, PlyParseError

    # Triangles alone are read as one array; what else there is, face by face.
    known: tuple[dict[str, dict[str, int]], ...] = ({"face": dict.fromkeys(_CORNERS, 3)}, {})
    for lists in known:
        try:
            # An empty list makes numpy warn; whether there are numbers enough is asked below.
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                data = PlyData.read(str(path), known_list_len=lists)
            break
        except (PlyParseError, ValueError, MemoryError, UnicodeDecodeError) as error:
            if lists is known[-1]:
                raise FormatError(path, f"is no PLY that can be read: {error}") from error
    for name in ("vertex", "face"):
        if name not in data:
            raise FormatError(path, f"has no {name} elements")
    return data["vertex"].data, data["face"].data


def _columns(rows: NDArray[Any], names: tuple[str, ...]) -> NDArray[np.float64]:
    return np.stack([np.asarray(rows[name], np.float64) for name in names], axis=1)


def _triangulated(
    path: Path, polygons: NDArray[Any], at: NDArray[np.float64]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Vertices (f, 3) of triangles, and which corner (f, 3, 2) of which polygon each is."""
    if polygons.ndim == 2:
        corners = polygons.astype(np.intp)
        _check_indices(path, corners, len(at))
        place = np.stack(np.broadcast_arrays(np.arange(len(corners))[:, None], [0, 1, 2]), axis=-1)
        return corners, place
    flat = np.concatenate([np.asarray(polygon, np.intp).reshape(-1) for polygon in polygons])
    _check_indices(path, flat, len(at))
    triangles, places = [], []
    for row, polygon in enumerate(polygons):
        index = np.asarray(polygon).tolist()
        for triangle in cut(at[index].tolist()) if len(index) > 2 else ():
            triangles.append([index[corner] for corner in triangle])
            places.append([(row, corner) for corner in triangle])
    if not triangles:
        raise FormatError(path, "no faces of 3 corners or more")
    return np.array(triangles, np.intp), np.array(places, np.intp)


def _check_indices(path: Path, index: NDArray[np.intp], count: int) -> None:
    if index.size and not (index.min() >= 0 and index.max() < count):
        wrong = int(index.min() if index.min() < 0 else index.max())
        raise FormatError(path, f"a face names vertex {wrong}; there are {count}, from 0")


def _of_corners(
    path: Path, rows: NDArray[Any], place: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Texture coordinates (k, 2) that stand with the faces, and which (f, 3) each corner has."""
    counts = np.array([len(row) for row in rows]) // 2
    starts = np.cumsum(counts) - counts
    index = starts[place[..., 0]] + place[..., 1]
    # A face without them, or with too few, names none.
    index = np.where(place[..., 1] < counts[place[..., 0]], index, -1)
    pairs = [
        np.asarray(row, np.float64)[: 2 * n].reshape(n, 2)
        for row, n in zip(rows, counts, strict=True)
    ]
    return np.concatenate(pairs), index
