"""Guidance images as the encoder sees them: encoded, standardised, and varied in training."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final

import kornia
import torch
import torch.nn.functional as F
from torch import Tensor


def encoded(image: Tensor) -> Tensor:
    """sRGB encoding of linear values, clamped to 0..1: what a photograph would hold."""
    x = image.clamp(0, 1)
    return torch.where(x <= 0.0031308, 12.92 * x, 1.055 * x.clamp_min(1e-8) ** (1 / 2.4) - 0.055)


def three_channels(image: Tensor) -> Tensor:
    """(..., c, h, w) as three channels: RGB as it is, one repeated, many averaged in thirds."""
    c = image.shape[-3]
    if c == 3:
        return image
    if c == 1:
        return image.expand(*image.shape[:-3], 3, *image.shape[-2:])
    thirds = torch.tensor_split(image, 3, dim=-3) if c > 3 else (image[..., :1, :, :],) * 3
    # Wavelengths ascend: the longest third is the red.
    return torch.cat([part.mean(dim=-3, keepdim=True) for part in reversed(thirds)], dim=-3)


def standardised(guidance: Tensor) -> Tensor:
    """Every channel of (b, 3, h, w) with mean 0 and deviation 1; a constant channel becomes 0."""
    mean = guidance.mean(dim=(2, 3), keepdim=True)
    deviation = (guidance - mean).square().mean(dim=(2, 3), keepdim=True).sqrt()
    # One 8-bit step: below it a channel holds nothing but rounding.
    return (guidance - mean) / deviation.clamp_min(1 / 255)


@final
@dataclass(frozen=True)
class Variation:
    """How strongly a guidance is varied in training; only the input, never the target.

    Attributes:
        hue: chance of a hue turned anywhere on the wheel.
        blur: largest Gaussian blur, texels. noise: largest deviation, of 0..1.
        gain: largest factor up or down on brightness.
    """

    hue: float = 0.3
    blur: float = 1.0
    noise: float = 0.03
    gain: float = 1.3

    def __call__(self, guidance: Tensor, generator: torch.Generator) -> Tensor:
        """A varied copy of (b, 3, h, w) encoded values in 0..1."""

        def uniform(low: float, high: float) -> float:
            return low + (high - low) * float(torch.rand((), generator=generator))

        image = guidance * self.gain ** uniform(-1, 1)
        if uniform(0, 1) < self.hue:
            turn = torch.full((len(image),), uniform(-math.pi, math.pi))
            image = kornia.enhance.adjust_hue(image.clamp(0, 1), turn)
        if uniform(0, 1) < 0.3 and min(image.shape[-2:]) > 4:
            sigma = uniform(0.2, max(self.blur, 0.21))
            image = kornia.filters.gaussian_blur2d(image, (5, 5), (sigma, sigma), "circular")
        if uniform(0, 1) < 0.5:
            noise = torch.randn(image.shape, generator=generator)
            image = image + uniform(0, self.noise) * noise
        return image


def resized(image: Tensor, size: tuple[int, int], *, wrap: bool) -> Tensor:
    """(b, c, h, w) resampled to `size`; a periodic image stays periodic.

    Shrinking averages areas; growing interpolates, around the border where `wrap` is set.
    """
    h, w = image.shape[-2:]
    if (h, w) == size:
        return image
    if size[0] <= h and size[1] <= w:
        return F.interpolate(image, size, mode="area")
    if not wrap:
        return F.interpolate(image, size, mode="bilinear", align_corners=False)
    rows, cols = (
        ((torch.arange(new, dtype=torch.float64) + 0.5) * old / new - 0.5)
        for new, old in zip(size, (h, w), strict=True)
    )
    return _periodic(_periodic(image, rows, dim=2), cols, dim=3)


def _periodic(image: Tensor, at: Tensor, *, dim: int) -> Tensor:
    """Linear interpolation of `image` at positions `at` along `dim`, around the border."""
    size = image.shape[dim]
    first = torch.floor(at)
    share = (at - first).to(image.dtype).reshape([-1 if d == dim else 1 for d in range(4)])
    low = image.index_select(dim, first.long() % size)
    high = image.index_select(dim, (first.long() + 1) % size)
    return low + (high - low) * share
