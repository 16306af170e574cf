"""Where lights are: directions from one sphere, positions where several see the same light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit import directions
from btfkit.calibration.highlights import Spot

Floats = NDArray[np.floating]
# A distance known no better than this is no distance.
_WORST_DISTANCE = 0.25


@final
@dataclass(frozen=True, eq=False)
class Light:
    """One light.

    Attributes:
        direction: (3,) unit vector from the origin, frame of the photograph.
        position: (3,) relative to the origin, or None where the spheres don't tell it.
        sd: deviation of the direction, radians. distance_sd: relative, infinite without position.
        residual: rms angle between the spheres' directions and the light, radians; NaN for one.
        spheres: how many say so. note: why there is no position.
    """

    direction: Floats
    position: Floats | None
    sd: float
    distance_sd: float
    residual: float
    spheres: int
    note: str = ""

    def record(self) -> dict[str, Any]:
        """As JSON's own types, angles in degrees."""
        return {
            "direction": self.direction.tolist(),
            "position": None if self.position is None else self.position.tolist(),
            "sd_deg": float(np.degrees(self.sd)),
            "distance_sd": self.distance_sd if np.isfinite(self.distance_sd) else None,
            "residual_deg": None if np.isnan(self.residual) else float(np.degrees(self.residual)),
            "spheres": self.spheres, "note": self.note,
        }  # fmt: skip


def locate(spots: Sequence[Spot], origin: Floats) -> Light:
    """A light from its spots on one or several spheres.

    Args:
        spots: one a sphere, at least one.
        origin: (3,) what direction and position are relative to.
    """
    direction, sd, residual = _common_direction(spots)
    if len(spots) < 2:
        return Light(
            direction,
            None,
            sd,
            np.inf,
            np.nan,
            1,
            "one sphere tells no distance: the direction is that from where it shows the light",
        )
    position, covariance, angles, used = _intersection(list(spots))
    away = position - origin
    distance = float(np.linalg.norm(away))
    along = away / max(distance, 1e-300)
    distance_sd = float(np.sqrt(along @ covariance @ along)) / max(distance, 1e-300)
    inward = float(np.mean([np.dot(position - s.point, s.light) for s in used])) <= 0
    if inward or not distance_sd < _WORST_DISTANCE:
        note = "the rays are parallel within their errors: the light is far, or in line with them"
        return Light(direction, None, sd, np.inf, residual, len(spots), note)
    across = (np.trace(covariance) - along @ covariance @ along) / 2
    known = float(np.sqrt(max(across, 0.0))) / distance
    rms = float(np.sqrt(np.mean(angles**2)))
    return Light(along, position - origin, known, distance_sd, rms, len(used))


def _common_direction(spots: Sequence[Spot]) -> tuple[Floats, float, float]:
    """Weighted mean of directions, its deviation, and their rms angle from it."""
    weight = np.array([1 / s.sd**2 for s in spots])
    mean = directions.normalize(sum(w * s.light for w, s in zip(weight, spots, strict=True)))
    sd = float(1 / np.sqrt(weight.sum()))
    if len(spots) < 2:
        return mean, sd, float("nan")
    angle = np.array([_angle(s.light, mean) for s in spots])
    return mean, sd, float(np.sqrt(np.mean(angle**2)))


def _intersection(spots: list[Spot]) -> tuple[Floats, Floats, Floats, list[Spot]]:
    """The point that rays see under the least angles, covariance (3, 3), angles (k,), rays used.

    With four rays or more, one is left out where the others then agree within five deviations.
    """
    point, weight, angles = _seen_from(spots)
    off = _misfit(spots, angles)
    if len(spots) > 3 and off > 5:
        subsets = [spots[:i] + spots[i + 1 :] for i in range(len(spots))]
        misfits = [_misfit(subset, _seen_from(subset)[2]) for subset in subsets]
        best = int(np.argmin(misfits))
        if misfits[best] < max(5, off / 5):
            spots = subsets[best]
            point, weight, angles = _seen_from(spots)
            off = misfits[best]
    normal = np.zeros((3, 3))
    for s, w in zip(spots, weight, strict=True):
        normal += w * (np.eye(3) - np.outer(s.light, s.light))
    # Where rays miss each other by more than they ought to, the point is known worse.
    covariance = np.linalg.pinv(normal, hermitian=True, rcond=1e-14) * max(1.0, off) ** 2
    return point, covariance, angles, spots


def _seen_from(spots: Sequence[Spot]) -> tuple[Floats, Floats, Floats]:
    """The nearest point of rays, their weights and the angles (k,) by which they miss it."""
    point = _nearest(spots, np.ones(len(spots)))
    for _ in range(3):
        # Angles weigh by distance: near the point a miss is a large angle.
        distance = np.array([max(float(np.linalg.norm(point - s.point)), 1e-9) for s in spots])
        weight = 1 / (distance * np.array([s.sd for s in spots])) ** 2
        point = _nearest(spots, weight)
    return point, weight, np.array([_angle(point - s.point, s.light) for s in spots])


def _misfit(spots: Sequence[Spot], angles: Floats) -> float:
    """Angles in their own deviations, rms by the number of free ones."""
    off = np.sum((angles / np.array([s.sd for s in spots])) ** 2)
    return float(np.sqrt(off / max(2 * len(spots) - 3, 1)))


def _nearest(spots: Sequence[Spot], weight: Floats) -> Floats:
    """The point of least squared distance from rays."""
    normal, target = np.zeros((3, 3)), np.zeros(3)
    # Far from the origin the squares of coordinates would swallow the distances.
    middle = np.mean([s.point for s in spots], axis=0)
    for s, w in zip(spots, weight, strict=True):
        across = w * (np.eye(3) - np.outer(s.light, s.light))
        normal += across
        target += across @ (s.point - middle)
    return middle + np.linalg.lstsq(normal, target, rcond=1e-14)[0]


def _angle(one: Floats, other: Floats) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(one, other)), np.dot(one, other)))
