"""Parameters of a rig's geometry: their names, scales, and what is assumed of them beforehand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit.calibration.camera_model import PARAMETERS, Camera
from btfkit.calibration.geometry import Geometry
from btfkit.calibration.kinematics import Axis, Rigid, perpendicular, rotation_of

Floats = NDArray[np.float64]
Index = NDArray[np.intp]
# What is assumed beforehand of each kind of parameter: the scale of the solver, and what the
# frames must tell better to be asked at all.
_SCALE_PX = {"fx": 0.05, "fy": 0.05, "cx": 0.05, "cy": 0.05}
# Of distortions, by what they do in the corner of the frame, as shares of the way to it.
_SCALE_LENS = {"k1": 0.02, "k2": 0.02, "p1": 0.005, "p2": 0.005, "k3": 1e-3}
_POWER_LENS = {"k1": 2, "k2": 4, "p1": 1, "p2": 1, "k3": 6}
_SCALE_TURN, _SCALE_MM, _SCALE_LIGHT_MM = 0.05, 5.0, 50.0
# How good a drawing of a rig is: what frames hardly tell stays near it. The camera and what lies
# on the holder are told by every frame.
_DRAWN = {"turn": 0.02, "mm": 2.0, "light": 20.0}
_LENS_GIVES_UP, _BOARD_GIVES_UP = 10.0, 100.0


@final
class Parameters:
    """Offsets from where a rig is believed to be.

    Args:
        start: what is believed. frames: names of all that was seen, one a slip of each axis.
        slip_sd: how far axes stand from their readings, by name; others are trusted.

    Attributes:
        names, scale: of the parameters: lens, camera pose, axes, board, spheres, lights, slips.
        give_up: how willingly a parameter is held where frames do not tell it from others.
        at: where those of one thing stand. shared: how many all frames share; slips follow.
        drawn, drawn_sd: those that a drawing of the rig tells, and how well.
    """

    def __init__(
        self, start: Geometry, frames: Sequence[str], slip_sd: Mapping[str, float]
    ) -> None:
        self.start = start
        self.axis_names = [axis.name for axis in start.kinematics.axes]
        self.slip_sd = np.array([slip_sd.get(name, 0.0) for name in self.axis_names])
        self._name(frames)
        drawn = [
            (
                i,
                _DRAWN[
                    "light" if name.startswith("light") else "turn" if "direction" in name else "mm"
                ],
            )
            for i, name in enumerate(self.names)
            if name.startswith(("axis.", "light."))
        ]
        self.drawn: Index = np.array([i for i, _ in drawn], np.intp)
        self.drawn_sd = np.array([sd for _, sd in drawn])

    @property
    def size(self) -> int:
        return len(self.names)

    def slips(self, x: Floats) -> Floats:
        """(v, a) corrections of readings."""
        slipping = self.slip_sd > 0
        out = np.zeros((self._frames, len(slipping)))
        out[:, slipping] = x[self.shared :].reshape(self._frames, -1)
        return out

    def geometry(self, x: Floats) -> Geometry:
        """The geometry at an offset."""
        start = self.start
        camera = start.camera.parameters + x[self.at["lens"]]
        axes = [self._axis(axis, x) for axis in start.kinematics.axes]
        lights = {
            name: np.asarray(at, float) + x[self.at[f"light.{name}"]]
            for name, at in start.lights_mm.items()
        }
        return replace(
            start,
            camera=Camera(start.camera.width, start.camera.height, camera),
            camera_pose=_offset(start.camera_pose, x[self.at["camera_pose"]]),
            kinematics=start.kinematics.with_axes(axes),
            board=_offset(start.board, x[self.at["board"]]),
            spheres_mm=start.spheres_mm + x[self.at["spheres"]].reshape(-1, 3),
            lights_mm=lights,
        )

    def _name(self, frames: Sequence[str]) -> None:
        self._frames = len(frames)
        start = self.start
        names: list[str] = []
        scales: list[float] = []
        gives: list[float] = []
        self.at: dict[str, slice] = {}

        def block(key: str, entries: Sequence[tuple[str, float]], give: float = 1.0) -> None:
            self.at[key] = slice(len(names), len(names) + len(entries))
            names.extend(name for name, _ in entries)
            scales.extend(scale for _, scale in entries)
            gives.extend([give] * len(entries))

        camera = start.camera
        focal = camera.parameters[0]
        corner = np.hypot(camera.width, camera.height) / 2 / focal
        lens = {name: part * focal for name, part in _SCALE_PX.items()}
        lens |= {name: part / corner ** _POWER_LENS[name] for name, part in _SCALE_LENS.items()}
        block("lens", [(f"camera.{name}", lens[name]) for name in PARAMETERS], _LENS_GIVES_UP)
        block("camera_pose", _pose_names("camera_pose"))
        for axis in start.kinematics.axes:
            entries = [(f"axis.{axis.name}.direction.{i}", _SCALE_TURN) for i in (0, 1)]
            if axis.kind == "rotary":
                entries += [(f"axis.{axis.name}.point.{i}", _SCALE_MM) for i in (0, 1)]
            block(f"axis.{axis.name}", entries)
        block("board", _pose_names("board_to_sample"), _BOARD_GIVES_UP)
        count = len(start.spheres_mm)
        block("spheres", [(f"sphere.{s}.{k}", _SCALE_MM) for s in range(count) for k in "xyz"])
        for name in start.lights_mm:
            block(f"light.{name}", [(f"light.{name}.{k}", _SCALE_LIGHT_MM) for k in "xyz"])
        self.shared = len(names)
        slips = [
            (name, sd)
            for name, sd in zip(self.axis_names, self.slip_sd.tolist(), strict=True)
            if sd > 0
        ]
        block("slips", [(f"slip.{f}.{name}", sd) for f in frames for name, sd in slips])
        self.names, self.scale, self.give_up = tuple(names), np.array(scales), np.array(gives)

    def _axis(self, axis: Axis, x: Floats) -> Axis:
        offset = x[self.at[f"axis.{axis.name}"]]
        across = perpendicular(axis.direction)
        point = axis.point_mm + across @ offset[2:] if len(offset) > 2 else axis.point_mm
        return Axis(axis.name, axis.kind, axis.direction + across @ offset[:2], point)


def _pose_names(key: str) -> list[tuple[str, float]]:
    turns = [(f"{key}.turn.{k}", _SCALE_TURN) for k in "xyz"]
    return turns + [(f"{key}.shift.{k}", _SCALE_MM) for k in "xyz"]


def _offset(pose: Rigid, by: Floats) -> Rigid:
    return Rigid(rotation_of(by[:3]) @ pose.rotation, pose.translation + by[3:])
