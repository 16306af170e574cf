"""A camera as calibration sees it: a pinhole with the distortion of OpenCV's five numbers.

Camera frame: x along image columns, y down the rows, z along the gaze. Pixel centres lie at
whole numbers, column first.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
# Newton steps that bring an undistorted point from a distorted one to rounding.
_STEPS = 8


@final
@dataclass(frozen=True, eq=False)
class Camera:
    """Pinhole and distortion; where it stands is a `Rigid` beside it.

    Attributes:
        width, height: pixels of its frames.
        parameters: (9,) fx, fy, cx, cy in pixels, k1, k2, p1, p2, k3.

    Raises:
        ValueError: parameters that no camera has.
    """

    width: int
    height: int
    parameters: Floats

    def __post_init__(self) -> None:
        values = np.asarray(self.parameters, float)
        if values.shape != (len(PARAMETERS),):
            raise ValueError(f"parameters have shape {values.shape}; expected ({len(PARAMETERS)},)")
        if not np.isfinite(values).all() or min(values[:2]) <= 0:
            raise ValueError(
                f"parameters {values.tolist()} are no camera: focal lengths must be > 0"
            )
        object.__setattr__(self, "parameters", values)

    @property
    def matrix(self) -> Floats:
        """(3, 3) camera matrix as OpenCV takes it."""
        fx, fy, cx, cy = self.parameters[:4]
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])

    def project(self, points: ArrayLike) -> Floats:
        """Pixels of points.

        Args:
            points: (..., 3) in the camera's frame, any unit.

        Returns:
            (..., 2) column and row; NaN behind the camera and where the distortion folds over.
        """
        pixels, _, _ = self.project_with_derivatives(points)
        return pixels

    def project_with_derivatives(self, points: ArrayLike) -> tuple[Floats, Floats, Floats]:
        """Pixels (..., 2), and their derivatives by point (..., 2, 3) and parameter (..., 2, 9)."""
        points = np.asarray(points, float)
        ahead = np.where(points[..., 2] > 0, points[..., 2], np.nan)
        plane = points[..., :2] / ahead[..., None]
        bent, by_plane, by_number = _distort(plane, self.parameters[4:])
        focal = self.parameters[:2]
        pixels = bent * focal + self.parameters[2:4]
        # d(x/z, y/z) by (x, y, z)
        x, y = plane[..., 0], plane[..., 1]
        zero, one = np.zeros_like(x), np.ones_like(x)
        ray = np.stack([np.stack([one, zero, -x], -1), np.stack([zero, one, -y], -1)], -2)
        by_point = focal[:, None] * (by_plane @ (ray / ahead[..., None, None]))
        by_parameter = np.zeros((*pixels.shape, len(PARAMETERS)))
        by_parameter[..., 0, 0] = bent[..., 0]
        by_parameter[..., 1, 1] = bent[..., 1]
        by_parameter[..., 0, 2] = by_parameter[..., 1, 3] = 1
        by_parameter[..., 4:] = focal[:, None] * by_number
        folded = (x**2 + y**2 >= self._fold()) | np.isnan(ahead)
        pixels[folded] = np.nan
        return pixels, by_point, by_parameter

    def rays(self, pixels: ArrayLike) -> Floats:
        """(..., 3) directions with z = 1, camera frame, that pixels (..., 2) look along.

        NaN where the distortion cannot be undone.
        """
        pixels = np.asarray(pixels, float)
        target = (pixels - self.parameters[2:4]) / self.parameters[:2]
        plane = target.copy()
        for _ in range(_STEPS):
            bent, by_plane, _ = _distort(plane, self.parameters[4:])
            off = target - bent
            (a, b), (c, d) = np.moveaxis(by_plane, (-2, -1), (0, 1))
            with np.errstate(all="ignore"):
                det = a * d - b * c
                across, down = off[..., 0], off[..., 1]
                step = np.stack([d * across - b * down, a * down - c * across], -1) / det[..., None]
            plane = plane + step
            # One pixel that has no ray must not end the search for the others'.
            if not np.nanmax(np.abs(step), initial=0.0) > 1e-15:
                break
        with np.errstate(invalid="ignore"):
            lost = ~(np.abs(off).max(axis=-1) < 1e-9) | ((plane**2).sum(-1) >= self._fold())
        plane[lost] = np.nan
        return np.concatenate([plane, np.ones_like(plane[..., :1])], axis=-1)

    def to_json(self) -> dict[str, Any]:
        """Sizes and named parameters."""
        values = dict(zip(PARAMETERS, self.parameters.tolist(), strict=True))
        return {"width": self.width, "height": self.height, **values}

    @staticmethod
    def from_json(entry: Mapping[str, Any]) -> Camera:
        """The camera that `to_json` wrote."""
        values = np.array([float(entry.get(name, 0.0)) for name in PARAMETERS])
        return Camera(int(entry["width"]), int(entry["height"]), values)

    def _fold(self) -> float:
        """Squared radius beyond which a longer way out comes back in the image."""
        k1, k2, _, _, k3 = self.parameters[4:]
        roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])
        ahead = roots[(np.abs(roots.imag) < 1e-12) & (roots.real > 0)].real
        return float(ahead.min()) if ahead.size else np.inf


def _distort(plane: Floats, numbers: Floats) -> tuple[Floats, Floats, Floats]:
    """Distorted places (..., 2), derivatives by place (..., 2, 2) and by number (..., 2, 5)."""
    k1, k2, p1, p2, k3 = numbers
    x, y = plane[..., 0], plane[..., 1]
    square = x * x + y * y
    radial = 1 + square * (k1 + square * (k2 + square * k3))
    slope = k1 + square * (2 * k2 + square * 3 * k3)
    bent = np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x),
            y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
        ],
        -1,
    )
    cross = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    by_plane = np.stack(
        [
            np.stack([radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x, cross], -1),
            np.stack([cross, radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x], -1),
        ],
        -2,
    )
    powers = np.stack([square, square**2, square**3], -1)
    by_number = np.empty((*plane.shape, 5))
    for row, along in ((0, x), (1, y)):
        by_number[..., row, [0, 1, 4]] = along[..., None] * powers
    by_number[..., 0, 2] = by_number[..., 1, 3] = 2 * x * y
    by_number[..., 0, 3] = square + 2 * x * x
    by_number[..., 1, 2] = square + 2 * y * y
    return bent, by_plane, by_number
