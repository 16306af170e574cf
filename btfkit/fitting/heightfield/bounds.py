"""Shadows as bounds of heights: what the light reaches lies above its neighbours' shadow lines.

The shadow line of a light over a texel is how high its neighbours' shadow stands there. A texel
seen in the light lies above the line, one seen in shadow below it: one-sided, but from the side
where parallax sees least, in seams.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from btfkit.native.lobe import shaded
from btfkit.relief.photometric import Normals
from btfkit.relief.stack import Array, Stack, sampled, visibility

Floats = NDArray[Any]

# Shares of the fitted reflectance at which a texel is in shadow, and in the light.
_DARK, _LIT = 0.2, 0.7
# A light this close to the surface, by cosine of incidence, says nothing: it may graze.
_GRAZING = 0.2
# Of several lights that bound a texel the most extreme one may be an error.
_RANK = 2
# Share of the views that has to see a texel before its light bounds it from below.
_OPEN = 0.6
# Shadows' edges are as soft as a footprint, texels.
SOFT_EDGE = 0.3
# Steps along a shadow line, texels, and at most.
_STEP, _MOST_STEPS = 0.75, 64


class Bounds(NamedTuple):
    """(h, w) heights in texels that a texel lies above and below; -inf and inf where unknown."""

    lower: Array
    upper: Array

    def kept_by(self, height: Array) -> dict[str, float]:
        """Shares of texels that are bounded, and of those that lie beyond, by more than a shadow's
        edge is wide, and how far these do in the mean, texels.
        """
        bounded = np.isfinite(self.lower) | np.isfinite(self.upper)
        beyond = np.maximum(np.maximum(self.lower - height, height - self.upper), 0)
        broken = beyond > SOFT_EDGE
        return {
            "bounded": float(bounded.mean()),
            "broken": float(broken.sum() / max(int(bounded.sum()), 1)),
            "broken_by_texels": float(beyond[broken].mean()) if broken.any() else 0.0,
        }


def shadow_bounds(stack: Stack, height: Array, normals: Normals) -> Bounds:
    """Bounds by what a stack shows in light and in shadow.

    Args:
        stack: many lights of a few views. height: (h, w) texels, of the neighbours.
        normals: fitted there.
    """
    h, w = stack.size
    share, facing = lit_share(stack, height, normals)
    lines = np.stack([_shadow_line(height, light, wrap=stack.wrap) for light in stack.lights])
    lit = (share > _LIT) & facing
    dark = (share < _DARK) & facing
    lower = np.sort(np.where(lit, lines, -np.inf), axis=0)[-1 - min(_RANK, len(lines) - 1)]
    upper = np.sort(np.where(dark, lines, np.inf), axis=0)[min(_RANK, len(lines) - 1)]
    # Contradictions say nothing; nor do texels that few views see, whose reflectance was fitted
    # to what lies before them: lit is what their neighbours are.
    open_ = visibility(height, stack.views, wrap=stack.wrap).mean(axis=0) >= _OPEN
    lower = np.where(open_, lower, -np.inf)
    clash = lower > upper
    return Bounds(
        np.where(clash, -np.inf, lower).reshape(h, w).astype(np.float32),
        np.where(clash, np.inf, upper).reshape(h, w).astype(np.float32),
    )


def lit_share(stack: Stack, height: Array, normals: Normals) -> tuple[Floats, NDArray[np.bool_]]:
    """(k, h, w) of each light: its values in parts of the model's; whether it faces the surface."""
    h, w = stack.size
    seen = visibility(height, stack.views, wrap=stack.wrap)
    lights = np.eye(len(stack.lights), dtype=np.float32)[stack.light_of]
    share = np.empty((h, w, len(stack.lights)), np.float32)
    for row in range(0, h, 16):
        rows = slice(row, min(row + 16, h))
        values = stack.seen(stack.grey, height, rows)[..., 0]
        model = shaded(normals.lobes(rows), stack.light, stack.view)[..., 0]
        use = seen[:, rows].reshape(len(seen), -1).T[:, stack.view_of] & np.isfinite(values)
        values, model = np.where(use, values, 0), np.where(use, model, 0)
        both, square = (values * model) @ lights, (model * model) @ lights
        ratio = np.where(square > 1e-9, both / np.maximum(square, 1e-9), np.nan)
        share[rows] = ratio.reshape(rows.stop - rows.start, w, -1)
    facing = np.einsum("hwk,lk->lhw", normals.normal(), stack.lights) > _GRAZING
    return share.transpose(2, 0, 1), facing


def _shadow_line(height: Array, light: Array, *, wrap: bool) -> Array:
    """(h, w) height up to which neighbours shade each texel under a light."""
    h, w = height.shape
    flat = float(np.hypot(light[0], light[1]))
    line = np.full((h, w), -np.inf, np.float32)
    if flat < 1e-3:
        return line
    x, y, rise = (float(part) / flat for part in light)
    row, col = np.mgrid[:h, :w].reshape(2, -1).astype(np.float32)
    steps = min(int(np.ptp(height) / max(rise, 1e-3) / _STEP) + 2, _MOST_STEPS)
    for step in range(1, steps + 1):
        s = (step + 0.5) * _STEP
        at = sampled(height, row - s * y, col + s * x, wrap=wrap).reshape(h, w)
        line = np.maximum(line, at - s * rise)
    return line
