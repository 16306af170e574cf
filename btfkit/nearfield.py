"""Lights close to the sample: what their distance and slant do to the values of a texel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from btfkit.textures import Array


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
        x = (np.arange(w) + 0.5 - w / 2) * self.texel_mm
        y = -(np.arange(h) + 0.5 - h / 2) * self.texel_mm
        across = self.position_mm[index, 0] - x
        along = self.position_mm[index, 1] - y[:, None]
        height = float(self.position_mm[index, 2])
        square = (across**2 + along**2 + height**2)[..., None]
        factor = np.ones((1, 1, 1))
        if self.power is not None:
            factor = np.pi * square / self.power[index].astype(float)
        if self.cosine:
            factor = factor * (max(height, 0.0) / np.sqrt(square))
        return factor.astype(np.float32)
