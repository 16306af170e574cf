"""Each source of heights by itself, for comparison: light, parallax, and shadows."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from btfkit.fitting.heightfield.bounds import shadow_bounds
from btfkit.fitting.heightfield.fusion import fuse
from btfkit.fitting.heightfield.parallax import sweep
from btfkit.relief.integration import Integrated, integrate
from btfkit.relief.photometric import Normals, photometric_stereo, slope_weights
from btfkit.relief.stack import Array, Stack, visibility

# Rounds of normals with own visibility; steps of a sweep, texels: each round looks closer.
_NORMAL_ROUNDS = 1
SWEEPS = (1.0, 0.5, 0.25, 0.12)
# Rounds in which shadows carve a plane: each moves a texel as far as its neighbours allow.
_CARVINGS = 12
# Deviation of the Gaussian over which heights of parallax alone are averaged, texels.
_SOFT = 0.5


def surface(normals: Normals, *, wrap: bool) -> Integrated:
    """The surface of normals by their slopes and how sure these are."""
    return integrate(normals.slope, slope_weights(normals), wrap=wrap)


def by_light(
    stack: Stack, first: tuple[Normals, Integrated] | None = None
) -> tuple[Normals, Integrated]:
    """Normals, and the surface of their slopes alone, with the relief's own shadows.

    Args:
        stack: many lights of a few views, each taken to see the plane.
        first: normals found before, without shadows known, and their surface; None finds them.
    """
    if first is None:
        found = photometric_stereo(stack)
        first = found, surface(found, wrap=stack.wrap)
    normals, whole = first
    for _ in range(_NORMAL_ROUNDS):
        visible = visibility(whole.height, stack.lights, wrap=stack.wrap)[stack.light_of]
        normals = photometric_stereo(stack, visible=visible, start=normals)
        whole = surface(normals, wrap=stack.wrap)
    return normals, whole


def by_parallax(stack: Stack, height: Array) -> Array:
    """(h, w) heights, texels: where views agree, whatever the surface faces.

    Args:
        stack: all views of a few lights. height: (h, w) to begin with, as a model finds them.
    """
    mode = "wrap" if stack.wrap else "nearest"
    for step in SWEEPS:
        swept = sweep(stack, height, None, step=step)
        # What no views see keeps the height of what they do see beside it.
        by = 1 / np.maximum(swept.variance, 1e-6) + 1e-6
        shares = (gaussian_filter(part, _SOFT, mode=mode) for part in (by * swept.height, by))
        height = np.divide(*shares).astype(np.float32)
    return height


def by_shadows(stack: Stack) -> Array:
    """(h, w) heights of mean 0, texels: a plane that shadows carve; they know no slopes.

    Args:
        stack: many lights of a few views, each taken to see the plane.
    """
    normals = photometric_stereo(stack)
    height = np.zeros(stack.size, np.float32)
    slope = np.zeros((*stack.size, 2), np.float32)
    for _ in range(_CARVINGS):
        bounds = shadow_bounds(stack, height, normals)
        height = fuse(
            slope, np.ones_like(slope), height, np.ones_like(height), wrap=stack.wrap, bounds=bounds
        ).height
    return height - height.mean()
