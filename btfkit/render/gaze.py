"""What a material is asked where it is looked at: its frame, uv, footprint and curvature there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from btfkit.directions import rotation
from btfkit.materials.base import Material
from btfkit.render.chords import chords
from btfkit.shapes.closed import Floats, Shape, Surface

# Interpolated normals may turn from the eye at silhouettes; a material is seen from above.
_LOWEST_Z = 1e-3


class Gaze(NamedTuple):
    """All of m queries but the light.

    Attributes:
        frame: (m, 3, 3) rows x along dp/du, y against dp/dv and the normal on the viewer's side.
        uv: (m, 2) within a tile. view: (m, 3) in the frame.
        footprint, curvature: (m,) as in `Query`.
        drift: (m, 4) as `Material.evaluate` takes it; (m, 0) where nothing drifts.
        outside: (m,) whether the outside of the shape is seen.
    """

    frame: Floats
    uv: Floats
    view: Floats
    footprint: Floats
    curvature: Floats
    drift: Floats
    outside: NDArray[np.bool_]

    @property
    def told_drift(self) -> Floats | None:
        """The drift as a query takes it."""
        return self.drift if self.drift.size else None


def gaze(material: Material, shape: Shape, surface: Surface, toward: Floats, pixel: Floats) -> Gaze:
    """What is asked of a material on a surface.

    A sheet seen from behind, or through a mirrored texture, is the mirror image of its front: x
    and y follow the texture and the normal the viewer, whichever hand that makes.

    Args:
        material: what the shape is covered with.
        surface: m points of the shape.
        toward: (m, 3) unit vectors to the viewer, object frame.
        pixel: (2, 3) steps between neighbouring samples, object frame; their Gaussian kernel has
            half such a step as standard deviation.
    """
    side = np.where(dot(surface.flat, toward) < 0, -1.0, 1.0)
    x = surface.du - surface.normal * dot(surface.du, surface.normal)[:, None]
    x /= np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-30)
    right_handed = np.cross(surface.normal, x)
    y = right_handed * np.where(dot(right_handed, surface.dv) > 0, -1.0, 1.0)[:, None]
    frame = np.stack([x, y, surface.normal * side[:, None]], axis=1)
    view = np.einsum("ijk,ik->ij", frame, toward)
    view[:, 2] = np.maximum(view[:, 2], _LOWEST_Z)
    curvature, drift = np.zeros(len(view)), np.zeros((len(view), 0))
    if material.has_curvature:
        along = _bend_along(surface.bend, dot(x, toward), dot(right_handed, toward))
        curvature = side * shape.tile * along
        ray = uv_step(surface, dot(surface.normal, toward)[:, None] * surface.normal - toward)
        # Seen from within, nothing is grazed.
        outer = np.where((side > 0)[:, None], view, np.array([0.0, 0.0, 1.0]))
        found = chords(
            shape, surface, toward, outer, ray, np.where(side > 0, curvature, 0.0),
            aspect=material.header.aspect, thickness=material.thickness,
        )  # fmt: skip
        if found is not None:
            seen = view[found.rows] / np.linalg.norm(view[found.rows], axis=1, keepdims=True)
            frame[found.rows] = rotation(seen, found.view) @ frame[found.rows]
            view[found.rows], curvature[found.rows] = found.view, found.curvature
            if material.has_drift and found.drift.any():
                drift = np.zeros((len(view), 4))
                drift[found.rows] = found.drift
    footprint = _footprint(material, surface, toward, pixel)
    uv = surface.uv - np.floor(surface.uv)
    return Gaze(frame, uv, view, footprint, curvature, drift, side > 0)


def dot(a: Floats, b: Floats) -> Floats:
    """(m,) dot products of rows."""
    return np.einsum("ij,ij->i", a, b)


def _footprint(material: Material, surface: Surface, toward: Floats, pixel: Floats) -> Floats:
    """Standard deviation (m,), texels: of the isotropic kernel with the pixel's mean variance."""
    cosine = dot(surface.flat, toward)
    cosine = np.copysign(np.maximum(np.abs(cosine), _LOWEST_Z), cosine)
    grid = np.array(material.header.grid[::-1], float)
    variance = np.zeros(len(toward))
    for step in pixel:
        # The step of the pixel, carried along the ray onto the surface.
        slide = step - toward * (surface.flat @ step / cosine)[:, None]
        variance += np.square(uv_step(surface, slide) * grid).sum(axis=1) / 8
    footprint = np.sqrt(variance)
    return footprint if material.has_levels else np.minimum(footprint, 0.5)


def uv_step(surface: Surface, step: Floats) -> Floats:
    """Steps in uv (m, 2), tiles, for steps on the surface (m, 3)."""
    du, dv = surface.du, surface.dv
    uu, uv, vv = dot(du, du), dot(du, dv), dot(dv, dv)
    pu, pv = dot(step, du), dot(step, dv)
    area = np.maximum(uu * vv - uv**2, 1e-30)
    return np.stack([(vv * pu - uv * pv) / area, (uu * pv - uv * pu) / area], axis=1)


def _bend_along(bend: Floats, x: Floats, y: Floats) -> Floats:
    """Normal curvature (m,) along the projected view; straight from above the mean of all."""
    square = x**2 + y**2
    straight = square < 1e-12
    along = bend[:, 0] * x**2 + 2 * bend[:, 1] * x * y + bend[:, 2] * y**2
    mean = (bend[:, 0] + bend[:, 2]) / 2
    return np.where(straight, mean, along / np.where(straight, 1.0, square))
