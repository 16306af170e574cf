"""A near rig: from positions in millimetres to directions and falloff, texel by texel.

Positions are from the centre of the sample, in the surface frame; the sample is the plane z = 0.
The native kernels hold the same few lines, and so does their plain twin in `native.draw`, which
lies below this module.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit import directions
from btfkit.directions import Floats
from btfkit.textures import Array


def texel_places(rows: Any, cols: Any, grid: tuple[int, int], texel_mm: float) -> tuple[Any, Any]:
    """x and y in mm from the centre of the sample, of the centres of texels.

    Args:
        rows, cols: any shapes, numpy, torch or plain numbers; fractions lie between centres.
        grid: (h, w). texel_mm: edge of a texel; 1 gives texels.
    """
    h, w = grid
    return (cols + 0.5 - w / 2) * texel_mm, -(rows + 0.5 - h / 2) * texel_mm


def uv_places(
    uv: NDArray[np.floating], grid: tuple[int, int], texel_mm: float
) -> NDArray[np.floating]:
    """(b, 2) x and y in mm from the centre of the sample, of uv (b, 2)."""
    h, w = grid
    return (uv - 0.5) * np.array([w, -h]) * texel_mm


def directions_at(position: NDArray[np.floating], x: Any, y: Any) -> Floats:
    """(..., 3) unit vectors from places on the sample towards positions (..., 3).

    Args:
        position: mm. x, y: mm, of shapes that broadcast with (...).
    """
    place = np.stack(np.broadcast_arrays(x, y, 0.0), axis=-1)
    return directions.normalize(position - place)


def squared_distances(position: NDArray[np.floating], x: Any, y: Any) -> NDArray[np.floating]:
    """(...) mm^2 from places on the sample to positions (..., 3)."""
    return (position[..., 0] - x) ** 2 + (position[..., 1] - y) ** 2 + position[..., 2] ** 2


def cosines(position: NDArray[np.floating], square: NDArray[np.floating]) -> NDArray[np.floating]:
    """(...) cosines of incidence from positions (..., 3) at squared distances (...)."""
    return position[..., 2] / np.sqrt(square)


@final
@dataclass(frozen=True, eq=False)
class PointLight:
    """Factors that turn radiance under point lights into the quantity of a BTF.

    The irradiance on a surface that faces a light of power p at distance d is p / d^2, texel by
    texel; the quantity is pi x radiance / irradiance.

    Attributes:
        position_mm: (n, 3) of the lights, from the centre of the sample.
        texel_mm: edge of a texel.
        power: (n, c) in units of radiance x mm^2, or None to leave the distance alone.
        cosine: whether the cosine of the light has to be multiplied in.
    """

    position_mm: Array
    texel_mm: float
    power: Array | None
    cosine: bool = False

    def __call__(self, index: int, h: int, w: int) -> Array:
        """(h, w, c or 1) factors of pair `index`."""
        x, y = texel_places(np.arange(h)[:, None], np.arange(w), (h, w), self.texel_mm)
        position = self.position_mm[index].astype(float)
        square = squared_distances(position, x, y)
        factor = np.ones((1, 1, 1))
        if self.power is not None:
            factor = np.pi * square[..., None] / self.power[index].astype(float)
        if self.cosine:
            factor = factor * np.maximum(cosines(position, square), 0)[..., None]
        return factor.astype(np.float32)
