"""A look into a texture: the twin of lookup.hpp."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def bilinear(texture: Array, uv: Array, *, wrap: bool) -> Array:
    """(b, k) of a texture (h, w, k) at uv (b, 2), tiling or clamped at its borders."""
    h, w, _ = texture.shape
    size = np.asarray([w, h], uv.dtype)
    if wrap:
        uv = uv - np.floor(uv)
    at = uv * size - np.asarray(0.5, uv.dtype)
    at = np.clip(at, -1, size)
    low = np.floor(at)
    fx, fy = (at - low).T[..., None]
    x0, y0 = low.astype(np.int64).T
    if wrap:
        x0, x1, y0, y1 = x0 % w, (x0 + 1) % w, y0 % h, (y0 + 1) % h
    else:
        x1, y1 = np.clip(x0 + 1, 0, w - 1), np.clip(y0 + 1, 0, h - 1)
        x0, y0 = np.clip(x0, 0, w - 1), np.clip(y0, 0, h - 1)
    upper = texture[y0, x0] * (1 - fx) + texture[y0, x1] * fx
    lower = texture[y1, x0] * (1 - fx) + texture[y1, x1] * fx
    return upper * (1 - fy) + lower * fy


def resized(plane: Array, size: tuple[int, ...], *, wrap: bool) -> Array:
    """(h, w) of another plane, read at the centres of the texels of `size`."""
    h, w = size
    u, v = np.meshgrid((np.arange(w) + 0.5) / w, (np.arange(h) + 0.5) / h)
    at = np.stack([u, v], axis=-1).reshape(-1, 2)
    return bilinear(plane[..., None], at, wrap=wrap).reshape(h, w)
