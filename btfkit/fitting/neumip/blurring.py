"""Textures that are blurred while training begins, as the published recipes have it."""

from __future__ import annotations

import torch
from torch import Tensor

from btfkit.footprint import gaussian

# Texels by which textures are blurred at first, how often that halves in a run, and below which
# nothing is blurred.
_TEXELS, _HALVES, _LEAST = 8.0, 9, 0.1


def blur_at(progress: float) -> float:
    """Standard deviation of the blur, texels of the finest level; 0 where there is none.

    Args:
        progress: share of the run that is done, 0..1.
    """
    sigma = _TEXELS * 2 ** (-_HALVES * progress)
    return 0.0 if sigma < _LEAST else float(sigma)


def blurred(texture: Tensor, sigma: float, *, wrap: bool) -> Tensor:
    """A texture (h, w, c) under a Gaussian of `sigma` texels."""
    h, w, _ = texture.shape
    down, across = (torch.from_numpy(gaussian(side, sigma**2, wrap=wrap)) for side in (h, w))
    part = (down @ texture.reshape(h, -1)).reshape(h, w, -1)
    return across @ part
