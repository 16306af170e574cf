"""From directions in the sample's frame to axes, and from points of the holder to pixels."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit import directions
from btfkit.devices.poses import Chains, Floats
from btfkit.errors import DeviceError

TURN, CAMERA_ARM, LIGHT_TURN, LIGHT_ARM = "turntable", "camera_arm", "light_turn", "light_arm"
_LAYOUT = {"sample": [TURN], "camera": [CAMERA_ARM], "light": [LIGHT_TURN, LIGHT_ARM]}


@final
class Aim:
    """How a rig of the described layout is pointed.

    The turntable turns the sample about z, the camera's arm tilts about y, the lamp turns about z
    and tilts about y; all nominal.

    Args:
        description: of the rig.

    Raises:
        DeviceError: a rig with other axes.
    """

    def __init__(self, description: Mapping[str, Any]) -> None:
        carries = {body: list(names) for body, names in description["carries"].items()}
        if carries != _LAYOUT:
            raise DeviceError(
                f"the rig carries {carries}; directions can be reached with {_LAYOUT}",
                remedy="give the axes these names, or write sequence.csv with your own program",
            )
        self._description = description
        self._chains = Chains.nominal(description)

    def axes(self, view: Floats, light: Floats) -> Floats:
        """(n, 4) turntable, camera_arm, light_turn, light_arm, radians, for (n, 3) directions."""
        theta_v, phi_v = directions.to_angles(view)
        theta_l, phi_l = directions.to_angles(light)
        turn = _from_zero(-np.asarray(phi_v, np.float64))
        return np.stack(
            [turn, theta_v, _from_zero(np.asarray(phi_l, np.float64) + turn), theta_l], axis=-1
        )

    def pixels(self, places: Mapping[str, float], points: Floats) -> Floats:
        """(n, 2) columns and rows where (n, 3) points of the sample's frame are seen, nominal."""
        camera = self._description["camera"]
        lab = self._chains.body("sample", places).of(points)
        back = self._chains.body("camera", places).inverse().of(lab)
        seen = (back - np.asarray(camera["position_mm"])) @ np.asarray(camera["rotation"]).T
        return seen[:, :2] / seen[:, 2:] * camera["focal_px"] + np.asarray(camera["centre_px"])

    def window(self, places: Mapping[str, float], area: Mapping[str, Any]) -> NDArray[np.bool_]:
        """(h, w) pixels that lie in a rectangle of the target, a little inside its border."""
        sensor = self._description["sensor"]
        shape = (int(sensor["height"]), int(sensor["width"]))
        x, y = area.get("centre_mm", (0.0, 0.0))[:2]
        w, h = (0.8 * side / 2 for side in area["size_mm"])
        corners = np.array(
            [[x - w, y - h, 0], [x + w, y - h, 0], [x + w, y + h, 0], [x - w, y + h, 0]]
        )
        col, row = self.pixels(places, corners).T
        rows, cols = np.mgrid[: shape[0], : shape[1]]
        inside = [
            (col[k - 1] - cols) * (row[k] - rows) - (col[k] - cols) * (row[k - 1] - rows)
            for k in range(4)
        ]
        signs = np.stack(inside)
        return np.asarray((signs >= 0).all(0) | (signs <= 0).all(0))


def _from_zero(angle: Floats) -> Floats:
    """Angles within one turn from 0; what rounds to a whole turn is 0."""
    turned = angle % (2 * math.pi)
    return np.where(turned > 2 * math.pi - 1e-9, 0.0, turned)
