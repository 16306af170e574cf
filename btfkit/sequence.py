"""A sequence: raw frames of a rig, each with pose, exposure and time, in an open folder.

    sequence.csv   one line a frame: file, kind, axis:NAME (degrees), light_x..z, view_x..z, ...
    sequence.json  {"version": 1, "sensor": {...}, "rig": {...}, "target": {...}}
    frames/        any image format or RAW, counts as the sensor gave them

Anybody can write one; only `file` and `kind` are required. What a stage needs and does not
find, that stage names. docs/capture.md has every column and key.
"""

from __future__ import annotations

import hashlib
import shlex
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, final

from btfkit import counts, documents
from btfkit.counts import Counts
from btfkit.errors import CalibrationError, FormatError
from btfkit.files import whole
from btfkit.frametable import KINDS, Frame, format_table, parse_table

__all__ = ["CFAS", "DOCUMENT", "KINDS", "TABLE", "VERSION", "Frame", "Sensor", "Sequence", "save"]

TABLE, DOCUMENT = "sequence.csv", "sequence.json"
VERSION = 1
CFAS = ("none", "RGGB", "BGGR", "GRBG", "GBRG")


@final
@dataclass(frozen=True)
class Sensor:
    """What is known of the sensor; None where the sequence does not say.

    Attributes:
        width, height: pixels. bits: of a count.
        black, white: counts of no light and of saturation.
        cfa: colours of the mosaic's first 2 x 2 pixels, row by row; "none" for mono or RGB.
        gain_e_per_dn: electrons a count. read_noise_e: electrons rms.
        transfer: "linear", or what code values mean ("srgb" for ordinary JPEGs).
    """

    width: int | None = None
    height: int | None = None
    bits: int | None = None
    black: float | None = None
    white: float | None = None
    cfa: str = "none"
    gain_e_per_dn: float | None = None
    read_noise_e: float | None = None
    transfer: str = "linear"

    def need(self, name: str) -> Any:
        """The attribute `name`.

        Raises:
            CalibrationError: the sequence does not say it.
        """
        value = getattr(self, name)
        if value is None:
            raise CalibrationError(
                f"{DOCUMENT} says no sensor.{name}", remedy=f"add it under sensor in {DOCUMENT}"
            )
        return value


@final
@dataclass(frozen=True, eq=False)
class Sequence:
    """A lazily read folder of frames.

    Attributes:
        path: the folder.
        frames: in the order of the table.
        sensor: what is known of it.
        rig, target: sections of sequence.json as they stand; empty where there are none.
        document: the whole of sequence.json.
        missing: optional columns that the table lacks.
    """

    path: Path
    frames: tuple[Frame, ...]
    sensor: Sensor = field(default_factory=Sensor)
    rig: Mapping[str, Any] = field(default_factory=dict)
    target: Mapping[str, Any] = field(default_factory=dict)
    document: Mapping[str, Any] = field(default_factory=dict)
    missing: tuple[str, ...] = ()

    @staticmethod
    def open(path: str | Path) -> Sequence:
        """The sequence in a folder; frames are read when they are asked for.

        Raises:
            FileNotFoundError: no folder, or no sequence.csv in it.
            FormatError: a table or a document that is not what docs/capture.md says.
        """
        folder = Path(path)
        table = folder / TABLE
        if not table.is_file():
            raise FileNotFoundError(f"{table} is not there; a sequence has one line a frame in it")
        document = documents.load(folder / DOCUMENT) if (folder / DOCUMENT).exists() else {}
        if document.get("version", VERSION) != VERSION:
            raise FormatError(
                folder / DOCUMENT,
                f"version {document['version']!r}; expected {VERSION}",
                remedy="update btfkit",
            )
        rig = _section(folder, document, "rig")
        linear = {
            str(axis.get("name"))
            for axis in rig.get("axes", ())
            if isinstance(axis, dict) and axis.get("kind") == "linear"
        }
        text = table.read_text(encoding="utf-8-sig")
        frames, missing = parse_table(table, text, linear=linear)
        stated = _section(folder, document, "sensor")
        return Sequence(
            path=folder,
            frames=frames,
            sensor=_sensor(folder, {**_of_raw(folder, frames, stated), **stated}),
            rig=rig,
            target=_section(folder, document, "target"),
            document=document,
            missing=missing,
        )

    def __len__(self) -> int:
        return len(self.frames)

    def of_kind(self, *kinds: str) -> tuple[int, ...]:
        """Indices of the frames of these kinds, in order."""
        return tuple(i for i, frame in enumerate(self.frames) if frame.kind in kinds)

    def groups(self, *kinds: str) -> dict[int, tuple[int, ...]]:
        """Indices of the frames of each group; a frame without one is a group of its own (< 0)."""
        found: dict[int, list[int]] = {}
        for i in self.of_kind(*kinds):
            group = self.frames[i].group
            found.setdefault(-1 - i if group is None else group, []).append(i)
        return {group: tuple(members) for group, members in found.items()}

    @cached_property
    def frame_size(self) -> tuple[int, int]:
        """(h, w) of the sensor; where the document does not say it, of the first frame there is."""
        sensor = self.sensor
        if sensor.height is not None and sensor.width is not None:
            return sensor.height, sensor.width
        there = (i for i, frame in enumerate(self.frames) if (self.path / frame.file).is_file())
        h, w = self.image(next(there, 0)).shape[:2]
        return h, w

    def image(self, index: int) -> Counts:
        """(h, w) or (h, w, 3) counts of a frame, uint8, uint16 or float32, as its file has them.

        Raises:
            FormatError: missing, damaged, another hash than the table says, or another size than
                the sensor's.
        """
        frame = self.frames[index]
        path = self.path / frame.file
        try:
            data = path.read_bytes()
        except OSError as error:
            raise FormatError(
                path, f"cannot be read ({error.strerror})",
                remedy=f"copy it again, or take its line out of {TABLE}",
            ) from error  # fmt: skip
        if frame.sha256 is not None and hashlib.sha256(data).hexdigest() != frame.sha256:
            raise FormatError(
                path, f"is not the file that {TABLE} lists: its SHA-256 differs",
                remedy="copy it again, or clear the column sha256 if it was changed on purpose",
            )  # fmt: skip
        image = counts.read(str(path), data)
        h, w = image.shape[:2]
        expected = (self.sensor.height or h, self.sensor.width or w)
        if (h, w) != expected:
            raise FormatError(
                path, f"has {w} x {h} pixels; the sensor has {expected[1]} x {expected[0]}",
                remedy=f"correct sensor in {DOCUMENT}, or leave the frame out of {TABLE}",
            )  # fmt: skip
        return image


