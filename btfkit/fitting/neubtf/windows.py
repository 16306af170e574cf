"""Windows of a tile: which texels they are, and what of a material lies in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, final

import numpy as np
import torch
from torch import Tensor

from btfkit.materials.neumip.material import NeuMIPMaterial


@final
class Window(NamedTuple):
    """A part of the tile, texels; it may reach around the border."""

    top: int
    left: int
    height: int
    width: int

    def slices(self) -> tuple[slice, slice]:
        """Rows and columns of a window that does not reach around the border."""
        rows = slice(self.top, self.top + self.height)
        return rows, slice(self.left, self.left + self.width)


def inside(window: Window, size: Sequence[int]) -> Tensor:
    """(h, w) whether each texel lies in a window of a grid of that size."""
    found = torch.zeros(size[0], size[1], dtype=torch.bool)
    found[window.slices()] = True
    return found


def bounds(among: Tensor, reach: int) -> tuple[tuple[slice, slice], ...]:
    """The rows and columns of what is set in (h, w); with `reach` around; and those in these."""
    at, around, within = [], [], []
    for dim, side in ((1, among.shape[0]), (0, among.shape[1])):
        found = torch.nonzero(among.any(dim=dim))[:, 0]
        first, stop = int(found[0]), int(found[-1]) + 1
        begin = max(first - reach, 0)
        at.append(slice(first, stop))
        around.append(slice(begin, min(stop + reach, side)))
        within.append(slice(first - begin, stop - begin))
    return (at[0], at[1]), (around[0], around[1]), (within[0], within[1])


def part_of(material: NeuMIPMaterial, part: Window) -> NeuMIPMaterial:
    """A part of a material of one level, which ends at its borders if it is not the whole."""
    h, w = material.spec.size
    if part == Window(0, 0, h, w):
        return material
    weights = {
        name: array[part.slices()] if name.startswith("texture.") else array
        for name, array in material.weights.items()
    }
    # Heights count in tile widths, and the tile is narrower.
    heights = weights["texture.heights"].astype(np.float32) * (w / part.width)
    weights["texture.heights"] = heights.astype(weights["texture.heights"].dtype)
    size = (part.height, part.width)
    header = replace(material.header, grid=size, wrap="clamp")
    return type(material)(replace(material.spec, size=size), weights, header)
