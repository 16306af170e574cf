"""What is rendered: a material on a shape under lights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

from btfkit.materials.base import Material
from btfkit.render.area import AreaLight
from btfkit.render.environment import Environment
from btfkit.shapes.closed import Floats, Shape


@final
@dataclass(frozen=True, eq=False)
class Scene:
    """A material on a shape under lights.

    Attributes:
        material: what the shape is covered with.
        shape: in the object's frame.
        lights: (n, 3) directions of distant lights; each alone makes a white surface
            that faces it 1.
        environment: light from everywhere, or None.
        irradiance: (n,) of each light on a surface that faces it; None is 1 of each.
        panels: area lights near the object.
        blur: factor on footprints: 1 is a pixel's own.
    """

    material: Material
    shape: Shape
    lights: Floats
    environment: Environment | None = None
    irradiance: Sequence[float] | None = None
    panels: Sequence[AreaLight] = ()
    blur: float = 1.0
