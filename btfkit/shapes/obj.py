"""Wavefront OBJ: triangles with texture coordinates, and normals where they are given.

Read: v, vt, vn and f (polygons; v/vt, v/vt/vn; negative indices; lines continued by a backslash).
Left out: materials, groups, lines, curves, free-form surfaces, and all numbers beyond the first
three of v and vn and the first two of vt. Polygons are cut into fans from their first corner, so
they should be convex.
"""

from __future__ import annotations

import itertools
from array import array
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from btfkit.errors import FormatError

Floats = NDArray[np.floating]
_COUNTS = {"v": 3, "vt": 2, "vn": 3}
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
    with path.open(encoding="utf-8", errors="replace") as file:
        for number, line in _joined(file):
            words = line.split("#", 1)[0].split()
            try:
                if words and words[0] in tables:
                    tables[words[0]].extend(_numbers(words))
                elif words and words[0] == "f":
                    known = {name: len(tables[name]) // count for name, count in _COUNTS.items()}
                    faces.extend(_fan(words[1:], known))
            except ValueError as error:
                raise FormatError(path, f"line {number}: {error}") from error
            if len(faces) > 9 * _MOST_TRIANGLES:
                raise FormatError(path, f"more than {_MOST_TRIANGLES} triangles")
    if not faces:
        raise FormatError(path, "no faces (lines that begin with f)")
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
    count = _COUNTS[words[0]]
    numbers = [float(word) for word in words[1 : count + 1]]
    if len(numbers) < count:
        raise ValueError(f"{words[0]} has {len(numbers)} numbers; expected {count}")
    return numbers


def _fan(words: list[str], known: dict[str, int]) -> list[int]:
    """v, vt, vn of each corner of each triangle of one polygon; -1 where there is no such index."""
    if len(words) < 3:
        raise ValueError(f"a face of {len(words)} corners; expected 3 or more")
    corners = [_corner(word, known) for word in words]
    triangles = ((corners[0], *pair) for pair in itertools.pairwise(corners[1:]))
    return [index for triangle in triangles for corner in triangle for index in corner]


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
        if not (np.abs(used) < _MOST_VALUE).all():
            raise FormatError(path, f"{name} holds values that are not finite or beyond 1e30")
        # Without normals every index is -1, and what it picks is replaced below.
        values[name] = (table if len(table) else np.zeros((1, count)))[faces[..., column]]
    corner, normal = values["v"], values["vn"]
    flat = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = np.linalg.norm(flat, axis=1)
    whole = area > 1e-14 * np.ptp(corner.reshape(-1, 3), axis=0).max() ** 2
    if not whole.any():
        raise FormatError(path, "no triangle has an area")
    length = np.linalg.norm(normal, axis=2)
    own = (faces[..., 2] < 0) | (length < 1e-12)
    unit = normal / np.where(own, 1.0, length)[..., None]
    unit = np.where(own[..., None], (flat / np.where(whole, area, 1.0)[:, None])[:, None], unit)
    return Triangles(corner[whole], values["vt"][whole], unit[whole])
