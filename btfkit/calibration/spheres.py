"""Mirror spheres in photographs: where they are, to a fraction of a pixel, and which way they look.

Frame of a photograph: x right (columns), y up, z towards the camera. A far camera (no focal
length) looks along -z everywhere and sees circles; a near one stands in the origin, and the
outline of a sphere is the cone of rays that touch it: an ellipse, longer towards the rim of the
picture.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit import directions
from btfkit.calibration.outlines import RAYS, axis_ratio, circle, consistent, edge_points
from btfkit.errors import CalibrationError

Floats = NDArray[np.floating]
_MOST_SIDE = 640
_SMALLEST_PX = 8.0


@final
@dataclass(frozen=True)
class Optics:
    """How pixels look into the scene.

    Attributes:
        width, height: of the picture, pixels.
        focal_px: focal length, pixels; None for a camera so far away that its rays are parallel.
    """

    width: int
    height: int
    focal_px: float | None = None

    def centred(self, pixel: Floats) -> Floats:
        """(..., 2) right and up of the picture's centre, of column and row (..., 2)."""
        middle = np.array([(self.width - 1) / 2, (self.height - 1) / 2])
        return (np.asarray(pixel, float) - middle) * [1.0, -1.0]

    def rays(self, pixel: Floats) -> tuple[Floats, Floats]:
        """Origins and unit directions (..., 3) of the rays that pixels (..., 2) see along."""
        xy = self.centred(pixel)
        if self.focal_px is None:
            zero = np.zeros((*xy.shape[:-1], 1))
            return np.concatenate([xy, zero], -1), np.broadcast_to(
                [0.0, 0.0, -1.0], (*xy.shape[:-1], 3)
            )
        z = np.full((*xy.shape[:-1], 1), -self.focal_px)
        unit = directions.normalize(np.concatenate([xy, z], axis=-1))
        return np.zeros_like(unit), unit


@final
@dataclass(frozen=True, eq=False)
class Sphere:
    """One sphere: in pixels of a far camera, in radii before a near one, or in mm.

    Attributes:
        pixel: (2,) column and row of the centre of its outline. radius_px: mean, of the outline.
        centre: (3,) in the frame of the photograph. radius: in the same unit.
        rms_px: of the outline's points from the fitted one. sd_px: deviation of centre and radius.
        axis_ratio: longest to shortest axis of an ellipse through the outline.
        coverage: share of the outline that was seen.
    """

    pixel: Floats
    radius_px: float
    centre: Floats
    radius: float
    rms_px: float
    sd_px: float
    axis_ratio: float
    coverage: float

    def record(self) -> dict[str, Any]:
        """As JSON's own types."""
        return {
            "pixel": self.pixel.tolist(), "radius_px": self.radius_px,
            "centre": self.centre.tolist(), "radius": self.radius, "rms_px": self.rms_px,
            "sd_px": self.sd_px, "axis_ratio": self.axis_ratio, "coverage": self.coverage,
        }  # fmt: skip

    def reflect(self, optics: Optics, pixel: Floats) -> tuple[Floats, Floats]:
        """Where pixels (..., 2) see the sphere (..., 3), and towards what it reflects (..., 3).

        NaN outside the outline.
        """
        origin, ray = optics.rays(pixel)
        to = origin - self.centre
        along = np.sum(to * ray, axis=-1)
        inside = along**2 - np.sum(to**2, axis=-1) + self.radius**2
        if optics.focal_px is None:
            # Parallel rays start far in front, wherever their origin was put.
            inside = self.radius**2 - np.sum((to - along[..., None] * ray) ** 2, axis=-1)
        with np.errstate(invalid="ignore"):
            point = origin + (-along - np.sqrt(inside))[..., None] * ray
        normal = (point - self.centre) / self.radius
        cosine = -np.sum(normal * ray, axis=-1, keepdims=True)
        return point, ray + 2 * cosine * normal


def find_spheres(pictures: list[Floats], optics: Optics, *, most: int = 8) -> list[Sphere]:
    """Round outlines in pictures of one scene, best first; mirrors among them tell by their spots.

    Args:
        pictures: (h, w) each, such as the median and the maximum over all lights.
        optics: of the camera.
        most: how many at most.
    """
    fitted = [_fitted(pictures, optics, start) for start in _candidates(pictures)]
    best = _distinct([sphere for sphere in fitted if sphere is not None])[: 2 * most]
    return _distinct([_outermost(pictures, optics, sphere) for sphere in best])[:most]


def _distinct(spheres: list[Sphere]) -> list[Sphere]:
    """One outline a place, best first."""
    found: list[Sphere] = []
    for sphere in spheres:
        near = [
            np.hypot(*(sphere.pixel - s.pixel)) < 0.8 * max(s.radius_px, sphere.radius_px)
            for s in found
        ]
        if not any(near):
            found.append(sphere)
        elif _outranks(sphere, found[at := near.index(True)]):
            found[at] = sphere
    return sorted(found, key=_goodness, reverse=True)


def in_proportion(
    spheres: list[Sphere], optics: Optics, diameter_mm: float | None
) -> tuple[list[Sphere], Floats]:
    """Spheres in one unit, lying on one plane, and the point (3,) of it before the camera.

    Args:
        spheres: as found.
        optics: of the camera.
        diameter_mm: of the largest; None leaves pixels of a far camera, or radii of the largest.
    """
    largest = max(s.radius_px for s in spheres)
    if optics.focal_px is None:
        unit = 1.0 if diameter_mm is None else diameter_mm / 2 / largest
        factors, plane = [unit] * len(spheres), 0.0
    else:
        # A sphere that lies on the plane at distance d has radius d q / (1 + q).
        share = [s.radius_px / optics.focal_px for s in spheres]
        unit = 1.0 if diameter_mm is None else diameter_mm / 2
        distance = unit * (1 + max(share)) / max(share)
        factors, plane = [distance * q / (1 + q) for q in share], -distance
    sized = [
        replace(s, centre=s.centre * f, radius=s.radius * f)
        for s, f in zip(spheres, factors, strict=True)
    ]
    return sized, np.array([0.0, 0.0, plane])


