"""The calibration of a sequence as a document: one section a stage, each with what it came from.

    calibration.json       {"version": 1, "sections": {"radiometry": {"inputs": SHA-256, ...}}, ...}
    calibration.maps.npz   maps of the sensor, float32; the JSON holds its SHA-256

A section whose inputs' hash is unchanged is not made again.
"""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit import documents
from btfkit.errors import CalibrationError, FormatError
from btfkit.files import whole

Maps = Mapping[str, NDArray[Any]]
NAME, VERSION = "calibration.json", 1


@final
@dataclass(frozen=True, eq=False)
class Section:
    """What one stage found.

    Attributes:
        inputs: SHA-256 over the frames and settings it came from.
        data: its figures, in JSON's own types.
        maps: arrays by name that go into the .npz.
    """

    inputs: str
    data: Mapping[str, Any]
    maps: Maps = field(default_factory=dict)


@final
@dataclass(frozen=True, eq=False)
class Calibration:
    """All that is known of a sequence's rig.

    Attributes:
        sections: by stage. missing: stages that could not be made, and why.
    """

    sections: Mapping[str, Section] = field(default_factory=dict)
    missing: Mapping[str, str] = field(default_factory=dict)

    def section(self, name: str) -> Section:
        """The section of a stage.

        Raises:
            CalibrationError: there is none, saying why.
        """
        if name not in self.sections:
            why = self.missing.get(name, "the stage has not run")
            raise CalibrationError(f"the calibration has no section {name!r}: {why}")
        return self.sections[name]

    def fresh(self, name: str, inputs: str) -> Section | None:
        """The section, if it came from these inputs."""
        found = self.sections.get(name)
        return found if found is not None and found.inputs == inputs else None

    def with_section(self, name: str, section: Section) -> Calibration:
        """The same with a section added or replaced."""
        missing = {k: v for k, v in self.missing.items() if k != name}
        return replace(self, sections={**self.sections, name: section}, missing=missing)

    def without(self, name: str, why: str) -> Calibration:
        """The same without a section, and the reason."""
        sections = {k: v for k, v in self.sections.items() if k != name}
        return replace(self, sections=sections, missing={**self.missing, name: why})

    def save(self, path: Path, *, force: bool = False) -> None:
        """Write the document and, where there are maps, the .npz beside it, each whole."""
        maps = {
            f"{name}/{key}": np.asarray(value)
            for name, section in self.sections.items()
            for key, value in section.maps.items()
        }
        digest = None
        if maps:
            beside = maps_path(path)
            with whole(beside, force=force) as partial:
                # Plain members: compressed noise is hardly smaller.
                np.savez(partial, **maps)  # type: ignore[arg-type]
                digest = hashlib.sha256(partial.read_bytes()).hexdigest()
        document = {
            "version": VERSION,
            "maps_sha256": digest,
            "sections": {
                name: {"inputs": section.inputs, "maps": sorted(section.maps), **section.data}
                for name, section in self.sections.items()
            },
            "missing": dict(self.missing),
        }
        documents.save(path, document, force=force)

    @staticmethod
    def load(path: Path) -> Calibration:
        """The calibration that `save` wrote.

        Raises:
            FileNotFoundError: there is none.
            FormatError: no such document, or maps that are not those it was written with.
        """
        document = documents.load(path)
        if document.get("version") != VERSION:
            raise FormatError(
                path, f"version {document.get('version')!r}; expected {VERSION}",
                remedy="run btfkit calibrate again with --force",
            )  # fmt: skip
        entries, missing = document.get("sections"), document.get("missing", {})
        if not isinstance(entries, dict) or not isinstance(missing, dict):
            raise FormatError(path, "holds no sections")
        maps = _maps(path, document.get("maps_sha256"))
        sections = {}
        for name, entry in entries.items():
            if not isinstance(entry, dict) or not isinstance(entry.get("inputs"), str):
                raise FormatError(path, f"section {name!r} has no inputs")
            data = {k: v for k, v in entry.items() if k not in ("inputs", "maps")}
            names = entry.get("maps", [])
            lost = [key for key in names if f"{name}/{key}" not in maps]
            if lost:
                raise FormatError(
                    maps_path(path), f"lacks {name}/{lost[0]}", remedy="run btfkit calibrate again"
                )
            sections[name] = Section(
                entry["inputs"], data, {key: maps[f"{name}/{key}"] for key in names}
            )
        return Calibration(sections, {str(k): str(v) for k, v in missing.items()})


def maps_path(path: Path) -> Path:
    """The .npz beside a document."""
    return path.with_name(f"{path.stem}.maps.npz")


def _maps(path: Path, digest: Any) -> dict[str, NDArray[Any]]:
    if digest is None:
        return {}
    beside = maps_path(path)
    remedy = "copy it from where the document came from, or run btfkit calibrate again"
    if not beside.is_file():
        raise FormatError(beside, "is not there", remedy=remedy)
    if hashlib.sha256(beside.read_bytes()).hexdigest() != digest:
        raise FormatError(
            beside, "is not the file that the document was written with", remedy=remedy
        )
    try:
        with np.load(beside, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise FormatError(beside, f"cannot be read ({error})", remedy=remedy) from error
