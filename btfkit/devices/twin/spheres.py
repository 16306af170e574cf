"""Mirror spheres on the twin's holder: what they hide, shade and reflect."""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from btfkit.devices.poses import Floats
from btfkit.devices.twin import layout
from btfkit.devices.twin.geometry import Placed
from btfkit.devices.twin.lens import Lens

Image = NDArray[np.float32]
Bools = NDArray[np.bool_]
_MIRROR = 0.9
# The highlight of a point is as wide as the aperture makes it, px of a 640 pixel wide sensor.
_SPOT_PX = 0.5


@final
class Spheres:
    """Spheres of one radius, sunk into the plate."""

    def __init__(self, centres: Floats) -> None:
        self._centres = centres
        self._radius = layout.SPHERE_MM

    def shaded(self, points: Image, lamp: Floats) -> Bools:
        """Whether (..., 3) points lie in the shadow of a sphere."""
        to = (lamp - points).astype(np.float32)
        length2 = (to * to).sum(-1)
        dark = np.zeros(points.shape[:-1], bool)
        for centre in self._centres.astype(np.float32):
            from_ = centre - points
            along = np.clip((from_ * to).sum(-1) / length2, 0, 1)
            miss = from_ - along[..., None] * to
            dark |= (miss * miss).sum(-1) < self._radius**2
        return dark

    def seen(
        self, lens: Lens, placed: Placed, grid: int
    ) -> list[tuple[slice, slice, Bools, Image]]:
        """Sub-pixels of each visible sphere: rows, columns, which are hit, mirrored ray there.

        Returns:
            for each sphere a window of the sub-pixel grid, a mask (r, c) and (r, c, 6): hit
            point and direction of the mirrored ray, sample's frame.
        """
        found = []
        h, w = lens.rays.shape[:2]
        for centre in self._centres:
            col, row = lens.pixels(placed, centre)
            distance = float(np.linalg.norm(centre - placed.camera))
            # Half more than a sphere's image: windows may be generous.
            reach = 1.5 * self._radius * lens.focal_px / distance
            rows = _window(row, reach, grid, h)
            cols = _window(col, reach, grid, w)
            if rows.start >= rows.stop or cols.start >= cols.stop:
                continue
            ray = (
                np.concatenate(
                    [
                        lens.rays[rows, cols],
                        np.ones((*lens.rays[rows, cols].shape[:2], 1), np.float32),
                    ],
                    axis=-1,
                )
                @ placed.rotation
            )
            ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
            to = centre - placed.camera
            along = ray @ to
            inside = self._radius**2 - (to @ to - along**2)
            t = along - np.sqrt(np.maximum(inside, 0))
            at = placed.camera + t[..., None] * ray
            hit = (inside > 0) & (at[..., 2] > 0)
            normal = (at - centre) / self._radius
            mirrored = ray - 2 * (ray * normal).sum(-1, keepdims=True) * normal
            found.append((rows, cols, hit, np.concatenate([at, mirrored], -1).astype(np.float32)))
        return found

    def highlights(self, lens: Lens, placed: Placed, power: float, radius_mm: float) -> Image:
        """(h, w) of the lamp's images in the spheres, pi x radiance, summed over each pixel.

        Args:
            power: irradiance at the origin that the lamp gives, relative.
            radius_mm: of the lamp.
        """
        h, w = lens.size
        out = np.zeros((h, w), np.float32)
        for centre in self._centres:
            at = self._mirror_point(centre, placed)
            if at[2] <= 0:
                continue
            to_lamp = placed.lamp - at
            distance2 = float(to_lamp @ to_lamp)
            irradiance = power * layout.LAMP_MM**2 / distance2
            # A convex mirror scatters what meets its disc evenly over the sphere of directions.
            intensity = _MIRROR * irradiance * self._radius**2 / 4
            pixel_mm = float(np.linalg.norm(at - placed.camera)) / lens.focal_px
            spot = _SPOT_PX * w / 640
            image = radius_mm / np.sqrt(distance2) * self._radius / 2 / pixel_mm / 2
            _splat(
                out, lens.pixels(placed, at), float(np.hypot(spot, image)),
                np.pi * intensity / pixel_mm**2,
            )  # fmt: skip
        return out

    def _mirror_point(self, centre: Floats, placed: Placed) -> Floats:
        """Where a sphere mirrors the lamp into the camera."""
        at = centre
        for _ in range(40):
            half = _unit(placed.lamp - at) + _unit(placed.camera - at)
            at = centre + self._radius * _unit(half)
        return at


def _window(middle: float, reach: float, grid: int, count: int) -> slice:
    low, high = (middle - reach) * grid, (middle + reach) * grid
    return slice(int(np.clip(low, 0, count)), int(np.clip(high, 0, count)))


def _splat(image: Image, at: Floats, sigma: float, total: float) -> None:
    """Add a Gaussian spot, integrated over each pixel."""
    reach = int(np.ceil(5 * sigma)) + 1
    h, w = image.shape
    shares = []
    windows = []
    for middle, count in ((at[1], h), (at[0], w)):
        first = int(np.clip(np.floor(middle) - reach, 0, count))
        last = int(np.clip(np.floor(middle) + reach + 1, 0, count))
        edges = (np.arange(first, last + 1) - 0.5 - middle) / (sigma * np.sqrt(2))
        shares.append(np.diff(erf(edges)) / 2)
        windows.append(slice(first, last))
    image[windows[0], windows[1]] += np.float32(total) * np.outer(*shares).astype(np.float32)


def _unit(vector: Floats) -> Floats:
    return vector / np.linalg.norm(vector)
