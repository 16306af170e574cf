"""Pictures as guidance: read from files, without alpha, encoded, resized."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from btfkit.fitting.neubtf import augment
from btfkit.io import images

Array = NDArray[np.float32]
# A guidance of more texels needs more memory for its encoder than most machines have.
_MOST_TEXELS = 1 << 25


def prepare(image: Array, *, scale: float = 1.0, wrap: bool = False) -> torch.Tensor:
    """(1, 3, h, w) sRGB encoded guidance of a linear (h, w, c) image, resized by `scale`.

    Raises:
        ValueError: no size, too large, or channels that no image has.
    """
    if image.ndim != 3 or min(image.shape[:2]) < 1:
        raise ValueError(f"guidance has shape {image.shape}; expected (h, w, c)")
    h, w, c = image.shape
    if c in (2, 4):
        image = opaque(image)
    elif c not in (1, 3):
        raise ValueError(f"guidance has {c} channels; expected 1 (grey) or 3 (RGB)")
    if not 0 < scale < 1e3:
        raise ValueError(f"scale = {scale}; expected a positive factor")
    size = (max(1, round(h * scale)), max(1, round(w * scale)))
    if size[0] * size[1] > _MOST_TEXELS:
        raise ValueError(f"guidance of {size[0]} x {size[1]}; at most {_MOST_TEXELS} texels")
    bad = ~np.isfinite(image)
    if bad.any():
        warnings.warn(
            f"{bad.any(axis=-1).sum()} guidance texels are not finite: taken as mean", stacklevel=3
        )
        image = np.where(
            bad, np.nanmean(np.where(bad, np.nan, image)) if not bad.all() else 0, image
        )
    tensor = torch.from_numpy(np.ascontiguousarray(image, np.float32)).permute(2, 0, 1)[None]
    return augment.resized(augment.encoded(augment.three_channels(tensor)), size, wrap=wrap)


def read_guidance(guidance: str | os.PathLike[str] | Array) -> tuple[Array, Any]:
    """(h, w, c) linear values of a guidance, alpha the last of 2 or 4, and what it is called.

    Raises:
        FileNotFoundError: no such file. FormatError: not an image.
    """
    if isinstance(guidance, np.ndarray):
        return guidance.astype(np.float32), "an array"
    path = Path(guidance)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such image")
    image = images.decode(path.name, path.read_bytes(), transfer="srgb", assumed=True)
    alpha = image.coverage
    if alpha is None:
        return image.linear, str(path)
    return np.concatenate([image.linear, alpha[..., None]], axis=2), str(path)


def opaque(image: Array) -> Array:
    """(h, w, 1 or 3) colours of an image whose last channel is alpha."""
    colours, clear = image[..., :-1], ~(image[..., -1] > 0)
    warnings.warn(
        f"the guidance has alpha, and a NeuBTF no opacity: {int(clear.sum())} texels that are "
        f"clear throughout take the mean colour, the others are taken for opaque",
        stacklevel=3,
    )
    if clear.all():
        return colours
    mean = colours[~clear].mean(axis=0)
    return np.where(clear[..., None], mean, colours).astype(np.float32)
