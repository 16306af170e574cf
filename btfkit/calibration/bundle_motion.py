"""Points as axes carry them to the camera, with exact derivatives by every parameter."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit.calibration.bundle_parameters import Parameters
from btfkit.calibration.geometry import Geometry
from btfkit.calibration.kinematics import Axis, left_jacobian, perpendicular, rotation_of, skew

Floats = NDArray[np.float64]
Index = NDArray[np.intp]


@final
@dataclass(frozen=True, eq=False)
class Moved:
    """Points in the camera's frame: (n, 3), derivatives by shared (n, 3, s) and slip (n, 3, a)."""

    points: Floats
    shared: Floats
    slip: Floats


@final
@dataclass(frozen=True, eq=False)
class Motion:
    """The axes at one offset of the parameters.

    Attributes:
        of: what is offset. geometry: there. x: the offset. readings: (v, a) of all frames.
    """

    of: Parameters
    geometry: Geometry
    x: Floats
    readings: Floats

    def still(self, points: Floats) -> Moved:
        """Points (n, 3) that no parameter moves yet."""
        n = len(points)
        shared = np.zeros((n, 3, self.of.shared))
        return Moved(points, shared, np.zeros((n, 3, len(self.of.axis_names))))

    def to_camera(self, body: str, start: Moved, view: Index) -> Moved:
        """Points that move with a body, in the camera's frame.

        Args:
            body: sample or light. start: (n, 3) points. view: (n,) frame of each.
        """
        readings = self.readings + self.of.slips(self.x)
        geometry, x = self.geometry, self.x
        moved = start
        for name, sense in self._moves(body):
            moved = self._turned(geometry.kinematics.axis(name), moved, sense, readings, view)
        pose = geometry.camera_pose
        turned = moved.points @ pose.rotation.T
        shared = pose.rotation @ moved.shared
        shared[:, :, self.of.at["camera_pose"]] += by_pose(turned, x[self.of.at["camera_pose"]])
        return Moved(turned + pose.translation, shared, pose.rotation @ moved.slip)

    def _moves(self, body: str) -> Iterator[tuple[str, int]]:
        """Axes from what moves with a body to what moves with the camera, and their sense."""
        chains = self.of.start.kinematics.chains
        for name in reversed(chains.get(body, ())):
            yield name, 1
        for name in chains.get("camera", ()):
            yield name, -1

    def _turned(self, axis: Axis, moved: Moved, sense: int, readings: Floats, view: Index) -> Moved:
        """What one axis does to points and to their derivatives."""
        number = self.of.axis_names.index(axis.name)
        at = self.of.at[f"axis.{axis.name}"]
        angle = sense * readings[view, number]
        nominal = self.of.start.kinematics.axis(axis.name)
        across = perpendicular(nominal.direction)
        length = np.linalg.norm(nominal.direction + across @ self.x[at][:2])
        by_offset = (np.eye(3) - np.outer(axis.direction, axis.direction)) @ across / length
        slip = moved.slip.copy()
        if axis.kind == "linear":
            shared = moved.shared.copy()
            shared[:, :, at] += angle[:, None, None] * by_offset
            slip[:, :, number] += sense * axis.direction
            return Moved(moved.points + angle[:, None] * axis.direction, shared, slip)
        turn = rotation_of(axis.direction * (sense * readings[:, number])[:, None])[view]
        arm = moved.points - axis.point_mm
        turned = (turn @ arm[..., None])[..., 0]
        shared, slip = turn @ moved.shared, turn @ slip
        sin, versine = np.sin(angle)[:, None, None], (1 - np.cos(angle))[:, None, None]
        along = (arm @ axis.direction)[:, None, None]
        by_direction = -sin * skew(arm) + versine * (
            along * np.eye(3) + axis.direction[:, None] * arm[:, None, :]
        )
        shared[:, :, at.start : at.start + 2] += by_direction @ by_offset
        shared[:, :, at.start + 2 : at.stop] += (np.eye(3) - turn) @ across
        slip[:, :, number] += sense * np.cross(axis.direction, turned)
        return Moved(axis.point_mm + turned, shared, slip)


def by_pose(turned: Floats, by: Floats) -> Floats:
    """(n, 3, 6) derivative of moved points by an offset; `turned` is before the shift."""
    out = np.empty((len(turned), 3, 6))
    out[:, :, :3] = -skew(turned) @ left_jacobian(by[:3])
    out[:, :, 3:] = np.eye(3)
    return out
