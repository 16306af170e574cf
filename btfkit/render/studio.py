"""A material as a studio shows it: key, fill and rim light before grey."""

from __future__ import annotations

import math

import numpy as np

from btfkit.directions import from_angles
from btfkit.io import images
from btfkit.materials.base import Material
from btfkit.render.picture import to_rgb
from btfkit.render.preview import Scene, render
from btfkit.shapes.catalogue import shape_of

# Degrees from the viewer and from x towards y; irradiance.
KEY, FILL, RIM = ((40.0, 125.0), 0.9), ((55.0, 10.0), 0.3), ((110.0, 80.0), 0.6)
GREY = 0.18
_TILES = 2


def picture(material: Material, *, size: int = 192, shape: str = "sphere") -> bytes:
    """PNG bytes of a small square picture of a material.

    Channels other than RGB, one or wavelengths are shown by their mean.
    """
    channels, c = material.header.channels, len(material.header.channels)
    try:
        rgb = to_rgb(channels)
    except ValueError:
        rgb = np.full((c, 3), 1 / c, np.float32)
    form = shape_of(shape, repeat=_TILES, aspect=material.header.aspect, picture=1.0)
    shown = np.zeros((size, size, 3), np.float32)
    for angles, irradiance in (KEY, FILL, RIM):
        light = from_angles(*(math.radians(angle) for angle in angles))
        seen = render(Scene(material, form, light[None]), size=(size, size), samples=4)
        shown += irradiance * (seen.radiance @ rgb)
    return images.encode_png(shown + (1 - seen.cover[..., None]) * np.float32(GREY))
