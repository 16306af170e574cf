"""Wavefront OBJ: triangles with texture coordinates, and normals where they are given.

Read: v, vt, vn and f (polygons; v/vt, v/vt/vn; negative indices; lines continued by a backslash).
Left out: materials, groups, lines, curves, free-form surfaces, faces of two corners, and all
numbers beyond the first three of v and vn and the first two of vt (of which the second may lack).
Polygons may be concave. Normals that are no numbers are those of the face.
"""

from __future__ import annotations

import re
import warnings
from array import array
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from btfkit.errors import FormatError

Floats = NDArray[np.floating]
Vector = Sequence[float]
_COUNTS = {"v": 3, "vt": 2, "vn": 3}
_FEWEST = {"v": 3, "vt": 1, "vn": 3}
# What exporters print for a number that is none, beside nan: of Microsoft's and of others' C.
_NO_NUMBER = ("nan", "#ind", "#qnan", "#snan", "#inf")
# 1.#QNAN holds no comment.
_COMMENT = re.compile(r"(?:^|\s)#")
_MOST_BYTES, _MOST_TRIANGLES, _MOST_VALUE = 1 << 30, 1 << 22, 1e30


class Triangles(NamedTuple):
    """A mesh: f triangles, corners counter-clockwise as seen from outside.

    Attributes:
        corner: (f, 3, 3) positions. uv: (f, 3, 2) u right, v up, as an OBJ has them.
        normal: (f, 3, 3) unit normals; that of the face where none was given.
    """

    corner: Floats
    uv: Floats
    normal: Floats


