"""BRDFs of goniophotometers as text, by pab ("Mountain", BME): BTFs of one texel.

    #sample_name "paper"
    #format: theta phi BRDF
    #intheta 30
    #inphi 0
    15.0 182.5 0.0713

A file for each incident direction: lines that begin with #, then lines of polar angle and azimuth
of the outgoing direction, degrees, and a value, or three under `#colorimetry: CIE-XYZ`. DSF is
BSDF x cosine of the outgoing direction. Azimuths count from x; `#upphi` is the azimuth of up (y).
Source: the manual page of Radiance's pabopto2bsdf, and pab's page on its files.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit import colour, directions
from btfkit.btf import BTF
from btfkit.errors import FormatError
from btfkit.io import named
from btfkit.io.brdf import one_texel

SUFFIXES = (".bme", ".dat", ".txt")
_KINDS = {"DSF": True, "BSDF": False, "BRDF": False}
_FORMAT = re.compile(rb"^#\s*format:\s*theta\s+phi\b", re.IGNORECASE | re.MULTILINE)
_HEAD = 4096
_MOST_BYTES = 1 << 28
# Outgoing directions so close to the horizon say nothing once divided by their cosine.
_LOWEST = 1e-3
# Azimuths up to two turns.
_TURNS = 720.0
# Angles are printed to so many degrees.
_SAME = 1e-4


def detect(path: Path) -> bool:
    """Whether a text begins with a line `#format: theta phi ...`, or a folder holds such texts."""
    if path.is_dir():
        return any(_looks(file) for file in _files(path))
    return path.is_file() and path.suffix.lower() in SUFFIXES and _looks(path)


def read(path: Path) -> BTF:
    """One file, or a folder with one for each incident direction.

    Directions of transmission are left out and counted; values measured twice are averaged.

    Args:
        path: file or folder.

    Raises:
        FormatError: damaged, no incident direction, light from behind, or kinds that differ.
    """
    values, record = named.assumptions(incident=(None, "light"))
    del values
    files = _files(path) if path.is_dir() else [path]
    if not files:
        raise FormatError(path, "holds no file with a line #format: theta phi ...")
    parts = [_read(file) for file in files]
    if len({part.value.shape[1] for part in parts}) > 1:
        raise FormatError(path, "some files hold one value a line and some three")
    light = np.concatenate([np.broadcast_to(p.light, (len(p.view), 3)) for p in parts])
    view = np.concatenate([part.view for part in parts])
    value = np.concatenate([part.value for part in parts])
    if not len(value):
        raise FormatError(path, "holds no value of reflection")
    light, view, value, again = _averaged(light, view, value)
    if value.shape[1] == 3:
        value = colour.xyz_to_rgb(value)
    bad = ~np.isfinite(value).all(axis=1)
    quantity = np.pi * value * light[:, 2:]
    quantity[bad] = np.nan
    if bad.all():
        raise FormatError(path, "none of its values is finite")
    said = {
        "sample": parts[0].sample,
        "incident_directions": len(parts),
        "transmission_left_out": sum(part.behind for part in parts),
        "averaged": again,
        **record,
    }
    return one_texel(path, quantity, light, view, name="bme", said=said)


@final
@dataclass(frozen=True, eq=False)
class _Part:
    """What one file holds: light (3,), views (k, 3), values (k, 1 or 3) of f_r."""

    light: NDArray[np.float64]
    view: NDArray[np.float64]
    value: NDArray[np.float64]
    sample: str
    behind: int


def _looks(path: Path) -> bool:
    with path.open("rb") as file:
        head = file.read(_HEAD)
    return head.startswith(b"#") and _FORMAT.search(head) is not None


def _files(folder: Path) -> list[Path]:
    return [
        path
        for path in sorted(folder.iterdir())
        if path.suffix.lower() in SUFFIXES
        and path.is_file()
        and (path.suffix.lower() == SUFFIXES[0] or _looks(path))
    ]


@final
@dataclass
class _Head:
    """What the lines with # say; angles in degrees, None where they lack."""

    kind: str = ""
    sample: str = ""
    count: int = 1
    intheta: float | None = None
    inphi: float | None = None
    upphi: float = 0.0


