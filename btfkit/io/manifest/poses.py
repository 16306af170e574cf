"""Pose manifests as text: JSON or CSV to one pose an image. What they may hold: docs/formats.md."""

from __future__ import annotations

import csv
import json
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, final

from btfkit import directions
from btfkit.errors import FormatError
from btfkit.io import numerals

Vector = tuple[float, float, float]
MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
_NUMBERS = ("exposure_s", "iso", "f", "footprint")
_MOST_NESTED = 50
# The first line of a CSV by Excel.
_SEPARATOR = re.compile(r"sep=(.)", re.IGNORECASE)


@final
@dataclass(frozen=True)
class End:
    """Where a light or a viewer is: a direction, a position in mm, or both."""

    direction: Vector | None
    position_mm: Vector | None


@final
@dataclass(frozen=True)
class Pose:
    """One image: its file, its light, its view (None: from above) and what else is known."""

    file: str
    light: End
    view: End | None
    variance: str | None = None
    numbers: Mapping[str, float] = field(default_factory=dict)


def from_json(path: str, text: str) -> tuple[dict[str, Any], list[Pose]]:
    """What a JSON manifest says about all images, and its poses.

    Raises:
        FormatError: not JSON, or an entry that is none; the message names it.
    """
    try:
        whole = json.loads(text, parse_constant=_refused, object_pairs_hook=_once)
    except (ValueError, RecursionError) as error:
        raise FormatError(path, f"not JSON ({error})") from error
    if not isinstance(whole, dict) or not isinstance(whole.get("images"), list):
        raise FormatError(path, "holds no list called images")
    if _nested(whole) > _MOST_NESTED:
        raise FormatError(path, f"is nested more than {_MOST_NESTED} deep")
    if whole.get("version", 1) != 1:
        raise FormatError(path, f"version {whole['version']!r}; expected 1", remedy="update btfkit")
    units = whole.get("units", "mm")
    if not isinstance(units, str) or units not in MM:
        raise FormatError(path, f"units {units!r}; expected one of {', '.join(MM)}")
    if whole.get("frame", "surface") != "surface":
        raise FormatError(
            path,
            f"frame {whole['frame']!r}; expected surface",
            remedy="x right along the columns, y up, z out of the sample",
        )
    entries = enumerate(whole["images"])
    return whole, [_json_pose(path, f"images[{i}]", entry, MM[units]) for i, entry in entries]


def _json_pose(path: str, where: str, entry: Any, mm: float) -> Pose:
    if not isinstance(entry, dict) or not isinstance(entry.get("file"), str):
        raise FormatError(path, f"{where} names no file")

    def end(name: str) -> End:
        value = entry[name]
        parts = value if isinstance(value, dict) else {"dir": value}
        if not parts.keys() & {"dir", "pos"}:
            raise FormatError(path, f"{where}.{name} has neither dir nor pos")
        to, at = (
            _vector(path, f"{where}.{name}.{key}", parts[key]) if key in parts else None
            for key in ("dir", "pos")
        )
        return End(to, None if at is None else (at[0] * mm, at[1] * mm, at[2] * mm))

    if "light" not in entry:
        raise FormatError(path, f"{where} has no light")
    numbers = {
        key: _number(path, f"{where}.{key}", entry[key])
        for key in _NUMBERS
        if entry.get(key) is not None
    }
    variance = entry.get("variance")
    if variance is not None and not isinstance(variance, str):
        raise FormatError(path, f"{where}.variance is no file name")
    view = end("view") if "view" in entry else None
    return Pose(entry["file"], end("light"), view, variance, numbers)


def csv_columns(text: str) -> list[str]:
    """Column names of a CSV manifest; empty unless it has a file and a light."""
    names = _Table.of(text).names
    lit = _end_reader(names, "l") is not None
    return names if "file" in names and lit and len(set(names)) == len(names) else []


def from_csv(path: str, text: str) -> list[Pose]:
    """The poses of a CSV manifest, as spreadsheets write it: see `_Table`.

    Raises:
        FormatError: no file or light columns, or a line that has not what they say.
    """
    names = csv_columns(text)
    light = _end_reader(names, "l")
    if light is None:
        raise FormatError(
            path, "the first line names no columns file and tl, pl or lx, ly, lz or lx_mm, ..."
        )
    view = _end_reader(names, "v")
    poses = []
    for where, row in _Table.of(text).rows(path):
        numbers = {
            key: _number(path, f"{where}: {key}", row[key]) for key in _NUMBERS if row.get(key)
        }
        poses.append(
            Pose(
                row["file"],
                light(path, where, row),
                view(path, where, row) if view else None,
                None,
                numbers,
            )
        )
    return poses


