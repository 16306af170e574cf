"""Round outlines in a picture, to a fraction of a pixel: edges along rays, and a circle of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]
# From the centre of an outline to its edge.
RAYS = 360


def edge_points(picture: Floats, centre: Floats, radius: float, reach: float) -> Floats:
    """(p, 2) steepest places along rays from a centre, near a radius."""
    from scipy.ndimage import gaussian_filter1d, map_coordinates

    angle = 2 * np.pi * np.arange(RAYS) / RAYS
    step = np.arange(radius - reach, radius + reach, 0.25)
    outward = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    at = centre + step[None, :, None] * outward[:, None]
    inside = np.all((at > 1) & (at < np.array(picture.shape[::-1]) - 2), axis=-1)
    profile = map_coordinates(picture, [at[..., 1], at[..., 0]], order=1, mode="nearest")
    slope = gaussian_filter1d(profile, 4.0, axis=1, order=1, mode="nearest")
    strength = np.where(inside, np.abs(slope), 0)
    strength[:, :4] = strength[:, -4:] = 0
    best = np.argmax(strength, axis=1)
    rays = np.arange(RAYS)
    top = strength[rays, best]
    left, right = strength[rays, best - 1], strength[rays, np.minimum(best + 1, len(step) - 1)]
    bend = left - 2 * top + right
    shift = np.where(bend < 0, 0.5 * (left - right) / np.where(bend < 0, bend, -1), 0)
    good = top > max(0.3 * float(np.median(top)), 1e-9)
    distance = step[best] + 0.25 * np.clip(shift, -1, 1)
    return (centre + distance[:, None] * outward)[good]


def consistent(points: Floats, radius: float) -> int:
    """How many points lie on one circle."""
    if len(points) < 10:
        return 0
    middle, size, _ = circle(points)
    off = np.abs(np.hypot(*(points - middle).T) - size)
    return int(np.sum(off < max(0.7, 0.008 * radius)))


def circle(points: Floats) -> tuple[Floats, float, NDArray[np.bool_]]:
    """Centre, radius and which points count, by least squares that leaves outliers out."""
    keep = np.ones(len(points), bool)
    centre, radius = np.median(points, axis=0), 0.0
    radius = float(np.median(np.hypot(*(points - centre).T)))
    for _ in range(12):
        for _ in range(3):
            off = points[keep] - centre
            distance = np.maximum(np.hypot(*off.T), 1e-9)
            design = np.column_stack([off / distance[:, None], np.ones(len(off))])
            change, *_ = np.linalg.lstsq(design, distance - radius, rcond=None)
            centre, radius = centre + change[:2], radius + float(change[2])
        error = np.abs(np.hypot(*(points - centre).T) - radius)
        spread = max(1.4826 * float(np.median(error[keep])), 0.1)
        new = error < 3 * spread
        if np.array_equal(new, keep) or new.sum() < 10:
            break
        keep = new
    return centre, radius, keep


def axis_ratio(points: Floats) -> float:
    """Longest to shortest axis of the conic through points, 1 for a circle."""
    middle = points.mean(axis=0)
    x, y = ((points - middle) / np.abs(points - middle).max()).T
    design = np.column_stack([x * x, x * y, y * y, x, y])
    a, b, c, *_ = np.linalg.lstsq(design, np.ones(len(x)), rcond=None)[0]
    low, high = np.linalg.eigvalsh([[a, b / 2], [b / 2, c]])
    return float(np.sqrt(high / low)) if low > 0 else float("inf")