def _read(path: Path) -> _Part:
    size = path.stat().st_size
    if size > _MOST_BYTES:
        raise FormatError(path, f"{size} bytes of text; expected up to {_MOST_BYTES}")
    text = path.read_text(encoding="latin-1")
    lines = text.split("\n")
    head = _head(path, [line[1:].strip() for line in lines if line.startswith("#")])
    if head.intheta is None or head.inphi is None:
        lacks = "intheta" if head.intheta is None else "inphi"
        raise FormatError(path, f"no line #{lacks}: the incident direction is not known")
    if not 0 <= head.intheta < 90:
        raise FormatError(
            path, f"light at {head.intheta:g} degrees from the normal; expected less than 90",
            remedy="leave out what was lit from behind",
        )  # fmt: skip
    table = _table(path, lines, head.count)
    if not text.endswith("\n"):
        warnings.warn(f"{path} ends within a line: it may have been cut", stacklevel=4)
    turn = 90 - head.upphi
    view = np.asarray(
        directions.from_angles(np.radians(table[:, 0]), np.radians(table[:, 1] + turn)), np.float64
    )
    front = view[:, 2] > _LOWEST
    value = table[front, 2:]
    if _KINDS[head.kind]:
        value = value / view[front, 2:]
    light = np.asarray(
        directions.from_angles(np.radians(head.intheta), np.radians(head.inphi + turn)), np.float64
    )
    return _Part(light, view[front], value, head.sample, int((~front).sum()))


def _head(path: Path, lines: list[str]) -> _Head:
    found = _Head()
    for line in lines:
        word, _, rest = line.partition(" ")
        match word.lower().rstrip(":"):
            case "sample_name":
                found.sample = rest.strip().strip('"')[:80]
            case "format":
                found.kind = rest.split()[-1].upper() if rest.split() else ""
            case "colorimetry":
                found.count = _count(path, rest.strip().upper())
            case "intheta" | "inphi" | "upphi" as name:
                setattr(found, name, _number(path, name, rest))
            case "incident_angle" if len(rest.split()) == 2:
                found.intheta, found.inphi = (_number(path, word, part) for part in rest.split())
    if found.kind not in _KINDS:
        raise FormatError(path, f"format {found.kind[:40]!r}; expected {', '.join(_KINDS)}")
    return found


def _table(path: Path, lines: list[str], count: int) -> NDArray[np.float64]:
    """(k, 2 + count) numbers of the other lines: polar angle, azimuth and values."""
    rows = [
        (number, line.split())
        for number, line in enumerate(lines, 1)
        if line.strip() and not line.startswith("#")
    ]
    for number, words in rows:
        if len(words) != 2 + count:
            raise FormatError(
                path, f"line {number} holds {len(words)} numbers; expected {2 + count}"
            )
    try:
        table = np.array([words for _, words in rows], np.float64).reshape(-1, 2 + count)
    except ValueError as error:
        raise FormatError(path, f"holds what is no number ({error})") from error
    theta, phi = table[:, 0], table[:, 1]
    # An azimuth of many turns is no azimuth, and no angle after rounding.
    wrong = ~((theta >= 0) & (theta <= 180) & (np.abs(phi) <= _TURNS))
    if wrong.any():
        at = rows[int(np.flatnonzero(wrong)[0])][0]
        raise FormatError(path, f"line {at} has no outgoing direction; expected degrees, 0 to 180")
    return table


def _count(path: Path, colorimetry: str) -> int:
    counts = {"CIE-XYZ": 3, "CIE-Y": 1}
    if colorimetry not in counts:
        raise FormatError(path, f"colorimetry {colorimetry[:40]!r}; expected {', '.join(counts)}")
    return counts[colorimetry]


def _number(path: Path, name: str, text: str) -> float:
    try:
        value = float(text.split()[0])
    except (ValueError, IndexError) as error:
        raise FormatError(path, f"#{name} {text[:40]!r}; expected degrees") from error
    if not np.isfinite(value) or abs(value) > _TURNS:
        raise FormatError(path, f"#{name} {value:g}; expected degrees")
    return value


def _averaged(
    light: NDArray[np.float64], view: NDArray[np.float64], value: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], int]:
    """Pairs that are the same to the digits of the file as one, and how many went into others."""
    key = np.round(np.concatenate([light, view], axis=1) / np.radians(_SAME)).astype(np.int64)
    _, first, index, count = np.unique(
        key, axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    total = np.zeros((len(first), value.shape[1]))
    np.add.at(total, index.reshape(-1), value)
    order = np.argsort(first)
    chosen = first[order]
    mean = (total / count[:, None])[order]
    return light[chosen], view[chosen], mean, len(value) - len(first)
