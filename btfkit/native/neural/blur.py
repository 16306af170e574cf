"""Blurs of a texture in place: what NeuMIP's textures go through while training begins."""

from __future__ import annotations

import numpy as np

from btfkit import native
from btfkit.native.neural.layout import Array

# Texels squared; what is left of a blur below it changes nothing.
LEAST_BLUR = 2e-3
# Three taps spread by at most this much a pass without ringing.
_MOST_A_PASS = 0.5


def blur(texture: Array, variance: float, *, wrap: bool) -> None:
    """Blur a texture (h, w, k) in place by `variance` texels squared; borders wrap or clamp."""
    module = native.load("neural")
    for share in shares(variance):
        if module is None:
            blur_plain(texture, share, wrap=wrap)
        else:
            module.blur(texture, share, wrap)


def shares(variance: float) -> list[float]:
    """How far each of several passes draws a texel towards its neighbours along a side."""
    found = []
    while variance > LEAST_BLUR:
        found.append(min(variance, _MOST_A_PASS) / 2)
        variance -= _MOST_A_PASS
    return found


def blur_plain(texture: Array, share: float, *, wrap: bool) -> None:
    """One pass in numpy: the twin of the kernel."""
    for axis in (0, 1):
        if texture.shape[axis] > 1:
            texture += np.float32(share) * _laplacian(texture, axis, wrap=wrap)


def _laplacian(texture: Array, axis: int, *, wrap: bool) -> Array:
    if wrap:
        return np.roll(texture, 1, axis) + np.roll(texture, -1, axis) - 2 * texture
    step = np.diff(texture, axis=axis)
    still = np.zeros_like(texture.take([0], axis))
    return np.concatenate([step, still], axis) - np.concatenate([still, step], axis)
