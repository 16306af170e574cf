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
from collections.abc import Iterable, Iterator
from itertools import groupby, islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit.errors import FormatError
from btfkit.shapes.polygons import cut
from btfkit.shapes.triangles import COUNTS, MOST_BYTES, MOST_TRIANGLES, Triangles, gathered

_FEWEST = {"v": 3, "vt": 1, "vn": 3}
# What exporters print for a number that is none, beside nan: of Microsoft's and of others' C.
_NO_NUMBER = ("nan", "#ind", "#qnan", "#snan", "#inf")
# 1.#QNAN holds no comment.
_COMMENT = re.compile(r"(?:^|\s)#")
# Lines of one kind in a row that are read at once where each has the plain form.
_RUN = 1 << 14
_SIZED = r"[-+.0-9eE]+"
_PLAIN = {
    "v": re.compile(rf"(?:v(?:[ \t]+{_SIZED}){{3}}\s*\n)++"),
    "vt": re.compile(rf"(?:vt(?:[ \t]+{_SIZED}){{2}}\s*\n)++"),
    "vn": re.compile(rf"(?:vn(?:[ \t]+{_SIZED}){{3}}\s*\n)++"),
}
_PLAIN_FACES = {
    form: re.compile(rf"(?:f(?:[ \t]+{corner}){{3}}[ \t\r]*\n)++")
    for form, corner in ((2, r"[1-9]\d*/[1-9]\d*"), (3, r"[1-9]\d*/[1-9]\d*/[1-9]\d*"))
}
_NAMES = str.maketrans(dict.fromkeys("fvtn/", " "))


def read(path: Path) -> Triangles:
    """The triangles of an OBJ; those without area are left out.

    Raises:
        FileNotFoundError: there is no such file.
        FormatError: damaged, too large, without faces, or without texture coordinates.
    """
    size = path.stat().st_size
    if size > MOST_BYTES:
        raise FormatError(path, f"{size} bytes; at most {MOST_BYTES} are read")
    # Plain arrays of numbers: lists of lists would take ten times their memory.
    tables = {name: array("d") for name in COUNTS}
    faces = array("q")
    thin = 0
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        for run in _runs(file):
            if _taken_at_once(run, tables, faces):
                continue
            for number, line in run:
                words = (_COMMENT.split(line, 1)[0] if "#" in line else line).split()
                try:
                    if words and words[0] in tables:
                        tables[words[0]].extend(_numbers(words))
                    elif words and words[0] == "f":
                        known = {name: len(tables[name]) // n for name, n in COUNTS.items()}
                        corners = [_corner(word, known) for word in words[1:]]
                        thin += len(corners) < 3
                        faces.extend(_cut(corners, tables["v"]))
                except (ValueError, OverflowError) as error:
                    raise FormatError(path, f"line {number}: {error}") from error
            if len(faces) > 9 * MOST_TRIANGLES:
                raise FormatError(path, f"more than {MOST_TRIANGLES} triangles")
    if not faces:
        raise FormatError(path, "no faces (lines that begin with f) of 3 corners or more")
    if thin:
        warnings.warn(f"{path}: {thin} faces of fewer than 3 corners are left out", stacklevel=2)
    arrays = {name: np.array(tables[name], float).reshape(-1, n) for name, n in COUNTS.items()}
    return gathered(path, arrays, np.array(faces, np.intp).reshape(-1, 3, 3))


def _runs(file: Iterable[str]) -> Iterator[list[tuple[int, str]]]:
    """Lines and their numbers, those of one kind in a row together, `_RUN` at most."""
    for _, lines in groupby(_joined(file), key=lambda pair: pair[1][:2]):
        while run := list(islice(lines, _RUN)):
            yield run


def _taken_at_once(
    run: list[tuple[int, str]], tables: dict[str, array[float]], faces: array[int]
) -> bool:
    """Whether a run of lines was of the plain form, and has been added."""
    if len(run) < 16:
        return False
    words = run[0][1].split(None, 1)
    if not words or (words[0] not in _PLAIN and words[0] != "f"):
        return False
    text = "".join(line for _, line in run)
    if words[0] in _PLAIN:
        if not _PLAIN[words[0]].fullmatch(text):
            return False
        numbers = _all_numbers(text, float, len(run) * COUNTS[words[0]])
        if numbers is not None:
            tables[words[0]].frombytes(numbers.tobytes())
        return numbers is not None
    for form, plain in _PLAIN_FACES.items():
        if plain.fullmatch(text):
            numbers = _all_numbers(text, np.int64, len(run) * 3 * form)
            if numbers is None:
                return False
            corners = np.full((len(run) * 3, 3), -1, np.int64)
            corners[:, :form] = numbers.reshape(-1, form) - 1
            faces.frombytes(corners.tobytes())
            return True
    return False


def _all_numbers(text: str, kind: type, count: int) -> NDArray[Any] | None:
    """`count` numbers between the names of lines; None where some are no numbers."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        try:
            numbers: NDArray[Any] = np.fromstring(text.translate(_NAMES), kind, sep=" ")
        except (DeprecationWarning, ValueError):
            return None
    return numbers if len(numbers) == count else None


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
    kind, count = words[0], COUNTS[words[0]]
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


def _corner(word: str, known: dict[str, int]) -> tuple[int, int, int]:
    parts = [int(part) if part else 0 for part in (*word.split("/"), "", "")[:3]]
    v, vt, vn = (
        index + known[name] if index < 0 else index - 1
        for index, name in zip(parts, COUNTS, strict=True)
    )
    if v < 0 or (parts[1] < 0 and vt < 0) or (parts[2] < 0 and vn < 0):
        raise ValueError(f"corner {word!r} names nothing that came before it")
    return v, vt, vn


def _cut(corners: list[tuple[int, int, int]], at: array[float]) -> list[int]:
    """v, vt, vn of each corner of each triangle of one polygon; -1 where there is no such index."""
    n = len(corners)
    order = [(0, i, i + 1) for i in range(1, n - 1)]
    if n > 3 and all(3 * v + 2 < len(at) for v, _, _ in corners):
        order = cut([at[3 * v : 3 * v + 3] for v, _, _ in corners])
    return [index for triangle in order for corner in triangle for index in corners[corner]]
