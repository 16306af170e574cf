"""What frames show of a rig: known points, and mirror spheres with the lamps in them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@final
@dataclass(frozen=True, eq=False)
class Sighting:
    """Known points seen in one frame.

    Attributes:
        name: of the frame, for messages.
        readings: of the axes, radians or mm.
        points_mm: (m, 3) in the frame that `on` names. pixels: (m, 2).
        sd_px: (m, 2) their standard deviations; None where nothing tells.
    """

    name: str
    readings: Mapping[str, float]
    points_mm: Floats
    pixels: Floats
    on: Literal["board", "sample"] = "board"
    sd_px: Floats | None = None


@final
@dataclass(frozen=True, eq=False)
class SphereSighting:
    """One mirror sphere seen in one frame.

    Attributes:
        name: of the frame. readings: of the axes.
        sphere: number of the sphere in the geometry.
        outline: (m, 2) pixels on its outline; may be empty.
        highlights: pixel (2,) of each light that it mirrors, by the light's name.
    """

    name: str
    readings: Mapping[str, float]
    sphere: int
    outline: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    highlights: Mapping[str, Floats] = field(default_factory=dict)
