"""Where camera, light and the things beside the sample are in each frame.

The calibrated geometry knows best. Until there is one, what the builder of the rig wrote into
sequence.json is good enough to find patches that are several pixels wide.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.calibration.kinematics import check_rotation
from btfkit.errors import CalibrationError
from btfkit.sequence import Frame

Floats = NDArray[np.floating]
_DOCUMENT = "sequence.json"


@final
@dataclass(frozen=True, eq=False)
class Placement:
    """Poses of every frame, sample frame, mm.

    Attributes:
        source: "calibrated", "nominal" or "directions".
        project: points (p, 3) in a frame to columns and rows (p, 2); None where no camera is
            known.
        view, light: position (3,) of the camera and of the lamp in a frame, or a unit vector
            where `near` is False.
        near: whether they are positions.
    """

    source: str
    project: Callable[[Floats, Frame], Floats] | None
    view: Callable[[Frame], Floats]
    light: Callable[[Frame], Floats]
    near: bool

    def directions(self, frame: Frame, at: Floats) -> tuple[Floats, Floats]:
        """Unit vectors (3,) from a point (3,) to light and view."""
        light, view = self.light(frame), self.view(frame)
        if self.near:
            light, view = light - at, view - at
        return light / np.linalg.norm(light), view / np.linalg.norm(view)

    def distance_mm(self, frame: Frame, at: Floats) -> float | None:
        """From a point (3,) to the lamp; None where only its direction is known."""
        return float(np.linalg.norm(self.light(frame) - at)) if self.near else None


def of_directions() -> Placement:
    """What the table says of light and view itself; for far lights and cameras."""
    return Placement(
        "directions", None,
        lambda frame: np.array(frame.need("view")), lambda frame: np.array(frame.need("light")),
        False,
    )  # fmt: skip


def calibrated(geometry: Any, light: str) -> Placement:
    """From a calibrated geometry.

    Args:
        geometry: of the rig, with `camera`, `sample_to_camera`, `view_position`, `light_position`.
        light: name of the lamp in it.
    """

    def project(points: Floats, frame: Frame) -> Floats:
        seen = geometry.sample_to_camera(frame.axes)(np.asarray(points, float))
        return np.asarray(geometry.camera.project(seen))

    return Placement(
        "calibrated", project,
        lambda frame: np.asarray(geometry.view_position(frame.axes)),
        lambda frame: np.asarray(geometry.light_position(light, frame.axes)),
        True,
    )  # fmt: skip


def nominal(rig: Mapping[str, Any]) -> Placement:
    """From section rig of sequence.json, as it stands: a pinhole without distortion.

    Raises:
        CalibrationError: no axes, camera or light in it, or what is none.
    """
    try:
        axes = {str(axis["name"]): _Axis.of(axis) for axis in rig["axes"]}
        carries = {body: [axes[name] for name in rig["carries"].get(body, [])] for body in
                   ("sample", "camera", "light")}  # fmt: skip
        camera, lamp = rig["camera"], np.asarray(rig["light"]["position_mm"], float)
        eye = np.asarray(camera["position_mm"], float)
        turn = np.asarray(camera["rotation"], float)
        focal, centre = (np.asarray(camera[key], float) for key in ("focal_px", "centre_px"))
        if eye.shape != (3,) or turn.shape != (3, 3) or lamp.shape != (3,) or focal.shape != (2,):
            raise ValueError(f"shapes {eye.shape}, {turn.shape}, {lamp.shape}, {focal.shape}")
        check_rotation(turn)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise CalibrationError(
            f"rig of {_DOCUMENT} does not tell where camera and light are ({error!r})",
            remedy="add axes, carries, camera and light, or light_x..z and view_x..z to each frame",
        ) from error

    def to_sample(body: str, point: Floats, frame: Frame) -> Floats:
        for axis in reversed(carries[body]):
            point = axis.moved(point, frame)
        for axis in carries["sample"]:
            point = axis.moved(point, frame, back=True)
        return point

    def project(points: Floats, frame: Frame) -> Floats:
        seen = np.atleast_2d(np.asarray(points, float))
        for axis in reversed(carries["sample"]):
            seen = axis.moved(seen, frame)
        for axis in carries["camera"]:
            seen = axis.moved(seen, frame, back=True)
        local = (seen - eye) @ turn.T
        return np.asarray(local[:, :2] / local[:, 2:] * focal + centre)

    return Placement(
        "nominal", project,
        lambda frame: to_sample("camera", eye, frame),
        lambda frame: to_sample("light", lamp, frame),
        True,
    )  # fmt: skip


@final
@dataclass(frozen=True, eq=False)
class _Axis:
    """A line that something turns about or slides along."""

    name: str
    direction: Floats
    point: Floats
    linear: bool

    @staticmethod
    def of(entry: Mapping[str, Any]) -> _Axis:
        direction = np.asarray(entry["direction"], float)
        point = np.asarray(entry.get("point_mm", (0, 0, 0)), float)
        with np.errstate(over="ignore"):
            length = float(np.linalg.norm(direction))
        if direction.shape != (3,) or point.shape != (3,) or not 0 < length < np.inf:
            raise ValueError(f"axis {entry['name']!r} has no direction")
        unit = direction / length
        return _Axis(str(entry["name"]), unit, point, entry.get("kind") == "linear")

    def moved(self, points: Floats, frame: Frame, *, back: bool = False) -> Floats:
        """Points (..., 3) after the axis moved to its reading, or back from it."""
        if self.name not in frame.axes:
            raise CalibrationError(
                f"{frame.file} has no axis:{self.name}",
                remedy="add the column to sequence.csv, or take the axis out of sequence.json",
            )
        reading = -frame.axes[self.name] if back else frame.axes[self.name]
        if self.linear:
            return np.asarray(points + reading * self.direction)
        off = points - self.point
        # Rodrigues' formula.
        along = (off @ self.direction)[..., None] * self.direction
        across = np.cross(self.direction, off)
        turned = np.cos(reading) * off + np.sin(reading) * across + (1 - np.cos(reading)) * along
        return np.asarray(turned + self.point)
