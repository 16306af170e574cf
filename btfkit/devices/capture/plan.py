"""What is to be measured: a JSON plan, validated, hashed, and the same in every run of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit import directions, documents
from btfkit.errors import FormatError
from btfkit.relief.synth import direction_set

VERSION = 1
NAMED = ("demo", "bonn81", "bonn151")
# Frames of one plan beyond this are a mistake in it.
_MOST_FRAMES = 2_000_000
_STEEPEST_DEG = 80.0
Directions = NDArray[np.float64]


@final
@dataclass(frozen=True)
class Bracket:
    """Exposures of one pose.

    Attributes:
        count: how many. ratio: of neighbours. longest_s: no exposure is longer.
        times_s: fixed times; None meters each pose.
    """

    count: int = 4
    ratio: float = 4.0
    longest_s: float = 2.0
    times_s: tuple[float, ...] | None = None


@final
@dataclass(frozen=True)
class Ramp:
    """Frames that tell about the sensor: `count` of each time."""

    times_s: tuple[float, ...]
    count: int = 2


@final
@dataclass(frozen=True, eq=False)
class Plan:
    """A measurement.

    Attributes:
        name: of the plan.
        views, lights: (v, 3) and (l, 3) unit vectors, sample's frame.
        pairs: (n, 2) rows of views and lights that are measured.
        bracket: of samples, whites, colours and targets.
        darks, flats: ramps without light, and of the even panel.
        whites, colours, targets, spheres: how many poses for each.
        reference_every: sample poses between two looks at the reference; 0 for none.
        reference_level, reference_px: change of it that is too much, relative and in pixels.
        settle_s: rest before an exposure. warm_s: longest wait for the lamp; 0 for none.
        iso: speed of the camera.
        document: what it was read from, whose hash is the plan's.
    """

    name: str
    views: Directions
    lights: Directions
    pairs: NDArray[np.intp]
    bracket: Bracket = field(default_factory=Bracket)
    darks: Ramp = field(default_factory=lambda: Ramp((1e-3, 0.03, 0.5, 2.0)))
    flats: Ramp = field(
        default_factory=lambda: Ramp((1e-3, 2e-3, 4e-3, 8e-3, 0.014, 0.02, 0.026, 0.032))
    )
    whites: int = 4
    colours: int = 1
    targets: int = 16
    spheres: int = 16
    reference_every: int = 100
    reference_level: float = 0.02
    reference_px: float = 0.5
    settle_s: float = 0.2
    warm_s: float = 3600.0
    iso: float = 100.0
    document: Mapping[str, Any] = field(default_factory=dict)

    @property
    def hash(self) -> str:
        """SHA-256 of what was asked."""
        return documents.fingerprint(self.document)

    def __len__(self) -> int:
        return len(self.pairs)


def read(source: str | Path) -> Plan:
    """The plan of a name or of a JSON file.

    Raises:
        FileNotFoundError: neither. FormatError: a plan that cannot be carried out as it stands.
    """
    if str(source) in NAMED:
        return from_document(str(source), _named(str(source)))
    path = Path(source)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such plan; name a JSON file or {', '.join(NAMED)}")
    return from_document(str(path), documents.load(path))


def from_document(path: str, document: Mapping[str, Any]) -> Plan:
    """A plan from its JSON object.

    Args:
        path: for messages. document: as docs/capture.md has it.

    Raises:
        FormatError: a key that no plan has, or a value that cannot be.
    """
    fields = _Fields(path, document)
    if fields.number("version", VERSION) != VERSION:
        raise FormatError(path, f"version {document['version']!r}; expected {VERSION}")
    views = _directions(path, "views", document.get("views", 12))
    lights = _directions(path, "lights", document.get("lights", 12))
    bracket = _bracket(path, fields.section("exposures"))
    named = document.get("pairs")
    frames = bracket.count * (len(named) if isinstance(named, list) else len(views) * len(lights))
    if frames > _MOST_FRAMES:
        raise FormatError(path, f"{frames} frames of the sample; at most {_MOST_FRAMES}")
    plan = Plan(
        name=str(document.get("name", Path(path).stem)),
        views=views,
        lights=lights,
        pairs=_pairs(path, document.get("pairs"), len(views), len(lights)),
        bracket=bracket,
        darks=_ramp(path, "darks", fields.section("darks"), Plan.__dataclass_fields__["darks"]),
        flats=_ramp(path, "flats", fields.section("flats"), Plan.__dataclass_fields__["flats"]),
        whites=fields.whole("whites", Plan.whites),
        colours=fields.whole("colours", Plan.colours),
        targets=fields.whole("targets", Plan.targets),
        spheres=fields.whole("spheres", Plan.spheres),
        reference_every=fields.whole("reference_every", Plan.reference_every),
        reference_level=fields.positive("reference_level", Plan.reference_level),
        reference_px=fields.positive("reference_px", Plan.reference_px),
        settle_s=fields.number("settle_s", Plan.settle_s),
        warm_s=fields.number("warm_s", Plan.warm_s),
        iso=fields.positive("iso", Plan.iso),
        document=dict(document),
    )
    fields.refuse_others(_KEYS)
    return plan


_KEYS = frozenset(
    {
        "version", "name", "views", "lights", "pairs", "exposures", "darks", "flats", "whites",
        "colours", "targets", "spheres", "reference_every", "reference_level", "reference_px",
        "settle_s", "warm_s", "iso",
    }
)  # fmt: skip


def _named(name: str) -> dict[str, Any]:
    if name == "demo":
        return {"version": 1, "name": "demo", "views": 12, "lights": 12, "reference_every": 48,
                "pairs": [[i, (5 * i + 3 * k) % 12] for i in range(12) for k in range(3)],
                "exposures": {"count": 3}, "targets": 10, "spheres": 12}  # fmt: skip
    return {"version": 1, "name": name, "views": name, "lights": name}


class _Fields:
    """Values of an object, checked."""

    def __init__(self, path: str, document: Mapping[str, Any], inside: str = "") -> None:
        self._path, self._document, self._inside = path, document, inside

    def number(self, key: str, default: float) -> float:
        value = self._document.get(key, default)
        good = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not good or not math.isfinite(value) or value < 0:
            raise FormatError(
                self._path, f"{self._inside}{key} is {value!r}; expected a number of at least 0"
            )
        return float(value)

    def positive(self, key: str, default: float) -> float:
        value = self.number(key, default)
        if value <= 0:
            raise FormatError(self._path, f"{self._inside}{key} is 0; expected more than 0")
        return value

    def whole(self, key: str, default: int) -> int:
        value = self.number(key, default)
        if value != int(value) or value > 100_000:
            raise FormatError(
                self._path, f"{self._inside}{key} is {value:g}; expected a whole number to 100000"
            )
        return int(value)

    def section(self, key: str) -> Mapping[str, Any]:
        value = self._document.get(key, {})
        if not isinstance(value, Mapping):
            raise FormatError(self._path, f"{key} is {str(value)[:40]!r}; expected an object")
        return value

    def times(self, key: str) -> tuple[float, ...] | None:
        value = self._document.get(key)
        if value is None:
            return None
        if not isinstance(value, list) or not value:
            raise FormatError(self._path, f"{self._inside}{key}: expected a list of seconds")
        return tuple(
            _Fields(self._path, {str(i): each}, f"{self._inside}{key}.").positive(str(i), 0)
            for i, each in enumerate(value)
        )

    def refuse_others(self, known: frozenset[str] | set[str]) -> None:
        others = sorted(self._document.keys() - known)
        if others:
            raise FormatError(
                self._path, f"{self._inside}{others[0]} is unknown; expected one of "
                f"{', '.join(sorted(known))}",
            )  # fmt: skip


def _bracket(path: str, section: Mapping[str, Any]) -> Bracket:
    fields = _Fields(path, section, "exposures.")
    times = fields.times("times_s")
    fields.refuse_others({"count", "ratio", "longest_s", "times_s"})
    count = len(times) if times else fields.whole("count", Bracket.count)
    ratio = fields.positive("ratio", Bracket.ratio)
    if not 1 <= count <= 32:
        raise FormatError(path, f"exposures.count is {count}; expected 1 to 32")
    if ratio <= 1:
        raise FormatError(path, f"exposures.ratio is {ratio:g}; expected more than 1")
    return Bracket(count, ratio, fields.positive("longest_s", Bracket.longest_s), times)


def _ramp(path: str, name: str, section: Mapping[str, Any], default: Any) -> Ramp:
    fields = _Fields(path, section, f"{name}.")
    usual: Ramp = default.default_factory()
    fields.refuse_others({"times_s", "count"})
    return Ramp(fields.times("times_s") or usual.times_s, fields.whole("count", usual.count))


def _directions(path: str, name: str, value: Any) -> Directions:
    if isinstance(value, (str, int)) and not isinstance(value, bool):
        try:
            return np.asarray(direction_set(str(value)), np.float64)
        except ValueError as error:
            raise FormatError(path, f"{name}: {error}") from error
    if not isinstance(value, list) or not value:
        raise FormatError(path, f"{name} is {str(value)[:40]!r}; expected a name, number or list")
    angles = []
    for i, each in enumerate(value):
        pair = isinstance(each, list) and len(each) == 2
        if not pair or not all(isinstance(a, (int, float)) and math.isfinite(a) for a in each):
            raise FormatError(
                path, f"{name}[{i}] is {str(each)[:40]!r}; expected [theta, phi] in degrees"
            )
        if not 0 <= each[0] <= _STEEPEST_DEG:
            raise FormatError(
                path, f"{name}[{i}] has theta {each[0]:g}; expected 0 to {_STEEPEST_DEG:g} degrees"
            )
        angles.append(each)
    theta, phi = np.radians(np.asarray(angles, float)).T
    return directions.from_angles(theta, phi).astype(np.float64)


def _pairs(path: str, value: Any, views: int, lights: int) -> NDArray[np.intp]:
    if value is None:
        view, light = np.meshgrid(np.arange(views), np.arange(lights), indexing="ij")
        return np.stack([view.reshape(-1), light.reshape(-1)], axis=1)
    if not isinstance(value, list) or not value:
        raise FormatError(path, "pairs: expected a list of [view, light]")
    for i, each in enumerate(value):
        good = isinstance(each, list) and len(each) == 2
        good = good and all(isinstance(n, int) and not isinstance(n, bool) for n in each)
        if not good or not (0 <= each[0] < views and 0 <= each[1] < lights):
            raise FormatError(
                path, f"pairs[{i}] is {str(each)[:40]!r}; expected [view, light] of {views} and "
                f"{lights}",
            )  # fmt: skip
    if len({tuple(each) for each in value}) < len(value):
        raise FormatError(path, "pairs: one stands twice")
    return np.asarray(value, np.intp)
