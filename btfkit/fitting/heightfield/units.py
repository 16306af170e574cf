"""BTFs in other units than reflectance: counts a second, or what a scan gave."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import final

import numpy as np

from btfkit.btf import BTF
from btfkit.native.lobe import MOST_ALBEDO
from btfkit.textures import Array, Textures

# Textures that are looked at, and the percentile of their values that is no highlight.
_LOOKED_AT, _NO_HIGHLIGHT = 8, 90


def as_reflectance(btf: BTF) -> tuple[BTF, float]:
    """The same in a unit in which it could be reflectance, and that unit: 1 where it could be.

    Heights do not depend on it, but reflectance is fitted within the bounds that surfaces have.
    """
    looked_at = np.unique(np.linspace(0, len(btf) - 1, _LOOKED_AT).astype(int))
    found = [values[np.isfinite(values)] for values in (btf.texture(int(i)) for i in looked_at)]
    bright = max((float(np.percentile(v, _NO_HIGHLIGHT)) for v in found if v.size), default=0.0)
    if bright <= MOST_ALBEDO:
        return btf, 1.0
    unit = 2.0 ** math.ceil(math.log2(bright))
    return replace(btf, textures=_Scaled(btf.textures, 1 / unit), variance=None), unit


@final
class _Scaled(Textures):
    """Textures of another unit."""

    def __init__(self, of: Textures, factor: float) -> None:
        self._of, self._factor = of, np.float32(factor)
        self.shape = of.shape

    def _read(self, index: int) -> Array:
        return self._of[index] * self._factor
