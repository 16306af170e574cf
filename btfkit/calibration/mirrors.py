"""What a camera sees of a mirror sphere: its outline, and the highlight of a small light."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from btfkit.calibration.camera_model import Camera

Floats = NDArray[np.float64]
# Each turn of the fixed point shrinks the error by radius / distance.
_TURNS = 60
_STEP_MM = 1e-3


def highlight(centre: Floats, light: Floats, radius: Floats) -> Floats:
    """Where a sphere mirrors a light into the camera.

    Args:
        centre, light: (n, 3) camera frame, mm. radius: (n,) mm.

    Returns:
        (n, 3) points on the spheres whose normal halves the way to the camera and to the light.
    """
    normal = _unit(_unit(-centre) + _unit(light - centre))
    for _ in range(_TURNS):
        point = centre + radius[:, None] * normal
        turned = _unit(_unit(-point) + _unit(light - point))
        moved = np.abs(turned - normal).max(initial=0.0)
        normal = turned
        if moved < 1e-15:
            break
    return centre + radius[:, None] * normal


def highlight_derivatives(centre: Floats, light: Floats, radius: Floats) -> tuple[Floats, Floats]:
    """(n, 3, 3) derivatives of `highlight` by centre and by light, from central differences.

    With steps of 1 um the points are smooth over 1e5 steps and exact to 1e-13: 1e-8 is left.
    """
    both = []
    for moved in (0, 1):
        columns = []
        for k in range(3):
            step = np.zeros(3)
            step[k] = _STEP_MM
            up = highlight(centre + step * (moved == 0), light + step * (moved == 1), radius)
            down = highlight(centre - step * (moved == 0), light - step * (moved == 1), radius)
            columns.append((up - down) / (2 * _STEP_MM))
        both.append(np.stack(columns, -1))
    return both[0], both[1]


def outline_residuals(
    camera: Camera, pixels: Floats, centre: Floats, radius: Floats
) -> tuple[Floats, Floats, Floats]:
    """How far outline pixels are from the cone of rays that touch a sphere.

    Args:
        pixels: (n, 2) on the outline. centre: (n, 3) camera frame, mm. radius: (n,) mm.

    Returns:
        (n,) pixels, outwards positive; derivatives by centre (n, 3) and by camera (n, 9).
    """
    rays = camera.rays(pixels)
    length = np.linalg.norm(rays, axis=-1, keepdims=True)
    unit = rays / length
    along = (centre * unit).sum(-1, keepdims=True)
    away = centre - along * unit
    miss = np.linalg.norm(away, axis=-1)
    focal = camera.parameters[0]
    scale = focal / along[:, 0]
    by_centre = (away / miss[:, None]) * scale[:, None]
    by_centre -= ((miss - radius) * scale / along[:, 0])[:, None] * unit
    # d residual / d unit ray, then to the plane z = 1, then to parameters at a fixed pixel
    by_unit = -(along / miss[:, None]) * away * scale[:, None]
    by_unit -= ((miss - radius) * scale / along[:, 0])[:, None] * centre
    across = by_unit - (by_unit * unit).sum(-1, keepdims=True) * unit
    by_plane = (across / length)[:, :2]
    _, by_point, by_number = camera.project_with_derivatives(rays)
    plane_by_number = -np.linalg.solve(by_point[:, :, :2], by_number)
    by_camera = (by_plane[:, None] @ plane_by_number)[:, 0]
    by_camera[:, 0] += (miss - radius) / along[:, 0]
    return (miss - radius) * scale, by_centre, by_camera


def _unit(vector: Floats) -> Floats:
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)
