"""Errors between what was measured and what a model answers. NaN is masked, never averaged in.

Definitions and sources: docs/metrics.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]


def to_srgb(linear: Array) -> Array:
    """sRGB encoding of linear values, clamped to 0..1 (IEC 61966-2-1)."""
    x = np.clip(linear, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-8) ** (1 / 2.4) - 0.055)


def psnr(mse: float) -> float:
    """Peak signal-to-noise ratio for a peak of 1, decibel; infinite for a perfect answer."""
    return math.inf if mse == 0 else -10 * math.log10(mse)


@final
@dataclass
class Pooled:
    """Sums of errors over any number of batches.

    Attributes:
        values: measured values counted. masked: values that were not measured.
    """

    values: int = 0
    masked: int = 0
    _squared: float = 0.0
    _squared_log: float = 0.0
    _absolute: float = 0.0
    _squared_srgb: float = 0.0

    def add(self, answer: Array, truth: Array) -> None:
        """Count `answer` against `truth`, both (...) linear; NaN in `truth` is not measured."""
        measured = np.isfinite(truth)
        self.masked += int(truth.size - measured.sum())
        if not measured.any():
            return
        a, t = answer[measured].astype(np.float64), truth[measured].astype(np.float64)
        self.values += len(t)
        self._squared += float(np.square(a - t).sum())
        self._absolute += float(np.abs(a - t).sum())
        # Dark-subtracted measurements go slightly negative: as in training, -0.1 is the floor.
        logs = np.log1p(np.maximum(a, -0.1)) - np.log1p(np.maximum(t, -0.1))
        self._squared_log += float(np.square(logs).sum())
        self._squared_srgb += float(np.square(to_srgb(a) - to_srgb(t)).sum())

    def errors(self) -> dict[str, float]:
        """mse, psnr, mse_log1p, psnr_log1p, mae, psnr_srgb; ValueError if nothing was counted."""
        if not self.values:
            raise ValueError(f"no measured value to compare with; {self.masked} are masked")
        mse, log, srgb = (
            total / self.values for total in (self._squared, self._squared_log, self._squared_srgb)
        )
        return {
            "mse": mse,
            "psnr": psnr(mse),
            "mse_log1p": log,
            "psnr_log1p": psnr(log),
            "mae": self._absolute / self.values,
            "psnr_srgb": psnr(srgb),
        }


@final
@dataclass
class Pictured:
    """Means of what is defined on whole pictures: structural similarity, FLIP and LPIPS.

    Attributes:
        lpips: a distance of pictures of three channels, sRGB encoded; None leaves it out.
    """

    lpips: Callable[[Array, Array], float] | None = None
    _ssim: list[float] = field(default_factory=list)
    _flip: list[float] = field(default_factory=list)
    _lpips: list[float] = field(default_factory=list)

    def add(self, answer: Array, truth: Array) -> None:
        """Count one picture (h, w, c) against another; texels not measured are made equal."""
        measured = np.isfinite(truth)
        truth = np.where(measured, truth, 0)
        answer = np.where(measured, answer, 0)
        self._ssim.append(ssim_srgb(answer, truth))
        if truth.shape[-1] == 3:
            self._flip.append(float(flip(answer, truth).mean()))
        if self.lpips is not None:
            self._lpips.append(self.lpips(to_srgb(answer), to_srgb(truth)))

    def errors(self) -> dict[str, float]:
        """ssim_srgb and, for pictures of three channels, flip; lpips where weights are named."""
        found = {"ssim_srgb": self._ssim, "flip": self._flip, "lpips": self._lpips}
        return {name: float(np.mean(values)) for name, values in found.items() if values}


def ssim_srgb(answer: Array, truth: Array) -> float:
    """Structural similarity of (h, w, c) linear pictures after clamping and sRGB encoding.

    Gaussian window of deviation 1.5 (11 texels), data range 1, as Wang et al. 2004; pictures
    smaller than the window take the largest odd window that fits.
    """
    from skimage.metrics import structural_similarity

    window = min(11, *(side - (side + 1) % 2 for side in truth.shape[:2]))
    if window < 3:
        # No window fits: one value for the whole picture, by the same formula.
        return _global_ssim(to_srgb(answer), to_srgb(truth))
    return float(
        structural_similarity(
            to_srgb(answer),
            to_srgb(truth),
            channel_axis=-1,
            data_range=1.0,
            gaussian_weights=window == 11,
            win_size=None if window == 11 else window,
            sigma=1.5,
            use_sample_covariance=False,
        )
    )


def _global_ssim(a: Array, t: Array) -> float:
    c1, c2 = 0.01**2, 0.03**2
    ma, mt = a.mean((0, 1)), t.mean((0, 1))
    covariance = ((a - ma) * (t - mt)).mean((0, 1))
    value = (2 * ma * mt + c1) * (2 * covariance + c2)
    value /= (ma**2 + mt**2 + c1) * (a.var((0, 1)) + t.var((0, 1)) + c2)
    return float(value.mean())


def flip(answer: Array, truth: Array) -> Array:
    """LDR FLIP, (h, w) in 0..1, of (h, w, 3) linear BT.709 pictures, at 67 pixels a degree.

    Source: Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", 2020.
    """
    from btfkit import perceptual

    return perceptual.flip(answer, truth)


def iou(answer: Array, truth: Array) -> float:
    """Intersection over union of opacities above a half; 1 where both are empty."""
    a, t = np.asarray(answer) > 0.5, np.asarray(truth) > 0.5
    union = np.logical_or(a, t).sum()
    return 1.0 if union == 0 else float(np.logical_and(a, t).sum() / union)


def seam_ratio(image: Array, *, period: tuple[int, int] = (0, 0)) -> float:
    """Mean |step| across the seams of a tiled picture over that inside; near 1 where it tiles.

    Args:
        image: (h, w, c) one tile; steps to NaN do not count.
        period: rows and columns after which it repeats; where it does so within itself, the seams
            are compared with the steps whole periods away. 0 where nothing repeats.
    """
    ratios = []
    for axis in (0, 1):
        x = np.moveaxis(np.asarray(image, np.float64), axis, 0)
        if len(x) < 2:
            continue
        steps = np.abs(np.diff(x, axis=0))
        repeats = round(len(x) / period[axis]) if period[axis] else 1
        if repeats > 1:
            steps = steps[np.rint(np.arange(1, repeats) * len(x) / repeats).astype(int) - 1]
        across, inside = (
            float(step[np.isfinite(step)].mean()) if np.isfinite(step).any() else 0.0
            for step in (np.abs(x[0] - x[-1]), steps)
        )
        ratios.append(1.0 if across == inside == 0 else across / max(inside, 1e-12))
    return float(np.mean(ratios)) if ratios else 1.0
