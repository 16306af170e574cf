"""The eye of a picture: far away, so that all its rays are parallel."""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit import directions

Floats = NDArray[np.floating]
# Rays start that far before the middle of the object; shapes are of size 1.
_FAR = 32.0


@final
class Camera:
    """Parallel rays along one view direction; y is up in the picture.

    Args:
        view: (3,) direction from the object to the eye, object frame.
        size: (h, w) pixels.
        half_height: of the picture, in the object's lengths.

    Attributes:
        direction: (3,) of all rays, into the picture.
        right, down: (3,) step from a pixel to its neighbour.
    """

    def __init__(self, view: Floats, size: tuple[int, int], half_height: float) -> None:
        view = directions.normalize(view)
        # Seen along y, up is where it tends to when tilted there from the front.
        up = np.array([0.0, 1.0, 0.0]) if abs(view[1]) < 1 - 1e-9 else np.array([0, 0, -view[1]])
        right = directions.normalize(np.cross(up, view))
        pixel = 2 * half_height / size[0]
        self.size = size
        self.direction = -view
        self.right = right * pixel
        self.down = -np.cross(view, right) * pixel

    def origins(self, place: Floats) -> Floats:
        """(m, 3) starts of rays through places (m, 2): columns and rows, pixels, corner 0,0."""
        h, w = self.size
        col, row = (place - [w / 2, h / 2]).T[..., None]
        return col * self.right + row * self.down - _FAR * self.direction
