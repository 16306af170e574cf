"""Losses on images: style by fixed filters, focal frequency, L1 in the log domain."""

from __future__ import annotations

from typing import final

import torch
import torch.nn.functional as F
from torch import Tensor, nn


def log_l1(predicted: Tensor, target: Tensor) -> Tensor:
    """Mean |predicted - log(1 + target)| over measured values; 0 where none is.

    Args:
        predicted: (...) log(1 + rgb) as the renderer gives it.
        target: (...) rgb, NaN where not measured; below -0.1, the darkest noise of
            a dark-subtracted measurement, counts as -0.1.
    """
    measured = torch.isfinite(target)
    wanted = torch.log1p(torch.where(measured, target, 0.0).clamp_min(-0.1))
    error = torch.where(measured, predicted - wanted, 0.0).abs()
    return error.sum() / measured.sum().clamp_min(1)


@final
class Style(nn.Module):
    """Distance of filter statistics: Gram matrices of two layers of fixed random filters.

    Random convolutions carry texture statistics nearly as well as trained ones (Ustyuzhaninov
    et al. 2016) and need no download.
    """

    def __init__(self, channels: int, *, seed: int = 7, width: int = 24) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        for name, (a, b) in {"first": (channels, width), "second": (width, width)}.items():
            filters = torch.empty(b, a, 5, 5).normal_(generator=generator)
            filters -= filters.mean(dim=(2, 3), keepdim=True)
            filters /= filters.flatten(1).norm(dim=1)[:, None, None, None]
            self.register_buffer(name, filters)

    def forward(self, predicted: Tensor, target: Tensor) -> Tensor:
        """Mean absolute difference of Gram matrices of (b, c, h, w) images, 0 for equal ones."""
        pairs = zip(self._grams(predicted), self._grams(target), strict=True)
        return torch.stack([(ours - theirs).abs().mean() for ours, theirs in pairs]).mean()

    def _grams(self, image: Tensor) -> list[Tensor]:
        grams = []
        x = image.float()
        for name in ("first", "second"):
            filters = self.get_buffer(name)
            x = F.relu(F.conv2d(x, filters, padding=2))
            flat = x.flatten(2)
            # Divide before the product: sums over 2000 x 2000 texels stay in range.
            flat = flat / flat.shape[-1] ** 0.5
            grams.append(flat @ flat.transpose(1, 2) / flat.shape[1])
            x = F.avg_pool2d(x, 2) if min(x.shape[-2:]) >= 2 else x
        return grams


def focal_frequency(predicted: Tensor, target: Tensor) -> Tensor:
    """Spectral distance in which frequencies count by how wrong they are.

    Args:
        predicted, target: (b, c, h, w), finite.

    Returns:
        The mean over frequencies of w |F(predicted) - F(target)|^2, with w the amplitude of
        the difference over its largest; 0 with zero gradient for equal images.

    Source: Jiang et al., "Focal Frequency Loss for Image Reconstruction and Synthesis", 2021.
    """
    difference = torch.fft.rfft2(predicted.float() - target.float(), norm="ortho")
    power = difference.real.square() + difference.imag.square()
    with torch.no_grad():
        amplitude = power.sqrt()
        # An all-equal pair has no largest difference: its weights are 0, not 0/0.
        weight = amplitude / amplitude.amax(dim=(-2, -1), keepdim=True).clamp_min(1e-12)
    return (weight * power).mean()
