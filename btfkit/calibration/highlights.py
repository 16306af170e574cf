"""Lights as mirror spheres show them: one bright spot a sphere and light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.calibration.spheres import Optics, Sphere

Floats = NDArray[np.floating]
# The outermost rim shows the scene behind, squeezed to nothing.
_RIM = 0.985
_LARGEST_SHARE = 0.08


@final
@dataclass(frozen=True)
class Spot:
    """The reflection of a light on a sphere.

    Attributes:
        point: (3,) where on the sphere. light: (3,) unit vector from there to the light.
        pixel: (2,) column and row. sd: deviation of `light`, radians.
    """

    point: Floats
    light: Floats
    pixel: Floats
    sd: float


def find_spot(picture: Floats, sphere: Sphere, optics: Optics, *, floor: float) -> Spot | None:
    """The light on one sphere in one photograph.

    The mean is taken over directions, not over pixels: near the rim a pixel is a wide angle, and
    the middle of the spot is not the middle of the lamp.

    Args:
        picture: (h, w) linear.
        sphere: whose reflection is looked for.
        optics: of the camera.
        floor: value that a spot has to exceed.

    Returns:
        None where nothing on the sphere stands out as one spot.
    """
    radius = int(np.ceil(sphere.radius_px))
    column, row = (round(float(x)) for x in sphere.pixel)
    top, left = max(row - radius, 0), max(column - radius, 0)
    window = picture[top : row + radius + 1, left : column + radius + 1]
    rows, cols = np.indices(window.shape)
    pixels = np.stack([cols + left, rows + top], axis=-1).astype(float)
    distance = np.hypot(*np.moveaxis(pixels - sphere.pixel, -1, 0)) / sphere.radius_px
    disc = (distance < _RIM) & np.isfinite(window)
    if disc.sum() < 20:
        return None
    peak = float(window[disc].max())
    ground = float(np.median(window[disc]))
    if peak <= floor or peak <= 2 * abs(ground):
        return None
    threshold = 0.5 * (peak + ground)
    blob = _largest(disc & (window > threshold), window)
    if blob is None or blob.sum() > _LARGEST_SHARE * disc.sum():
        return None
    around, beside = _surroundings(blob, np.asarray(disc))
    ground = float(np.median(window[beside])) if beside.any() else ground
    points, lights = sphere.reflect(optics, pixels[around])
    seen = np.isfinite(lights).all(axis=-1, keepdims=True)
    weight = np.where(seen, np.maximum(window[around] - ground, 0)[:, None], 0)
    if not weight.sum() > 0:
        return None
    mean = np.sum(weight * np.where(seen, lights, 0), axis=0)
    point = np.sum(weight * np.where(seen, points, 0), axis=0) / weight.sum()
    light = mean / np.linalg.norm(mean)
    pixel = np.sum(weight * pixels[around], axis=0) / weight.sum()
    return Spot(point, light, pixel, _deviation(sphere, pixel, int(blob.sum())))


def _surroundings(blob: Any, disc: Any) -> tuple[Any, Any]:
    """A spot with its soft edge, and a ring about it: a spot of few pixels is mostly edge."""
    from scipy.ndimage import binary_dilation

    grow = 1 + int(0.15 * np.sqrt(blob.sum()))
    around = np.asarray(binary_dilation(blob, np.ones((3, 3)), grow))
    ring = np.asarray(binary_dilation(around, np.ones((3, 3)), 2)) & ~around
    return np.asarray(around & disc), np.asarray(ring & disc)


def _largest(mask: NDArray[np.bool_], window: Floats) -> NDArray[np.bool_] | None:
    """The connected part that holds most light: other spheres and gloss make lesser ones."""
    from scipy.ndimage import label
    from scipy.ndimage import sum as total

    parts, count = label(mask, np.ones((3, 3)))
    if not count:
        return None
    light = total(window, parts, np.arange(1, count + 1))
    chosen: NDArray[np.bool_] = parts == 1 + int(np.argmax(light))
    return chosen


def _deviation(sphere: Sphere, pixel: Floats, count: int) -> float:
    """Deviation of a reflected direction, radians, of what is known of sphere and spot.

    A shift of the spot by e against the centre turns the normal by e / (r cos) and the
    direction by twice that; an error of the radius counts with the distance from the centre.
    """
    share = min(float(np.hypot(*(pixel - sphere.pixel))) / sphere.radius_px, 0.99)
    spot = 0.3 / np.sqrt(max(count, 1)) + 0.02
    shift = np.sqrt(spot**2 + sphere.sd_px**2 * (1 + share**2))
    return float(2 * shift / (sphere.radius_px * np.sqrt(1 - share**2)))


def mirrors(spheres: list[Sphere], spots: list[list[Spot | None]]) -> list[int]:
    """Which round things are mirrors: those whose spot is there and moves with the light.

    Args:
        spheres: m round things. spots: of each, n photographs.
    """
    found = []
    for i, (sphere, seen) in enumerate(zip(spheres, spots, strict=True)):
        places = np.array([s.pixel for s in seen if s is not None])
        if len(places) < max(0.3 * len(seen), 1):
            continue
        # A printed dot, or a lamp of the room, does not move.
        if len(seen) > 3 and np.ptp(places, axis=0).max() < 0.05 * sphere.radius_px:
            continue
        found.append(i)
    return found
