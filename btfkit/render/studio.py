"""Materials and BTFs as a studio shows them: key, fill and rim light before grey."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import BTF
from btfkit.directions import from_angles
from btfkit.io import images
from btfkit.materials.base import Material
from btfkit.render.picture import to_rgb
from btfkit.render.preview import Scene, render
from btfkit.shapes.catalogue import shape_of
from btfkit.shapes.closed import Floats

# Degrees from the viewer and from x towards y, and irradiance, of key, fill and rim light.
ANGLES = ((40.0, 125.0), (55.0, 10.0), (110.0, 80.0))
IRRADIANCE = (0.9, 0.3, 0.6)
GREY = (0.18, 0.18, 0.18)
_TILES, _MOST_SIDE = 2, 160


def lights() -> Floats:
    """(3, 3) directions of key, fill and rim light, object frame."""
    return from_angles(*np.radians(ANGLES).T)


def picture(material: Material, *, size: int = 160, shape: str = "sphere") -> bytes:
    """PNG bytes of a small square picture of a material on a shape.

    Of a sample that does not tile one copy, whose border lies where the front ends.
    """
    repeat = _TILES if material.header.wrap == "wrap" else 1
    form = shape_of(shape, repeat=repeat, aspect=material.header.aspect, picture=1.0)
    scene = Scene(material, form, lights(), irradiance=IRRADIANCE)
    seen = render(scene, size=(size, size), samples=4)
    behind = (1 - seen.cover[..., None]) * np.asarray(GREY, np.float32)
    return images.encode_png(seen.radiance @ visible(material.header.channels) + behind)


def sheet(btf: BTF) -> bytes:
    """PNG bytes of four textures of a BTF, two by two, shrunk.

    Above: light and view from above as far as there are such; light aslant. Below: view aslant;
    both. Values that are not finite are black.
    """
    import cv2

    light, view = btf.light[:, 2], btf.view[:, 2]
    pairs = [int(np.argmax(score)) for score in
             (view + light, view - light, light - view, -view - light)]  # fmt: skip
    h, w = btf.shape[1:3]
    shrink = max(max(h, w) / _MOST_SIDE, 1)
    size = max(round(w / shrink), 1), max(round(h / shrink), 1)
    shown = []
    for pair in pairs:
        linear = np.nan_to_num(btf.texture(pair), posinf=0, neginf=0) @ visible(btf.channels)
        shown.append(cv2.resize(linear, size, interpolation=cv2.INTER_AREA))
    return images.encode_png(np.vstack([np.hstack(shown[:2]), np.hstack(shown[2:])]))


def visible(channels: tuple[str, ...]) -> NDArray[np.float32]:
    """(c, 3) from channels to linear RGB; of channels without colour their mean."""
    try:
        return to_rgb(channels)
    except ValueError:
        return np.full((len(channels), 3), 1 / len(channels), np.float32)
