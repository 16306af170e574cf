"""The geometry of a rig: camera, axes, board, mirror spheres and lights, and what follows of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.calibration.camera_model import Camera
from btfkit.calibration.kinematics import Axis, Kinematics, Rigid
from btfkit.errors import CalibrationError

Floats = NDArray[np.float64]


@final
@dataclass(frozen=True, eq=False)
class Geometry:
    """Where everything is. Lab frame: the sample's while every axis reads zero; mm.

    Attributes:
        camera: how it projects. camera_pose: lab to camera while every axis reads zero.
        kinematics: the axes and what they carry.
        board: board to sample.
        spheres_mm: (s, 3) centres of mirror spheres, sample frame. radii_mm: (s,).
        lights_mm: position (3,) of each light by name, lab frame while every axis reads zero.
    """

    camera: Camera
    camera_pose: Rigid
    kinematics: Kinematics
    board: Rigid = field(default_factory=Rigid.identity)
    spheres_mm: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    radii_mm: Floats = field(default_factory=lambda: np.zeros(0))
    lights_mm: Mapping[str, Floats] = field(default_factory=dict)

    def sample_to_camera(self, readings: Mapping[str, float]) -> Rigid:
        """From the sample's frame to the camera's at these readings (radians, mm)."""
        return self.camera_pose @ self.kinematics.between("sample", "camera", readings)

    def view_position(self, readings: Mapping[str, float]) -> Floats:
        """(3,) the camera's centre, sample frame, mm."""
        return self.sample_to_camera(readings).inverse().translation

    def light_position(self, name: str, readings: Mapping[str, float]) -> Floats:
        """(3,) a light, sample frame, mm.

        Raises:
            CalibrationError: no such light.
        """
        if name not in self.lights_mm:
            raise CalibrationError(
                f"no light {name!r} is calibrated; there are {', '.join(self.lights_mm) or 'none'}"
            )
        return self.kinematics.between("light", "sample", readings)(self.lights_mm[name])

    @staticmethod
    def placed(
        camera: Camera,
        kinematics: Kinematics,
        board: Rigid,
        pose: Rigid,
        readings: Mapping[str, float],
    ) -> Geometry:
        """The geometry in which one frame shows the board in `pose` (board to camera)."""
        to_lab = kinematics.between("sample", "camera", readings) @ board
        return Geometry(camera, pose @ to_lab.inverse(), kinematics, board)

    def to_json(self) -> dict[str, Any]:
        return {
            "camera": self.camera.to_json(),
            "camera_pose": self.camera_pose.to_json(),
            "axes": [
                {
                    "name": axis.name,
                    "kind": axis.kind,
                    "direction": axis.direction.tolist(),
                    "point_mm": axis.point_mm.tolist(),
                }
                for axis in self.kinematics.axes
            ],
            "chains": {body: list(names) for body, names in self.kinematics.chains.items()},
            "board_to_sample": self.board.to_json(),
            "spheres_mm": self.spheres_mm.tolist(),
            "radii_mm": self.radii_mm.tolist(),
            "lights_mm": {name: np.asarray(at).tolist() for name, at in self.lights_mm.items()},
        }

    @staticmethod
    def from_json(entry: Mapping[str, Any]) -> Geometry:
        """The geometry that `to_json` wrote."""
        axes = [
            Axis(a["name"], a["kind"], np.array(a["direction"]), np.array(a["point_mm"]))
            for a in entry["axes"]
        ]
        chains = {body: tuple(names) for body, names in entry["chains"].items()}
        return Geometry(
            Camera.from_json(entry["camera"]),
            Rigid.from_json(entry["camera_pose"]),
            Kinematics(tuple(axes), chains),
            Rigid.from_json(entry["board_to_sample"]),
            np.array(entry["spheres_mm"], float).reshape(-1, 3),
            np.array(entry["radii_mm"], float),
            {name: np.array(at, float) for name, at in entry["lights_mm"].items()},
        )