def refuse_unended(folder: Path) -> None:
    """Refuse the folder of a run that our own engine has begun and not ended.

    Raises:
        FormatError: says how to go on with it.
    """
    begun = all((folder / name).is_file() for name in ("journal.jsonl", "plan.json"))
    if begun and not (folder / TABLE).is_file():
        device = "mock" if (folder / "twin.jsonl").is_file() else "usb"
        raise FormatError(
            folder, "a run of captures that has not ended",
            remedy=f"btfkit capture --device {device} --resume -o {shlex.quote(str(folder))} goes "
            "on with it",
        )  # fmt: skip


def save(
    folder: Path, frames: Iterable[Frame], document: Mapping[str, Any], *, force: bool = False
) -> None:
    """Write sequence.csv and sequence.json of a folder whose frames are there."""
    axes = document.get("rig", {}).get("axes", ())
    linear = {axis["name"] for axis in axes if axis.get("kind") == "linear"}
    documents.save(folder / DOCUMENT, {"version": VERSION, **document}, force=force)
    with whole(folder / TABLE, force=force) as partial:
        partial.write_text(format_table(frames, linear=linear), encoding="utf-8")


# Parts of a section that are objects, and lists of them.
_OBJECTS = {"rig": ("camera", "light", "carries"), "target": ("sample", "white", "board")}
_LISTS = {"rig": ("axes",), "target": ("patches", "spheres")}


def _section(folder: Path, document: Mapping[str, Any], name: str) -> dict[str, Any]:
    section = document.get(name, {})
    if not isinstance(section, dict):
        raise FormatError(folder / DOCUMENT, f"{name} is {str(section)[:40]}; expected an object")
    for part, value in section.items():
        if part in _LISTS.get(name, ()):
            good = isinstance(value, list) and all(isinstance(each, dict) for each in value)
            expected = "a list of objects"
        else:
            good = isinstance(value, dict) or part not in _OBJECTS.get(name, ())
            expected = "an object"
        if not good:
            said = f"{name}.{part} is {str(value)[:40]}; expected {expected}"
            raise FormatError(folder / DOCUMENT, said)
    return section


def _of_raw(folder: Path, frames: tuple[Frame, ...], stated: Mapping[str, Any]) -> dict[str, Any]:
    """What the first RAW frame says of its sensor, where the document does not say it all."""
    wanted = {"width", "height", "black", "white", "cfa"}
    raw = [frame.file for frame in frames if Path(frame.file).suffix.lower() in counts.RAW]
    if not raw or wanted <= stated.keys():
        return {}
    path = folder / raw[0]
    if not path.is_file():
        return {}
    file = counts.read_raw(str(path), path.read_bytes())
    height, width = file.mosaic.shape
    return {"width": width, "height": height, "black": float(file.black.mean()),
            "white": file.white, "cfa": file.cfa}  # fmt: skip


def _sensor(folder: Path, section: Mapping[str, Any]) -> Sensor:
    path = folder / DOCUMENT
    whole_numbers = ("width", "height", "bits")
    numbers = (*whole_numbers, "black", "white", "gain_e_per_dn", "read_noise_e")
    values: dict[str, Any] = {}
    for name in numbers:
        value = section.get(name)
        if value is None:
            continue
        good = isinstance(value, (int, float)) and not isinstance(value, bool) and value >= 0
        if not good or (name in whole_numbers and (value != int(value) or value < 1)):
            raise FormatError(path, f"sensor.{name} is {value!r}; expected a number of the sensor")
        values[name] = int(value) if name in whole_numbers else float(value)
    black, white = values.get("black"), values.get("white")
    if black is not None and white is not None and black >= white:
        raise FormatError(path, f"sensor.black {black:g} is not below sensor.white {white:g}")
    cfa = str(section.get("cfa", "none"))
    if cfa not in CFAS:
        raise FormatError(path, f"sensor.cfa {cfa!r}; expected one of {', '.join(CFAS)}")
    return Sensor(cfa=cfa, transfer=str(section.get("transfer", "linear")), **values)
