"""Faults that are put in on purpose, by name, count and seed, so that recovery can be tested."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from typing import final

import numpy as np

FAULTS: dict[str, str] = {
    "no-reply": "a reply is lost",
    "late-reply": "a reply comes after its time-out",
    "truncated": "a reply is cut in half",
    "bad-crc": "a bit of a reply is flipped",
    "duplicate": "a reply comes twice",
    "stall": "an endpoint halts",
    "unplug": "the rig leaves the bus",
    "lost-steps": "an axis loses steps in a move",
    "limit-switch": "an axis meets its switch in a move",
    "dropped-frame": "a frame does not come",
    "repeated-frame": "the camera gives the frame before once more",
    "lamp-off": "the lamp goes out",
    "disk-full": "the disk is full when a frame is written",
    "kill": "the process is killed while a frame is written",
}
# Chances among which a fault without a place is drawn: all kinds meet so many in a small plan.
_WINDOW = 60


@final
class Faults:
    """When which fault strikes.

    Args:
        specs: each NAME, NAME:N (N times, where is drawn by the seed) or NAME:N@K (at the K-th
            chance, counted from 0, and those after it).
        seed: of the places that are drawn.

    Attributes:
        struck: how often each has struck.

    Raises:
        ValueError: no such fault, or not so many.
    """

    def __init__(self, specs: Iterable[str] = (), *, seed: int = 0) -> None:
        self._places: dict[str, set[int]] = {}
        self._chances: Counter[str] = Counter()
        self._armed: Counter[str] = Counter()
        self.struck: Counter[str] = Counter()
        for number, spec in enumerate(specs):
            name, places = _places(spec, np.random.default_rng([seed, number]))
            self._places.setdefault(name, set()).update(places)

    def arm(self, name: str, count: int = 1) -> None:
        """Let a fault strike at its next `count` chances."""
        if name not in FAULTS:
            raise ValueError(_unknown(name))
        self._armed[name] += count

    def strikes(self, name: str) -> bool:
        """Whether the fault strikes now; each call is one chance."""
        chance = self._chances[name]
        self._chances[name] += 1
        if self._armed[name] > 0:
            self._armed[name] -= 1
        elif chance not in self._places.get(name, ()):
            return False
        self.struck[name] += 1
        return True


def _places(spec: str, rng: np.random.Generator) -> tuple[str, set[int]]:
    match = re.fullmatch(r"([a-z-]+)(?::(\d{1,4})(?:@(\d{1,7}))?)?", spec)
    if not match or match[1] not in FAULTS:
        raise ValueError(_unknown(spec))
    count = int(match[2] or 1)
    if match[3] is not None:
        return match[1], set(range(int(match[3]), int(match[3]) + count))
    if not 1 <= count <= _WINDOW:
        raise ValueError(f"fault {spec!r}: {count} times; expected 1 to {_WINDOW}")
    return match[1], {int(place) for place in rng.choice(_WINDOW, count, replace=False)}


def _unknown(spec: str) -> str:
    return f"fault {spec!r}; expected NAME[:N[@K]] with one of {', '.join(FAULTS)}"