@final
@dataclass(frozen=True)
class _Table:
    """A table as text, from whatever program and country.

    Lines end in LF, CR or both. Excel's line `sep=;` names the separator; else the first line does,
    by what stands in it most. Empty cells behind the last name are padding.
    """

    names: list[str]
    delimiter: str
    lines: list[str]
    first: int

    @classmethod
    def of(cls, text: str) -> _Table:
        lines = text.splitlines() or [""]
        at = next((i for i, line in enumerate(lines) if line.strip()), 0)
        named = _SEPARATOR.fullmatch(lines[at].strip(' "\ufeff'))
        at += named is not None
        head = lines[at].lstrip("\ufeff") if at < len(lines) else ""
        delimiter = named[1] if named else max(",;\t", key=head.count)
        names = [name.strip().strip('"').strip().lower() for name in head.split(delimiter)]
        while names and not names[-1]:
            names.pop()
        return cls(names, delimiter, lines[at + 1 :], at + 2)

    def rows(self, path: str) -> Iterator[tuple[str, dict[str, str]]]:
        """Where each row stands, and its cells by their names."""
        try:
            for number, cells in enumerate(csv.reader(self.lines, delimiter=self.delimiter)):
                if not any(cell.strip() for cell in cells):
                    continue
                where, wanted = f"line {number + self.first}", len(self.names)
                if len(cells) < wanted or any(cell.strip() for cell in cells[wanted:]):
                    raise FormatError(path, f"{where} has {len(cells)} cells; expected {wanted}")
                row = {name: cell.strip() for name, cell in zip(self.names, cells, strict=False)}
                if self.delimiter == ",":
                    _refuse_groups(path, where, row)
                yield where, row
        except csv.Error as error:
            raise FormatError(path, f"not CSV ({error})") from error


def _refuse_groups(path: str, where: str, row: Mapping[str, str]) -> None:
    """Where commas separate, one within a quoted number may group its thousands."""
    for name, cell in row.items():
        if name != "file" and numerals.is_grouped(cell):
            raise FormatError(
                path, f"{where}: {name} is {cell!r}, a thousand or a decimal comma",
                remedy="write it with a point",
            )  # fmt: skip


def _end_reader(names: list[str], end: str) -> Callable[[str, str, Mapping[str, str]], End] | None:
    """What reads the light ("l") or view ("v") columns of a row; None without such columns."""
    angles = [f"t{end}", f"p{end}"]
    if set(angles) <= set(names):

        def from_angles(path: str, where: str, row: Mapping[str, str]) -> End:
            theta, phi = (math.radians(_number(path, f"{where}: {a}", row[a])) for a in angles)
            x, y, z = directions.from_angles(theta, phi).tolist()
            return End((x, y, z), None)

        return from_angles
    for suffix, mm in (("", None), *((f"_{unit}", factor) for unit, factor in MM.items())):
        columns = [f"{end}{axis}{suffix}" for axis in "xyz"]
        if set(columns) <= set(names):

            def from_vector(
                path: str,
                where: str,
                row: Mapping[str, str],
                columns: list[str] = columns,
                mm: float | None = mm,
            ) -> End:
                vector = _vector(path, where, [row[column] for column in columns])
                if mm is None:
                    return End(vector, None)
                return End(None, (vector[0] * mm, vector[1] * mm, vector[2] * mm))

            return from_vector
    return None


def _refused(constant: str) -> float:
    raise ValueError(f"{constant} is no JSON number")


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """The object of a list of pairs; a key twice would lose one in silence."""
    found = dict(pairs)
    if len(found) < len(pairs):
        counts = Counter(name for name, _ in pairs)
        again = next(name for name, count in counts.items() if count > 1)
        raise ValueError(f"the key {again[:60]!r} stands twice in one object")
    return found


def _nested(value: dict[str, Any]) -> int:
    """Levels of lists and objects, counted no further than is too many."""
    level: list[Any] = [value]
    depth = 0
    while level and depth <= _MOST_NESTED:
        inner = (each.values() if isinstance(each, dict) else each for each in level)
        level = [item for each in inner for item in each if isinstance(item, (dict, list))]
        depth += 1
    return depth


def _vector(path: str, where: str, value: Any) -> Vector:
    if not isinstance(value, list) or len(value) != 3:
        raise FormatError(path, f"{where} is {str(value)[:60]}; expected three numbers")
    x, y, z = (_number(path, where, part) for part in value)
    return x, y, z


def _number(path: str, where: str, value: Any) -> float:
    plain = isinstance(value, (int, float)) and not isinstance(value, bool)
    try:
        number = float(value) if plain else math.nan
    except OverflowError:
        number = math.nan
    if isinstance(value, str):
        number = found if (found := numerals.number(value.strip())) is not None else math.nan
    if not math.isfinite(number):
        raise FormatError(path, f"{where} is {str(value)[:60]!r}; expected a number")
    return number
