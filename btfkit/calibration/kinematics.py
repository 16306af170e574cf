"""Rigid motions, and a rig of named axes that carry the sample, the camera and the lights.

The lab frame is the sample's frame while every axis reads zero: right-handed, x right, y up,
z out of the sample, millimetres.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from btfkit.errors import CalibrationError

Floats = NDArray[np.float64]
Body = Literal["sample", "camera", "light"]
BODIES: tuple[Body, ...] = ("sample", "camera", "light")


def check_rotation(turn: Floats) -> None:
    """Raise a ValueError where (3, 3) `turn` is no rotation, to the three digits people write."""
    # Numbers whose squares have no room are none either.
    plain = np.isfinite(turn).all() and np.abs(turn).max() < 2
    if not plain or not np.allclose(turn @ turn.T, np.eye(3), atol=4e-3) or np.linalg.det(turn) < 0:
        raise ValueError(
            f"rotation {turn.tolist()}; expected three perpendicular unit vectors, right-handed"
        )


@final
@dataclass(frozen=True, eq=False)
class Rigid:
    """A rigid motion x -> rotation x + translation.

    Attributes:
        rotation: (3, 3). translation: (3,) mm.
    """

    rotation: Floats
    translation: Floats

    @staticmethod
    def identity() -> Rigid:
        return Rigid(np.eye(3), np.zeros(3))

    @staticmethod
    def from_vectors(turn: ArrayLike, shift: ArrayLike) -> Rigid:
        """From a rotation vector (3,) in radians and a shift (3,) in mm."""
        return Rigid(rotation_of(np.asarray(turn, float)), np.asarray(shift, float))

    def __call__(self, points: ArrayLike) -> Floats:
        """(..., 3) moved points."""
        return np.asarray(points, float) @ self.rotation.T + self.translation

    def __matmul__(self, first: Rigid) -> Rigid:
        """`first`, then this."""
        return Rigid(self.rotation @ first.rotation, self(first.translation))

    def inverse(self) -> Rigid:
        return Rigid(self.rotation.T, -self.rotation.T @ self.translation)

    def to_json(self) -> dict[str, Any]:
        """Rotation by rows and translation in mm."""
        return {"rotation": self.rotation.tolist(), "translation_mm": self.translation.tolist()}

    @staticmethod
    def from_json(entry: Mapping[str, Any]) -> Rigid:
        """The motion that `to_json` wrote."""
        return Rigid(np.array(entry["rotation"], float), np.array(entry["translation_mm"], float))


@final
@dataclass(frozen=True, eq=False)
class Axis:
    """One axis as it lies in the lab while every axis reads zero.

    Attributes:
        name: as in the sequence.
        kind: "rotary" (readings in radians) or "linear" (mm).
        direction: (3,) unit vector; a positive reading turns right-handed about it.
        point_mm: (3,) a point on a rotary axis.
    """

    name: str
    kind: str
    direction: Floats
    point_mm: Floats

    def __post_init__(self) -> None:
        direction = np.asarray(self.direction, float)
        with np.errstate(over="ignore"):
            length = float(np.linalg.norm(direction))
        if self.kind not in ("rotary", "linear"):
            raise CalibrationError(
                f"axis {self.name!r} is {self.kind!r}; an axis is 'rotary' or 'linear'"
            )
        if direction.shape != (3,) or not np.isfinite(length) or length < 1e-9:
            raise CalibrationError(
                f"axis {self.name!r} has no direction: {direction.tolist()}; expected three "
                "numbers, not all zero, and their length a number"
            )
        object.__setattr__(self, "direction", direction / length)
        object.__setattr__(self, "point_mm", np.asarray(self.point_mm, float))

    def motion(self, reading: float) -> Rigid:
        """What a reading does to what the axis carries."""
        if self.kind == "linear":
            return Rigid(np.eye(3), self.direction * reading)
        turn = rotation_of(self.direction * reading)
        return Rigid(turn, self.point_mm - turn @ self.point_mm)


@final
@dataclass(frozen=True, eq=False)
class Kinematics:
    """Which axes carry which body, outermost first.

    Attributes:
        axes: every axis once.
        chains: names of the axes that move each body; a body without an entry stands still.
    """

    axes: tuple[Axis, ...]
    chains: Mapping[str, tuple[str, ...]]

    def __post_init__(self) -> None:
        names = [axis.name for axis in self.axes]
        if len(set(names)) < len(names):
            raise CalibrationError(f"axes {names} share a name; each needs its own")
        for body, chain in self.chains.items():
            if body not in BODIES:
                raise CalibrationError(f"axes carry {body!r}; bodies are {', '.join(BODIES)}")
            lost = [name for name in chain if name not in names]
            if lost:
                raise CalibrationError(
                    f"axes {lost} carry the {body} and are not in {names}",
                    remedy="add axes of these names, or take them out of carries",
                )

    def axis(self, name: str) -> Axis:
        return next(axis for axis in self.axes if axis.name == name)

    def chain(self, body: str) -> tuple[Axis, ...]:
        """Axes that move a body, outermost first."""
        return tuple(self.axis(name) for name in self.chains.get(body, ()))

    def pose(self, body: str, readings: Mapping[str, float]) -> Rigid:
        """Where readings put a body: from its place at zero to the lab.

        Raises:
            CalibrationError: a reading is missing.
        """
        at = Rigid.identity()
        for axis in self.chain(body):
            at = at @ axis.motion(reading_of(readings, axis.name))
        return at

    def between(self, body: str, other: str, readings: Mapping[str, float]) -> Rigid:
        """From the frame that moves with `body` to the one that moves with `other`."""
        return self.pose(other, readings).inverse() @ self.pose(body, readings)

    def with_axes(self, axes: Iterable[Axis]) -> Kinematics:
        return replace(self, axes=tuple(axes))


def reading_of(readings: Mapping[str, float], name: str) -> float:
    """The reading of an axis; CalibrationError where it is missing or no number."""
    value = readings.get(name)
    if value is None or not np.isfinite(value):
        raise CalibrationError(
            f"axis {name!r} has reading {value}; the rig's axes need one in every frame",
            remedy=f"give the column axis:{name}",
        )
    return float(value)


def rotation_of(turn: Floats) -> Floats:
    """(..., 3, 3) rotation matrices of rotation vectors (..., 3), radians."""
    angle = np.linalg.norm(turn, axis=-1)[..., None, None]
    cross = skew(turn)
    # sin(a) / a and (1 - cos(a)) / a^2, exact at zero
    first, second = np.sinc(angle / np.pi), 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    return np.eye(3) + first * cross + second * (cross @ cross)


def skew(vector: Floats) -> Floats:
    """(..., 3, 3) matrices whose product with x is vector x x."""
    x, y, z = np.moveaxis(np.asarray(vector, float), -1, 0)
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def left_jacobian(turn: Floats) -> Floats:
    """(3, 3) derivative of a rotation by its vector: R(w + d) = R(J d) R(w), to first order."""
    angle = float(np.linalg.norm(turn))
    cross = skew(turn)
    if angle < 1e-6:
        return np.eye(3) + cross / 2 + cross @ cross / 6
    second = (1 - np.cos(angle)) / angle**2
    third = (angle - np.sin(angle)) / angle**3
    return np.eye(3) + second * cross + third * (cross @ cross)


def perpendicular(direction: Floats) -> Floats:
    """(3, 2) two unit vectors across a direction, the same for the same direction."""
    first = np.cross(direction, np.eye(3)[int(np.argmin(np.abs(direction)))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first)], -1)
