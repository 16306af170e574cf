"""Where everything of the twin really is, and where it is once the axes have moved."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, final

import numpy as np

from btfkit.devices.poses import Chains, Floats, Motion, rotation
from btfkit.devices.twin.imperfections import Imperfections


@final
@dataclass(frozen=True, eq=False)
class Truth:
    """The rig as it is.

    Attributes:
        chains: the axes as they stand, and what they carry.
        camera: rotation of the camera and its centre at zero; focal_px and centre_px (x, y).
        distortion: k1, k2 radial, p1, p2 tangential, of normalised coordinates.
        lamp: centre at zero, mm.
        board: pose of the board's plane in the sample's frame.
        spheres: (4, 3) centres, mm. displaced: (24 + 1, 2) of patches and white, mm.
    """

    chains: Chains
    camera: tuple[Floats, Floats]
    focal_px: Floats
    centre_px: Floats
    distortion: tuple[float, float, float, float]
    lamp: Floats
    board: Motion
    spheres: Floats
    displaced: Floats

    @staticmethod
    def of(
        nominal: Mapping[str, Any], imperfections: Imperfections, rng: np.random.Generator
    ) -> Truth:
        """The nominal rig with its imperfections drawn."""

        def off(name: str, most: float, *shape: int) -> Floats:
            # Drawn in any case, so that switching one imperfection off leaves the others alone.
            return imperfections.of(name, most) * rng.uniform(-1, 1, shape)

        lines = {}
        for axis in nominal["axes"]:
            tilt = off("axes", np.radians(0.1), 3)
            direction = np.asarray(axis["direction"], float) + tilt
            point = np.asarray(axis["point_mm"], float) + off("axes", 0.3, 3)
            lines[axis["name"]] = (direction / np.linalg.norm(direction), point)
        camera = nominal["camera"]
        turn = _small_turn(off("camera-pose", np.radians(0.2), 3))
        width = nominal["sensor"]["width"]
        target = nominal["target"]
        lens = imperfections.of("distortion", 1.0)
        board = _small_turn(off("holder", np.radians(0.01), 3))
        return Truth(
            chains=Chains(lines, nominal["carries"]),
            camera=(
                turn @ np.asarray(camera["rotation"], float),
                np.asarray(camera["position_mm"], float) + off("camera-pose", 1.0, 3),
            ),
            focal_px=np.asarray(camera["focal_px"]) * (1 + off("camera-pose", 5e-3, 1)),
            centre_px=np.asarray(camera["centre_px"]) + off("camera-pose", 4.0, 2) * width / 640,
            distortion=(-0.6 * lens, 3.0 * lens, 8e-4 * lens, -6e-4 * lens),
            lamp=np.asarray(nominal["light"]["position_mm"], float) + off("lamp-pose", 2.0, 3),
            board=Motion(board, off("holder", 0.02, 3)),
            spheres=np.array([s["centre_mm"] for s in target["spheres"]], float)
            + off("holder", 0.2, len(target["spheres"]), 3),
            displaced=off("holder", 0.15, len(target["patches"]) + 1, 2),
        )

    def placed(self, angles: Mapping[str, float]) -> Placed:
        """Camera and lamp seen from the sample, with the axes at `angles` (true ones)."""
        to_sample = self.chains.body("sample", angles).inverse()
        camera = self.chains.body("camera", angles).then(to_sample)
        lamp = self.chains.body("light", angles).then(to_sample)
        turn, centre = self.camera
        # Rows of `turn` are the camera's axes.
        return Placed(turn @ camera.turn.T, camera.of(centre), lamp.of(self.lamp), lamp.turn)


class Placed(NamedTuple):
    """Camera and lamp in the sample's frame.

    rotation: (3, 3), rows are the camera's x, y and z. camera, lamp: (3,) mm. lamp_turn: (3, 3)
    of the lamp's own frame, whose z points away from the sample.
    """

    rotation: Floats
    camera: Floats
    lamp: Floats
    lamp_turn: Floats


def _small_turn(vector: Floats) -> Floats:
    angle = float(np.linalg.norm(vector))
    return rotation(vector / angle, angle) if angle > 0 else np.eye(3)
