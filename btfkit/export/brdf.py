"""One texel's reflectance as a function of two directions: what BRDF files are written from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import BTF
from btfkit.materials.measured.interpolation import Interpolation
from btfkit.textures import as_textures

Progress = Callable[[int, int], None]
Floats = NDArray[np.float64]
# Directions closer to the horizon than that are answered as if they were there.
_LOWEST = 0.02


@final
class TexelBRDF:
    """f_r of one texel of a BTF, or of all of them on average, between its pairs.

    Args:
        btf: three channels. texel: "row,col", or "mean" for the average of all texels.
        turns: azimuths over which light and view are turned together and averaged; 1 keeps what
            is anisotropic.

    Raises:
        ValueError: other channels, or a texel that there is not.
    """

    def __init__(self, btf: BTF, texel: str, turns: int = 1) -> None:
        if btf.channels != ("R", "G", "B"):
            raise ValueError(f"channels {', '.join(btf.channels)}; a BRDF file holds R, G and B")
        self._material = Interpolation.of(_one_texel(btf, texel))
        self._turns = turns

    def __call__(self, light: Floats, view: Floats) -> Floats:
        """(n, 3) f_r under lights and views (n, 3), each above the horizon."""
        total = np.zeros((len(light), 3))
        for turn in range(self._turns):
            c, s = np.cos(2 * np.pi * turn / self._turns), np.sin(2 * np.pi * turn / self._turns)
            about = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
            at, seen = (_lifted(d @ about.T) for d in (light, view))
            uv = np.full((len(at), 2), 0.5)
            answer = self._material.evaluate(uv, at, seen).reflectance
            total += answer / (np.pi * at[:, 2:])
        return np.maximum(total / self._turns, 0)


def _lifted(direction: Floats) -> Floats:
    """Directions at least `_LOWEST` above the horizon."""
    flat = direction[:, :2]
    z = np.maximum(direction[:, 2], _LOWEST)
    length = np.maximum(np.linalg.norm(flat, axis=1), 1e-12)
    scale = np.sqrt(1 - np.square(np.minimum(z, 1))) / length
    return np.column_stack([flat * np.minimum(scale, 1)[:, None], z])


def _one_texel(btf: BTF, texel: str) -> BTF:
    """The BTF of one texel; near positions become the directions at its centre."""
    n, h, w, c = btf.shape
    values = np.full((n, 1, 1, c), np.nan, np.float32)
    if texel == "mean":
        light, view = btf.light, btf.view
        for pair in range(n):
            image = btf.texture(pair).reshape(-1, c)
            known = np.isfinite(image).all(axis=1)
            if known.any():
                values[pair, 0, 0] = image[known].mean(axis=0)
    else:
        try:
            row, col = (int(part) for part in texel.split(","))
        except ValueError:
            raise ValueError(f"texel {texel!r}; expected row,col or mean") from None
        if not (0 <= row < h and 0 <= col < w):
            raise ValueError(f"texel {texel} of {h} rows and {w} columns")
        values[:, 0, 0] = btf.abrdf(row, col)
        light, view = (
            np.stack([at(pair)[row, col] for pair in range(n)])
            for at in (btf.light_at, btf.view_at)
        )
    known = np.isfinite(values).all(axis=(1, 2, 3))
    if not known.any():
        raise ValueError(f"texel {texel} is measured under no pair")
    one = replace(
        btf, textures=as_textures(values), light=light, view=view, light_position=None,
        view_position=None, validity=None, variance=None, footprint=None,
        coverage=None, blurs=None, wrap="wrap",
    )  # fmt: skip
    return one.subset(known)