def _outermost(pictures: list[Floats], optics: Optics, sphere: Sphere) -> Sphere:
    """The largest outline about one: a mirror shows the horizon as a circle within its own."""
    for grown in (1.15, 1.27, 1.41, 1.56):
        column, row = sphere.pixel.tolist()
        larger = _fitted(pictures, optics, (column, row, grown * sphere.radius_px))
        if larger is not None and _outranks(larger, sphere):
            return _outermost(pictures, optics, larger)
    return sphere


def _outranks(one: Sphere, other: Sphere) -> bool:
    """Whether an outline is to be taken instead of another about the same place."""
    if one.radius_px > 1.05 * other.radius_px:
        apart = float(np.hypot(*(one.pixel - other.pixel)))
        return one.coverage > 0.7 and apart < 0.3 * other.radius_px
    if other.radius_px > 1.05 * one.radius_px:
        return not _outranks(other, one)
    return bool(_goodness(one) > _goodness(other))


def _goodness(sphere: Sphere) -> float:
    return sphere.coverage / (0.3 + sphere.rms_px) * np.sqrt(sphere.radius_px)


def _candidates(pictures: list[Floats]) -> list[tuple[float, float, float]]:
    """(column, row, radius) of circles, roughly, in all pictures."""
    import cv2

    found: list[tuple[float, float, float]] = []
    for picture in pictures:
        scale = min(1.0, _MOST_SIDE / max(picture.shape))
        small = cv2.resize(
            picture.astype(np.float32), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA
        )
        low, high = np.percentile(small, [1, 99])
        codes = np.clip((small - low) / max(float(high - low), 1e-9) * 255, 0, 255).astype(np.uint8)
        codes = cv2.GaussianBlur(codes, (0, 0), 1.2)
        side = min(codes.shape)
        circles = cv2.HoughCircles(
            codes, cv2.HOUGH_GRADIENT_ALT, dp=1.5, minDist=0.03 * side, param1=120, param2=0.7,
            minRadius=max(int(0.012 * side), 4), maxRadius=int(0.4 * side),
        )  # fmt: skip
        if circles is None:
            continue
        flat = np.asarray(circles, float).reshape(-1, circles.shape[-1])[:40, :3]
        # Pixel centres at whole numbers, before and after.
        found += [((x + 0.5) / scale - 0.5, (y + 0.5) / scale - 0.5, r / scale) for x, y, r in flat]
    return [each for each in found if each[2] >= _SMALLEST_PX]


def _fitted(
    pictures: list[Floats], optics: Optics, start: tuple[float, float, float]
) -> Sphere | None:
    """The outline near a rough circle, to a fraction of a pixel; None where there is none."""
    points: Floats = np.empty((0, 2))
    centre, radius = np.array(start[:2]), start[2]
    for width in (0.25, 0.12, 0.08):
        reach = max(width * radius, 4.0)
        edges = [edge_points(picture, centre, radius, reach) for picture in pictures]
        points = edges[int(np.argmax([consistent(e, radius) for e in edges]))]
        if len(points) < 0.4 * RAYS:
            return None
        centre, radius, keep = circle(points)
        points = points[keep]
        if len(points) < 0.4 * RAYS or radius < _SMALLEST_PX:
            return None
    if np.any(centre < 0) or np.any(centre > [optics.width - 1, optics.height - 1]):
        return None
    ratio = axis_ratio(points)
    if optics.focal_px is None:
        off = np.abs(np.hypot(*(points - centre).T) - radius)
        # It lies on the plane z = 0.
        place, size = np.array([*optics.centred(centre), radius]), radius
    else:
        place, size, off = _touching(points, optics, 1.0)
    rms = float(np.sqrt(np.mean(off**2)))
    sd = rms * float(np.sqrt(2 / len(points))) + 0.02
    sphere = Sphere(centre, radius, place, size, rms, sd, ratio, len(points) / RAYS)
    return sphere if rms < max(1.0, 0.01 * radius) else None


def _touching(points: Floats, optics: Optics, radius: float) -> tuple[Floats, float, Floats]:
    """Centre of a sphere of known radius whose outline these are, and errors (p,) in pixels.

    Rays d that touch the sphere make one angle with the ray c to its centre: d . c = cos.
    """
    _, rays = optics.rays(points)
    answer, *_ = np.linalg.lstsq(rays, np.ones(len(rays)), rcond=None)
    length = float(np.linalg.norm(answer))
    cosine = 1 / length
    sine = float(np.sqrt(max(1 - cosine**2, 1e-12)))
    focal = float(optics.focal_px or 1.0)
    off = np.abs(rays @ (answer / length) - cosine) / sine * focal
    return answer / length * radius / sine, radius, off


def need_spheres(found: list[Sphere], where: str) -> None:
    """Refuse to go on without one.

    Raises:
        CalibrationError: no sphere.
    """
    if not found:
        raise CalibrationError(
            f"{where}: no mirror sphere is seen",
            remedy="a shiny ball of 50 pixels across or more has to lie beside the object, whole "
            "and in focus; or photograph it first under the same lights and name that folder "
            "with --spheres",
        )