def read(path: Path) -> Triangles:
    """The triangles of an OBJ; those without area are left out.

    Raises:
        FileNotFoundError: there is no such file.
        FormatError: damaged, too large, without faces, or without texture coordinates.
    """
    size = path.stat().st_size
    if size > _MOST_BYTES:
        raise FormatError(path, f"{size} bytes; at most {_MOST_BYTES} are read")
    # Plain arrays of numbers: lists of lists would take ten times their memory.
    tables = {name: array("d") for name in _COUNTS}
    faces = array("q")
    thin = 0
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        for number, line in _joined(file):
            words = (_COMMENT.split(line, 1)[0] if "#" in line else line).split()
            try:
                if words and words[0] in tables:
                    tables[words[0]].extend(_numbers(words))
                elif words and words[0] == "f":
                    known = {name: len(tables[name]) // count for name, count in _COUNTS.items()}
                    corners = [_corner(word, known) for word in words[1:]]
                    thin += len(corners) < 3
                    faces.extend(_cut(corners, tables["v"]))
            except ValueError as error:
                raise FormatError(path, f"line {number}: {error}") from error
            if len(faces) > 9 * _MOST_TRIANGLES:
                raise FormatError(path, f"more than {_MOST_TRIANGLES} triangles")
    if not faces:
        raise FormatError(path, "no faces (lines that begin with f) of 3 corners or more")
    if thin:
        warnings.warn(f"{path}: {thin} faces of fewer than 3 corners are left out", stacklevel=2)
    return _triangles(path, tables, np.array(faces, np.intp).reshape(-1, 3, 3))


def _joined(file: Iterable[str]) -> Iterator[tuple[int, str]]:
    """Lines and their numbers, those that end in a backslash with their next."""
    held = ""
    for number, line in enumerate(file, 1):
        stripped = line.rstrip()
        if stripped.endswith("\\"):
            held += stripped[:-1] + " "
            continue
        yield number, held + line
        held = ""


def _numbers(words: list[str]) -> list[float]:
    kind, count = words[0], _COUNTS[words[0]]
    numbers = [_number(word, kind) for word in words[1 : count + 1]]
    if len(numbers) < _FEWEST[kind]:
        raise ValueError(f"{kind} has {len(numbers)} numbers; expected {count}")
    return numbers + [0.0] * (count - len(numbers))


def _number(word: str, kind: str) -> float:
    try:
        return float(word)
    except ValueError:
        if kind == "vn" and any(each in word.lower() for each in _NO_NUMBER):
            return float("nan")
        raise


def _cut(corners: list[tuple[int, int, int]], at: array[float]) -> list[int]:
    """v, vt, vn of each corner of each triangle of one polygon; -1 where there is no such index."""
    n = len(corners)
    order = [(0, i, i + 1) for i in range(1, n - 1)]
    given = n > 3 and all(3 * v + 2 < len(at) for v, _, _ in corners)
    if given and not (n == 4 and _is_folded_out(*(at[3 * v : 3 * v + 3] for v, _, _ in corners))):
        flat = _flattened(np.array([at[3 * v : 3 * v + 3] for v, _, _ in corners]))
        order = order if _is_convex(flat) else _triangulated(flat) or order
    return [index for triangle in order for corner in triangle for index in corners[corner]]


def _is_folded_out(a: Vector, b: Vector, c: Vector, d: Vector) -> bool:
    """Whether the triangles a b c and a c d face the same side; in plain Python, for many quads."""
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    wx, wy, wz = d[0] - a[0], d[1] - a[1], d[2] - a[2]
    first = (uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx)
    second = (vy * wz - vz * wy, vz * wx - vx * wz, vx * wy - vy * wx)
    return first[0] * second[0] + first[1] * second[1] + first[2] * second[2] > 0


def _flattened(points: Floats) -> Floats:
    """(n, 2) corners of a polygon (n, 3) as seen against its normal: counter-clockwise.

    Source of the normal: Newell's method.
    """
    following = np.roll(points, -1, axis=0)
    normal = np.cross(points - points[0], following - points[0]).sum(axis=0)
    axis = int(np.abs(normal).argmax())
    first, second = np.delete(np.arange(3), axis)
    # Leaving y out turns the other two around.
    mirrored = (normal[axis] < 0) != (axis == 1)
    return points[:, [second, first]] if mirrored else points[:, [first, second]]


def _is_convex(flat: Floats) -> bool:
    """Whether a fan from the first corner covers a polygon (n, 2): it turns left throughout."""
    edge = np.roll(flat, -1, axis=0) - flat
    turn = edge[:, 0] * np.roll(edge[:, 1], -1) - edge[:, 1] * np.roll(edge[:, 0], -1)
    return bool((turn >= -1e-12 * np.abs(edge).max() ** 2).all())


def _triangulated(flat: Floats) -> list[tuple[int, int, int]]:
    """Corners of the triangles of a polygon (n, 2), turning left; empty where it has no inside."""
    import mapbox_earcut

    found = mapbox_earcut.triangulate_float64(
        np.ascontiguousarray(flat, np.float64), np.array([len(flat)], np.uint32)
    ).reshape(-1, 3)
    triangles = []
    for a, b, c in found.tolist():
        (x0, y0), (x1, y1) = flat[b] - flat[a], flat[c] - flat[a]
        triangles.append((a, b, c) if x0 * y1 >= y0 * x1 else (a, c, b))
    return triangles


def _corner(word: str, known: dict[str, int]) -> tuple[int, int, int]:
    parts = [int(part) if part else 0 for part in (*word.split("/"), "", "")[:3]]
    v, vt, vn = (
        index + known[name] if index < 0 else index - 1
        for index, name in zip(parts, _COUNTS, strict=True)
    )
    if v < 0 or (parts[1] < 0 and vt < 0) or (parts[2] < 0 and vn < 0):
        raise ValueError(f"corner {word!r} names nothing that came before it")
    return v, vt, vn


def _triangles(path: Path, tables: dict[str, array[float]], faces: NDArray[np.intp]) -> Triangles:
    if (faces[..., 1] < 0).any():
        missing = int((faces[..., 1] < 0).any(axis=1).sum())
        raise FormatError(
            path,
            f"{missing} of {len(faces)} triangles have no texture coordinates (vt)",
            remedy="unwrap the mesh and export it again",
        )
    values = {}
    for column, (name, count) in enumerate(_COUNTS.items()):
        table = np.array(tables[name], float).reshape(-1, count)
        last = int(faces[..., column].max())
        if last >= len(table):
            raise FormatError(path, f"a face names {name} {last + 1}; there are {len(table)}")
        used = table[np.unique(faces[..., column][faces[..., column] >= 0])]
        if name != "vn" and not (np.abs(used) < _MOST_VALUE).all():
            raise FormatError(path, f"{name} holds values that are not finite or beyond 1e30")
        # Without normals every index is -1, and what it picks is replaced below.
        values[name] = (table if len(table) else np.zeros((1, count)))[faces[..., column]]
    corner, normal = values["v"], values["vn"]
    flat = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = np.linalg.norm(flat, axis=1)
    whole = area > 1e-14 * np.ptp(corner.reshape(-1, 3), axis=0).max() ** 2
    if not whole.any():
        raise FormatError(path, "no triangle has an area")
    with np.errstate(over="ignore"):
        length = np.linalg.norm(normal, axis=2)
    own = (faces[..., 2] < 0) | ~((length >= 1e-12) & (length < _MOST_VALUE))
    unit = normal / np.where(own, 1.0, length)[..., None]
    unit = np.where(own[..., None], (flat / np.where(whole, area, 1.0)[:, None])[:, None], unit)
    return Triangles(corner[whole], values["vt"][whole], unit[whole])
