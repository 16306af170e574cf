"""The table of a sequence: one line a frame, as CSV that anybody can write.

    file,kind,axis:turntable,axis:light_arm,exposure_s,lamp,group
    frames/00000.png,sample,90,30,0.02,1.0,4

Rotary axes are degrees in the file and radians in memory; linear axes are mm in both.
"""

from __future__ import annotations

import csv
import io
import math
import posixpath
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

from btfkit.errors import CalibrationError, FormatError

# "sample" is what is measured; the others serve the calibration. "reference" repeats one pose
# and one exposure during the run: its changes are the drift.
KINDS = ("sample", "dark", "flat", "white", "colour", "target", "sphere", "reference")
Vector = tuple[float, float, float]
_AXIS = "axis:"
_NUMBERS = ("exposure_s", "iso", "lamp", "time_s", "temperature_c")
_POSITIVE = ("exposure_s", "iso")
_VECTORS = ("light", "view")


@final
@dataclass(frozen=True)
class Frame:
    """One raw exposure.

    Attributes:
        file: POSIX path within the folder. kind: one of `KINDS`.
        axes: angle of each rotary axis, radians, and place of each linear one, mm.
        light, view: unit vectors in the sample's frame, where the writer knew them.
        exposure_s, iso: None where not said. lamp: reading of its monitor, relative, ~0 if dark.
        time_s: since the start of the run. temperature_c: of the sensor.
        group: exposures of one pose share it.
        sha256: of the file. extra: columns that this version does not know.
    """

    file: str
    kind: str
    axes: Mapping[str, float] = field(default_factory=dict)
    light: Vector | None = None
    view: Vector | None = None
    exposure_s: float | None = None
    iso: float | None = None
    lamp: float | None = None
    time_s: float | None = None
    temperature_c: float | None = None
    group: int | None = None
    sha256: str | None = None
    extra: Mapping[str, str] = field(default_factory=dict)

    def need(self, name: str) -> Any:
        """The attribute `name`.

        Raises:
            CalibrationError: the frame does not have it.
        """
        value = getattr(self, name)
        if value is None or (name == "axes" and not value):
            raise CalibrationError(
                f"{self.file} has no {name}", remedy="add it to its line of the sequence's table"
            )
        return value


def parse_table(
    path: Path, text: str, *, linear: Iterable[str] = ()
) -> tuple[tuple[Frame, ...], tuple[str, ...]]:
    """Frames of a sequence.csv, and the optional columns that it lacks.

    Args:
        path: for messages. text: of the table.
        linear: axes whose columns are mm; those of all others are degrees.

    Raises:
        FormatError: no file and kind column, or a line that has not what the columns say.
    """
    rows = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        names = [cell.strip() for cell in next(rows, [])]
        _check_columns(path, names)
        frames = []
        for cells in rows:
            if any(cell.strip() for cell in cells):
                where = f"line {rows.line_num}"
                if len(cells) != len(names):
                    raise FormatError(
                        path, f"{where} has {len(cells)} cells; expected {len(names)}"
                    )
                row = {n: cell.strip() for n, cell in zip(names, cells, strict=True)}
                frames.append(_frame(path, where, row, frozenset(linear)))
    except csv.Error as error:
        raise FormatError(path, f"not CSV ({error})") from error
    if not frames:
        raise FormatError(path, "lists no frame")
    files = [frame.file for frame in frames]
    if len(set(files)) < len(files):
        again = next(file for file in files if files.count(file) > 1)
        raise FormatError(path, f"lists {again!r} twice", remedy="remove one line")
    known = (*_NUMBERS, "group", "sha256")
    return tuple(frames), tuple(name for name in known if name not in names)


def format_table(frames: Iterable[Frame], *, linear: Iterable[str] = ()) -> str:
    """The text of a sequence.csv; the inverse of `parse_table`."""
    listed = tuple(frames)
    mm = frozenset(linear)
    axes = list(dict.fromkeys(name for frame in listed for name in frame.axes))
    extra = list(dict.fromkeys(name for frame in listed for name in frame.extra))
    vectors = [n for n in _VECTORS if any(getattr(f, n) is not None for f in listed)]
    columns = [f"{name}_{part}" for name in vectors for part in "xyz"]
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    head = [
        "file",
        "kind",
        *(_AXIS + axis for axis in axes),
        *columns,
        *_NUMBERS,
        "group",
        "sha256",
    ]
    writer.writerow(head + extra)
    for frame in listed:
        cells: list[Any] = [frame.file, frame.kind]
        for axis in axes:
            value = frame.axes.get(axis)
            degrees = value if value is None or axis in mm else _degrees(value)
            cells.append(_cell(degrees))
        for name in vectors:
            vector = getattr(frame, name)
            cells += ["", "", ""] if vector is None else [_cell(part) for part in vector]
        cells += [_cell(getattr(frame, name)) for name in (*_NUMBERS, "group", "sha256")]
        writer.writerow(cells + [frame.extra.get(name, "") for name in extra])
    return out.getvalue()


