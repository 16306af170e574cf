"""Light from a panel near the object, as from a studio's softbox."""

from __future__ import annotations

from typing import final

import numpy as np

from btfkit import directions
from btfkit.shapes.closed import Floats

# Objects lie within this of the origin; a panel stands outside.
_OBJECT = 1.0
# Places a side that the panel's light at the origin is summed from.
_FINE = 64
# Beyond this size, in distances, its irradiance is no more a sum over so many places.
_WIDEST, _FARTHEST = 100.0, 1e6


@final
class AreaLight:
    """A rectangle that faces the origin and shines alike from every place into every direction.

    A white diffuser at the origin that faces it is 1.

    Args:
        way: (3,) direction to its middle, object frame. distance: of the middle.
        size: width and height; y is up as far as it can.

    Raises:
        ValueError: numbers that are not positive, or a panel that reaches into the object.
    """

    def __init__(self, way: Floats, size: tuple[float, float], distance: float) -> None:
        if not (np.isfinite([*size, distance]).all() and min(*size, distance) > 0):
            raise ValueError(f"a panel of {size[0]:g} x {size[1]:g} at {distance:g}; all above 0")
        if max(size) > _WIDEST * distance or not 1 / _FARTHEST < min(size) <= distance * _FARTHEST:
            raise ValueError(
                f"a panel of {size[0]:g} x {size[1]:g} at {distance:g}; expected at most "
                f"{_WIDEST:g} times as large as far: --env lights from all around"
            )
        if distance > _FARTHEST:
            raise ValueError(f"a panel at {distance:g}; expected at most {_FARTHEST:g}")
        if distance <= _OBJECT:
            raise ValueError(
                f"a panel at {distance:g} reaches into the object, of radius 1; put it farther"
            )
        self._normal = -directions.normalize(way)
        upright = abs(self._normal[1]) < 1 - 1e-9
        up = np.array([0.0, 1.0, 0.0] if upright else [0.0, 0.0, 1.0])
        right = directions.normalize(np.cross(up, -self._normal))
        self._middle = -self._normal * distance
        self._right, self._up = right * size[0], np.cross(-self._normal, right) * size[1]
        even = (np.arange(_FINE) + 0.5) / _FINE
        square = np.stack(np.meshgrid(even, even), axis=-1).reshape(-1, 2)
        origin = np.zeros((len(square), 3))
        self._strength = 1.0
        way_in, weight = self.sample(square, origin)
        # On a surface that faces the middle, light from aslant counts by its cosine.
        self._strength = 1 / float((weight[:, 0] * -(way_in @ self._normal)).mean())

    def sample(self, square: Floats, point: Floats) -> tuple[Floats, Floats]:
        """One direction (m, 3) from each point to the panel, and the weight (m, 1) of its light.

        The mean of weight x reflectance is the light that leaves towards the eye.

        Args:
            square: (m, 2) even numbers in 0..1. point: (m, 3) object frame.
        """
        place = (
            self._middle + (square[:, :1] - 0.5) * self._right + (square[:, 1:] - 0.5) * self._up
        )
        way = place - point
        reach = np.linalg.norm(way, axis=1, keepdims=True)
        way = way / reach
        facing = np.maximum(-(way @ self._normal), 0)[:, None]
        return way, self._strength * facing / reach**2
