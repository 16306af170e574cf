"""Files named by their angles: one regular expression for every database that does so.

00081 tl015 pl000 tv000 pv000.jpg              UBO2003, ATRIUM
tl000_pl000_tv000_pv000.png                    UTIA
tv045.0_pv020.0_tl015.0_pl120.0.exr            Bonn SPECTRAL
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit import directions
from btfkit.errors import FormatError

# A number ends where the next key begins, or before anything that is no part of a number or word.
_ANGLE = re.compile(
    r"(?<![a-z])(tl|pl|tv|pv)[ _]?([-+]?\d+(?:[.,]\d+)?)(?=(?:tl|pl|tv|pv)[ _]?[-+\d]|[^a-z\d]|$)"
    r"(?![.,+-]\d|[ _]\d(?!\d))",
    re.IGNORECASE | re.ASCII,
)
_KEY = re.compile(r"(?<![a-z])(tl|pl|tv|pv)[ _]?[-+]?\d", re.IGNORECASE | re.ASCII)
_NUMBER = re.compile(r"(\d{1,12}) ", re.ASCII)


@final
@dataclass(frozen=True)
class Angles:
    """Angles of a name, degrees, and the running number before them, -1 without one."""

    tl: float
    pl: float
    tv: float
    pv: float
    number: int = -1


def is_named(name: str) -> bool:
    """Whether the base name of `name` has all four keys of angles, once each, whatever follows."""
    return len(set(_keys(_stem(name)))) == len(_keys(_stem(name))) == 4


def parse(name: str) -> Angles | None:
    """The angles in the base name of `name`; None unless all four are there, each once.

    Decimals may have a point or a comma.

    Raises:
        FormatError: all four are there, and one is a number that goes on as something else.
    """
    if not is_named(name):
        return None
    stem = _stem(name)
    found = _ANGLE.findall(stem)
    if len(found) != 4:
        whole = {key.lower() for key, _ in found}
        broken = next(key for key in _keys(stem) if key not in whole)
        raise FormatError(
            name, f"the angle {broken} is not a number of its own; expected one like {broken}023.5",
            remedy="rename the file",
        )  # fmt: skip
    angles = {key.lower(): float(value.replace(",", ".")) for key, value in found}
    number = _NUMBER.match(stem + " ")
    return Angles(**angles, number=int(number[1]) if number else -1)


def _stem(name: str) -> str:
    base = PurePosixPath(name.replace("\\", "/")).name
    return base.rsplit(".", 1)[0] if "." in base else base


def _keys(stem: str) -> list[str]:
    return [key.lower() for key in _KEY.findall(stem)]


def ordered(path: str, names: list[str]) -> list[tuple[str, Angles]]:
    """Names with angles, by running number where all have one, else by view, then light.

    Raises:
        FormatError: an angle that no hemisphere has, or one direction pair twice.
    """
    parsed = [(name, angles) for name in names if (angles := parse(name)) is not None]
    seen: dict[tuple[float, ...], str] = {}
    for name, a in parsed:
        if not (0 <= a.tl <= 90 and 0 <= a.tv <= 90 and abs(a.pl) <= 360 and abs(a.pv) <= 360):
            raise FormatError(path, f"{name}: angles {a} are not on the hemisphere")
        key = (*_direction(a.tl, a.pl), *_direction(a.tv, a.pv))
        if key in seen:
            raise FormatError(
                path, f"{name} and {seen[key]} are the same direction pair", remedy="remove one"
            )
        seen[key] = name
    if all(a.number >= 0 for _, a in parsed):
        return sorted(parsed, key=lambda item: (item[1].number, item[0]))
    return sorted(parsed, key=lambda item: (item[1].tv, item[1].pv, item[1].tl, item[1].pl))


def light_and_view(
    angles: list[Angles],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(n, 3) light and view of names; phi = 0 is image +x, and phi grows towards +y (up)."""
    tl, pl, tv, pv = np.radians([(a.tl, a.pl, a.tv, a.pv) for a in angles]).T
    light, view = directions.from_angles(tl, pl), directions.from_angles(tv, pv)
    return light.astype(np.float32), view.astype(np.float32)


def missing_pairs(angles: list[Angles]) -> int:
    """How many pairs the product of the views and lights that occur lacks."""
    lights = {_direction(a.tl, a.pl) for a in angles}
    views = {_direction(a.tv, a.pv) for a in angles}
    return len(lights) * len(views) - len(angles)


def _direction(theta: float, phi: float) -> tuple[float, float]:
    """Angles that are equal where the directions are: at the pole every azimuth is the same."""
    return theta, phi % 360 if theta else 0.0
