"""The adjustment of a rig: error against CPU seconds with few and many views.

Synthetic: a tilting turntable that is off by 0.6 degrees and 1 mm, 48 corners with noise of
0.02 px, tilts to 72 degrees. Errors are of the true points in views that the adjustment has not
seen, of the focal length and of view directions.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np

from btfkit.calibration.bundle import Sighting, adjust
from btfkit.calibration.camera_model import Camera
from btfkit.calibration.geometry import Geometry
from btfkit.calibration.kinematics import Axis, Kinematics, Rigid

NOISE_PX = 0.02
_VIEWS = {False: (8, 16, 48), True: (5, 8, 16)}
_WIDTH, _HEIGHT, _DISTANCE_MM, _PITCH_MM = 1000, 750, 260.0, 9.0
_LENS = np.array([1480.0, 1482.0, 503.0, 371.0, -0.2, 0.1, 5e-4, -3e-4, 0.0])
_GUESS = np.array([1450.0, 1450.0, 499.5, 374.5, 0, 0, 0, 0, 0])
_HELD_OUT = ((5, 20), (35, 115), (50, 190), (65, 235), (72, 315))


def cells(*, seed: int, quick: bool) -> list[dict[str, Any]]:
    """A row a number of views."""
    return [_cell(count, np.random.default_rng(seed)) for count in _VIEWS[quick]]


def _cell(count: int, rng: np.random.Generator) -> dict[str, Any]:
    drawn, true = _rigs(rng)
    points = _corners()
    sightings = []
    for k in range(count):
        at = {"tilt": np.radians(72 * k / (count - 1)), "turn": np.radians(137.5 * k)}
        pixels = true.camera.project(true.sample_to_camera(at)(points))
        pixels += NOISE_PX * rng.standard_normal(pixels.shape)
        sightings.append(Sighting(f"view {k}", at, points, pixels))
    start = time.process_time()
    found = adjust(drawn, sightings)
    seconds = time.process_time() - start
    square, apart = [], []
    for tilt, turn in _HELD_OUT:
        at = {"tilt": np.radians(tilt), "turn": np.radians(turn)}
        seen, expected = (
            g.camera.project(g.sample_to_camera(at)(points)) for g in (found.geometry, true)
        )
        square.append(((seen - expected) ** 2).sum(1).mean())
        one, other = (g.view_position(at) for g in (found.geometry, true))
        sine = np.linalg.norm(np.cross(one, other)) / np.linalg.norm(one) / np.linalg.norm(other)
        apart.append(float(np.degrees(sine)))
    focal = float(found.geometry.camera.parameters[0])
    return {
        "views": count, "cpu_s": seconds, "held out, px": float(np.sqrt(np.mean(square))),
        "focal length, relative": abs(focal / _LENS[0] - 1),
        "its sd, relative": found.sd("camera.fx") / focal,
        "view, degrees": max(apart), "condition": found.condition,
    }  # fmt: skip


def _rigs(rng: np.random.Generator) -> tuple[Geometry, Geometry]:
    """As drawn, and as it is."""
    turned = np.diag([1.0, -1.0, -1.0])
    pose = Rigid(turned, np.array([0.0, 0.0, _DISTANCE_MM]))
    lines = {"tilt": np.array([0.0, 1.0, 0.0]), "turn": np.array([0.0, 0.0, 1.0])}
    axes = tuple(Axis(name, "rotary", line, np.zeros(3)) for name, line in lines.items())
    drawn = Geometry(
        Camera(_WIDTH, _HEIGHT, _GUESS), pose, Kinematics(axes, {"sample": ("tilt", "turn")})
    )
    off = [
        replace(
            axis, direction=axis.direction + 0.01 * rng.standard_normal(3),
            point_mm=rng.standard_normal(3),
        )
        for axis in axes
    ]  # fmt: skip
    moved = Rigid.from_vectors(0.02 * rng.standard_normal(3), 3 * rng.standard_normal(3)) @ pose
    camera = Camera(_WIDTH, _HEIGHT, _LENS)
    return drawn, replace(
        drawn, camera=camera, camera_pose=moved, kinematics=drawn.kinematics.with_axes(off)
    )


def _corners() -> np.ndarray:
    """(48, 3) of a board of 8 x 6, mm."""
    x, y = np.meshgrid(np.arange(8) - 3.5, np.arange(6) - 2.5)
    return _PITCH_MM * np.stack([x.ravel(), y.ravel(), np.zeros(48)], -1)
