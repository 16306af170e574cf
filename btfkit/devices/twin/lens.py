"""The lens of the twin: which ray a place on the sensor sees, and what glass does to an image."""

from __future__ import annotations

from typing import final

import cv2
import numpy as np
from numpy.typing import NDArray

from btfkit.devices.poses import Floats
from btfkit.devices.twin.geometry import Placed, Truth
from btfkit.devices.twin.imperfections import Imperfections

Image = NDArray[np.float32]
_BLUR_PX = 0.5
# Blur by distance from the plane of focus, px a mm, of a 640 pixel wide sensor.
_OUT_OF_FOCUS = 0.012
_STRAY, _GLARE, _GLARE_PX = 0.006, 0.004, 24.0
_VIGNETTE = 0.2


@final
class Lens:
    """Rays and image faults of one camera.

    Args:
        truth: focal length, centre and distortion.
        size: (h, w) pixels. grid: sub-pixels a side of a pixel, each with a ray.
        imperfections: which faults it has.

    Attributes:
        size: (h, w) pixels. focal_px: mean of x and y.
        rays: (h grid, w grid, 2) x and y of each sub-pixel's ray at z = 1, camera frame.
    """

    def __init__(
        self, truth: Truth, size: tuple[int, int], grid: int, imperfections: Imperfections
    ) -> None:
        h, w = size
        self._truth, self.size, self._imperfections = truth, size, imperfections
        self.focal_px = float(truth.focal_px.mean())
        inside = (np.arange(grid) + 0.5) / grid - 0.5
        rows = (np.arange(h)[:, None] + inside).reshape(-1)
        cols = (np.arange(w)[:, None] + inside).reshape(-1)
        x, y = np.meshgrid(cols, rows)
        seen = np.stack([x, y], axis=-1)
        self.rays = self._undistorted((seen - truth.centre_px) / truth.focal_px).astype(np.float32)
        radius2 = (
            (np.stack(np.meshgrid(np.arange(w), np.arange(h)), -1) - truth.centre_px) ** 2
        ).sum(-1)
        radius2 /= (w**2 + h**2) / 4
        self._fall = (1 - imperfections.of("vignetting", _VIGNETTE) * radius2).astype(np.float32)

    def pixels(self, placed: Placed, points: Floats) -> Floats:
        """(..., 2) columns and rows at which points (..., 3) of the sample's frame are seen."""
        seen = (points - placed.camera) @ placed.rotation.T
        plane = seen[..., :2] / seen[..., 2:]
        return self._distorted(plane) * self._truth.focal_px + self._truth.centre_px

    def blurred(self, image: Image, depth_mm: Image, focus_mm: float) -> Image:
        """The image out of focus by how far each pixel's surface is from the plane of focus."""
        if "defocus" not in self._imperfections:
            return image
        scale = self.size[1] / 640
        sigma = scale * np.hypot(_BLUR_PX, _OUT_OF_FOCUS * (depth_mm - focus_mm)).astype(np.float32)
        levels = scale * np.array([_BLUR_PX, 1.0, 1.6, 2.4], np.float32)
        stack = [cv2.GaussianBlur(image, (0, 0), float(level)) for level in levels]
        out = stack[0]
        # Between two levels the variance, not the deviation, mixes linearly.
        for low, high, one in zip(levels, levels[1:], stack[1:], strict=False):
            share = np.clip((sigma**2 - low**2) / (high**2 - low**2), 0, 1)[..., None]
            out = out + share * (one - out)
        return out

    def dimmed(self, image: Image) -> Image:
        """The image with vignetting and stray light."""
        out = image * self._fall[..., None]
        if "stray-light" in self._imperfections:
            small = cv2.resize(out, None, fx=0.125, fy=0.125, interpolation=cv2.INTER_AREA)
            wide = cv2.GaussianBlur(small, (0, 0), _GLARE_PX * self.size[1] / 640 / 8)
            glare = cv2.resize(wide, (out.shape[1], out.shape[0]), interpolation=cv2.INTER_LINEAR)
            mean = out.mean((0, 1), dtype=np.float64).astype(np.float32)
            out = (1 - _STRAY - _GLARE) * out + _STRAY * mean + np.float32(_GLARE) * glare
        return out

    def flat(self) -> Image:
        """(h, w) of an even field."""
        return self._fall

    def _distorted(self, plane: Floats) -> Floats:
        k1, k2, p1, p2 = self._truth.distortion
        x, y = plane[..., 0], plane[..., 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * k2)
        return np.stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ],
            axis=-1,
        )

    def _undistorted(self, seen: Floats) -> Floats:
        plane = seen
        # The distortion is a few parts in a thousand: each step gains two digits.
        for _ in range(8):
            plane = plane + seen - self._distorted(plane)
        return plane