def _check_columns(path: Path, names: list[str]) -> None:
    for required in ("file", "kind"):
        if required not in names:
            raise FormatError(path, f"the first line names no column {required!r}: {names[:12]}")
    if len(set(names)) < len(names):
        again = next(name for name in names if names.count(name) > 1)
        raise FormatError(path, f"the column {again!r} stands twice")
    for name in _VECTORS:
        parts = [f"{name}_{part}" for part in "xyz"]
        there = [part for part in parts if part in names]
        if there and there != [n for n in names if n in parts]:
            raise FormatError(path, f"columns {', '.join(parts)} are out of order")
        if 0 < len(there) < 3:
            raise FormatError(path, f"has {', '.join(there)}; expected {', '.join(parts)}")


def _frame(path: Path, where: str, row: Mapping[str, str], linear: frozenset[str]) -> Frame:
    file, kind = row["file"].replace("\\", "/"), row["kind"].lower()
    inside = posixpath.normpath(file)
    if not file or inside.startswith(("/", "..")) or ":" in inside.split("/")[0]:
        raise FormatError(path, f"{where}: {file!r} is no file within the folder")
    if kind not in KINDS:
        raise FormatError(path, f"{where}: kind {kind!r}; expected one of {', '.join(KINDS)}")
    axes = {}
    for name, cell in row.items():
        if name.startswith(_AXIS) and cell:
            value = _number(path, f"{where}: {name}", cell)
            axis = name.removeprefix(_AXIS)
            axes[axis] = value if axis in linear else math.radians(value)
    vectors = {name: _vector(path, where, name, row) for name in _VECTORS}
    numbers = {n: _number(path, f"{where}: {n}", row[n]) for n in _NUMBERS if row.get(n)}
    for name in _POSITIVE:
        if numbers.get(name, 1) <= 0:
            raise FormatError(path, f"{where}: {name} is {row[name]}; expected more than 0")
    group = _number(path, f"{where}: group", row["group"]) if row.get("group") else None
    if group is not None and (group != int(group) or group < 0):
        raise FormatError(path, f"{where}: group is {row['group']!r}; expected a whole number")
    vector_columns = {f"{name}_{part}" for name in _VECTORS for part in "xyz"}
    known = {"file", "kind", "group", "sha256", *_NUMBERS, *vector_columns}
    return Frame(
        file=inside,
        kind=kind,
        axes=axes,
        light=vectors["light"],
        view=vectors["view"],
        group=None if group is None else int(group),
        sha256=row.get("sha256", "").lower() or None,
        extra={n: c for n, c in row.items() if n not in known and not n.startswith(_AXIS)},
        **numbers,
    )


def _vector(path: Path, where: str, name: str, row: Mapping[str, str]) -> Vector | None:
    cells = [row.get(f"{name}_{part}", "") for part in "xyz"]
    if not any(cells):
        return None
    x, y, z = (_number(path, f"{where}: {name}", cell) for cell in cells)
    length = math.sqrt(x * x + y * y + z * z)
    if not 1e-6 < length < math.inf:
        raise FormatError(path, f"{where}: {name} ({x:g}, {y:g}, {z:g}) is no direction")
    return x / length, y / length, z / length


def _number(path: Path, where: str, cell: str) -> float:
    try:
        # Python reads 1_5 as 15.
        number = math.nan if "_" in cell else float(cell)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise FormatError(path, f"{where} is {cell[:60]!r}; expected a number")
    return number


def _degrees(radians: float) -> float:
    """Degrees that read back as the same radians, and round ones where there are such."""
    degrees = math.degrees(radians)
    short = round(degrees, 9)
    return short if math.radians(short) == radians else degrees


def _cell(value: float | int | str | None) -> str:
    return "" if value is None else str(value)
