"""Rigid motions, and axes that carry bodies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


class Motion(NamedTuple):
    """A rigid motion: x -> turn @ x + shift."""

    turn: Floats
    shift: Floats

    def of(self, points: ArrayLike) -> Floats:
        """(..., 3) points, moved."""
        return np.asarray(points, float) @ self.turn.T + self.shift

    def then(self, outer: Motion) -> Motion:
        """This one, and `outer` after it."""
        return Motion(outer.turn @ self.turn, outer.turn @ self.shift + outer.shift)

    def inverse(self) -> Motion:
        return Motion(self.turn.T, -self.turn.T @ self.shift)


def rotation(axis: ArrayLike, angle: float) -> Floats:
    """(3, 3) right-handed rotation about a unit vector (Rodrigues)."""
    x, y, z = np.asarray(axis, float)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


@final
@dataclass(frozen=True, eq=False)
class Chains:
    """Axes, each a line, and which of them move which body.

    Attributes:
        lines: direction and point (mm) of each axis, lab frame at zero.
        carries: axes that move each body, the one at the base first.
    """

    lines: Mapping[str, tuple[Floats, Floats]]
    carries: Mapping[str, Sequence[str]]

    @staticmethod
    def nominal(description: Mapping[str, Any]) -> Chains:
        """As a rig describes itself."""
        lines = {
            axis["name"]: (
                np.asarray(axis["direction"], float),
                np.asarray(axis["point_mm"], float),
            )
            for axis in description["axes"]
        }
        return Chains(lines, description["carries"])

    def body(self, name: str, places: Mapping[str, float]) -> Motion:
        """How the axes at `places` (radians) have moved a body from where it is at zero."""
        moved = Motion(np.eye(3), np.zeros(3))
        for axis in reversed(self.carries[name]):
            direction, point = self.lines[axis]
            turn = rotation(direction, places[axis])
            moved = moved.then(Motion(turn, point - turn @ point))
        return moved
