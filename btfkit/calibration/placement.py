"""Where camera, light and the things beside the sample are in each frame.

The calibrated geometry knows best. Until there is one, what the builder of the rig wrote into
sequence.json is good enough to find patches that are several pixels wide.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit.calibration.geometry import Geometry
from btfkit.calibration.nominal import LAMP
from btfkit.errors import CalibrationError
from btfkit.sequence import TABLE, Frame

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


def of_geometry(geometry: Geometry, source: str) -> Placement:
    """From a rig's geometry, calibrated or as stated.

    Raises:
        CalibrationError: it knows no lamp.
    """
    if LAMP not in geometry.lights_mm:
        raise CalibrationError(
            f"rig of {_DOCUMENT} does not tell where camera and light are (no light.position_mm)",
            remedy="add axes, carries, camera and light, or light_x..z and view_x..z to each frame",
        )
    axes = {name for chain in geometry.kinematics.chains.values() for name in chain}

    def readings(frame: Frame) -> Mapping[str, float]:
        lost = sorted(axes - frame.axes.keys())
        if lost:
            raise CalibrationError(
                f"{frame.file} has no axis:{lost[0]}",
                remedy=f"add the column to {TABLE}, or take the axis out of {_DOCUMENT}",
            )
        return frame.axes

    def project(points: Floats, frame: Frame) -> Floats:
        return geometry.camera.project(geometry.sample_to_camera(readings(frame))(points))

    return Placement(
        source, project,
        lambda frame: geometry.view_position(readings(frame)),
        lambda frame: geometry.light_position(LAMP, readings(frame)),
        True,
    )  # fmt: skip
