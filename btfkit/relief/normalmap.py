"""Normal maps: pictures whose colours are unit normals, as slopes."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from btfkit.errors import FormatError
from btfkit.io import images

Array = NDArray[np.float32]
# The y axis of a map: up as in OpenGL and in our surface frame, or down as in DirectX.
Green = Literal["up", "down"]
# Mean length of the vectors of a normal map, within which rounding and filters leave it.
_LENGTHS = (0.8, 1.2)
# Steeper normals are taken for this steep: beyond, 8 bits say nothing of a slope.
_STEEPEST = 0.05


def read_slopes(path: str | os.PathLike[str], *, y: Green = "up") -> Array:
    """(h, w, 2) slopes of the normal map in a file, as `slopes_of`.

    Codes are (n + 1) / 2, whatever curve the file declares; EXR and floats may hold n itself.

    Raises:
        FormatError: not an image, or no normal map.
    """
    file = Path(path)
    if not file.is_file():
        raise FileNotFoundError(f"{file}: no such normal map")
    image = images.decode(file.name, file.read_bytes(), transfer="linear")
    try:
        return slopes_of(image.linear, y=y)
    except ValueError as error:
        raise FormatError(file, f"no normal map: {error}") from error


def slopes_of(image: Array, *, y: Green = "up") -> Array:
    """(h, w, 2) dz/dx, dz/dy of a normal map, NaN where it has no normal; y runs up.

    Args:
        image: (h, w, 3) codes (n + 1) / 2 in 0..1, or n itself where values are below 0.
        y: which way the map's green axis runs.

    Raises:
        ValueError: no three channels, or vectors that are not of length 1 or point downwards.
    """
    if image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"shape {image.shape}; expected (h, w, 3)")
    values = image.astype(np.float64)
    with np.errstate(invalid="ignore"):
        # Rounding of codes leaves no value below 0.
        n = values if np.nanmin(values, initial=0) < -0.01 else 2 * values - 1
        length = np.linalg.norm(n, axis=-1)
        known = np.isfinite(length) & (length > 0.5)
    if not known.any():
        raise ValueError("no texel has a vector")
    mean = float(length[known].mean())
    if not _LENGTHS[0] <= mean <= _LENGTHS[1]:
        raise ValueError(f"vectors of mean length {mean:.2f}; expected 1")
    below = float((n[known][:, 2] < 0).mean())
    if below > 0.01:
        raise ValueError(f"{100 * below:.0f} % of the vectors point downwards; expected none")
    steep = np.maximum(n[..., 2] / np.maximum(length, 1e-6), _STEEPEST) * length
    slope = -n[..., :2] / np.maximum(steep, 1e-6)[..., None]
    if y == "down":
        slope = slope * [1, -1]
    return np.where(known[..., None], slope, np.nan).astype(np.float32)
