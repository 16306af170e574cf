"""What the twin knows of a run and tells nobody but those who ask for the truth.

twin.jsonl   the first line is the twin itself: sample, seed, imperfections, sensor; then one
             line a session and one an exposure: its number, the true axes, the true power
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from btfkit.devices.twin.imperfections import IMPERFECTIONS, Imperfections
from btfkit.devices.twin.world import Setup
from btfkit.errors import DeviceError, FormatError
from btfkit.relief import file as relief_file
from btfkit.relief import procedural
from btfkit.relief.relief import Relief

NAME = "twin.jsonl"
# Time that the twin stood still between two sessions.
_PAUSE_S = 60.0
# Camera pixels a texel, from straight above.
_PIXELS_A_TEXEL = 1.4
_SAMPLE_SHARE = 0.277


@final
@dataclass(frozen=True)
class Twin:
    """Which twin it is, in words that a log can hold.

    Attributes:
        sample: name of a procedural material, or path of a relief file.
        width, height: of the sensor. seed: of all that is drawn.
        without: imperfections that are off.
    """

    sample: str = "woven"
    width: int = 640
    height: int = 480
    seed: int = 0
    without: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        Imperfections.without(self.without)
        for name, side in (("width", self.width), ("height", self.height)):
            if not 32 <= side <= 8192 or side % 2:
                raise ValueError(f"{name} {side}; expected an even number of pixels, 32 to 8192")

    def relief(self) -> Relief:
        """The sample.

        Raises:
            ValueError: no such material. FormatError: no relief file.
        """
        if self.sample.lower().endswith(".exr"):
            return relief_file.read(Path(self.sample))
        size = max(16, round(self.width * _SAMPLE_SHARE / _PIXELS_A_TEXEL / 8) * 8)
        return procedural.make(self.sample, size, seed=self.seed)

    def setup(self, *, session: int = 0, start_s: float = 0.0, blind: bool = False) -> Setup:
        """The world it stands for; `blind` leaves the camera's model out."""
        return Setup(
            None if blind else self.relief(),
            width=self.width,
            height=self.height,
            imperfections=Imperfections.without(self.without),
            seed=self.seed,
            session=session,
            start_s=start_s,
        )


@final
class TwinLog:
    """The log of a run's folder, begun or gone on with.

    Args:
        folder: of the run. twin: which it is; None takes the one of the log.

    Attributes:
        twin: which it is. entries: by exposure number.

    Raises:
        DeviceError: the run was begun with another twin.
    """

    def __init__(self, folder: Path, twin: Twin | None = None) -> None:
        self._path = folder / NAME
        lines = _lines(self._path)
        if twin is None and not lines:
            raise FileNotFoundError(
                f"{self._path} is not there: the twin has exposed nothing here; begin a new run"
            )
        first = _twin(self._path, lines[0]) if lines else None
        if first is not None and twin is not None and first != twin:
            raise DeviceError(
                f"{folder} was begun with {first}; asked is {twin}",
                remedy="leave out --sample, --seed, --perfect, --without",
            )
        self.twin: Twin = first or twin or Twin()
        self._sessions = sum("session" in line for line in lines)
        self._last_s = max((line["time_s"] for line in lines if "time_s" in line), default=None)
        self._pending: list[Mapping[str, Any]] = []
        self.entries: dict[tuple[int, int], Mapping[str, Any]] = {
            (line["serial"][0], line["serial"][1]): line for line in lines if "serial" in line
        }

    def begin(self) -> Setup:
        """The world of a new session: the same rig, some time later.

        The log itself begins when the axes are homed, so that a refused run leaves nothing.
        """
        start = 0.0 if self._last_s is None else self._last_s + _PAUSE_S
        self._pending = [{"session": self._sessions}]
        if not self._path.exists():
            self._pending.insert(0, {"twin": self.twin.__dict__})
        return self.twin.setup(session=self._sessions, start_s=start)

    def __call__(self, entry: Mapping[str, Any]) -> None:
        """Keep what the firmware tells: what really was at an exposure."""
        lines = [json.dumps(each, allow_nan=False) for each in (*self._pending, entry)]
        self._pending = []
        with self._path.open("a", encoding="utf-8") as file:
            # In front: what a killed process wrote last may lack its line's end.
            file.write("".join("\n" + line for line in lines))


def _lines(path: Path) -> list[dict[str, Any]]:
    if not path.exists():
        return []
    lines = []
    text = path.read_text(encoding="utf-8").split("\n")
    for line in filter(None, text):
        try:
            lines.append(json.loads(line))
        except ValueError as error:
            # What a killed process was writing; the session after it wrote on behind it.
            if not lines:
                raise FormatError(path, f"the first line is damaged ({error})") from error
    return lines


def _twin(path: Path, line: Mapping[str, Any]) -> Twin:
    try:
        entry = dict(line["twin"])
        return Twin(**{**entry, "without": tuple(entry["without"])})
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(
            path, f"the first line does not say which twin it was ({error!r})"
        ) from error


def everything() -> tuple[str, ...]:
    """All imperfections: what a perfect twin goes without."""
    return tuple(IMPERFECTIONS)
