"""How counts follow light: linearity from an exposure ramp, sensitivity of pixels from flats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from btfkit.calibration.noise import Fitted, NoiseModel, solved
from btfkit.errors import CalibrationError

Floats = NDArray[np.floating]
_REGIONS = 8
# A sensor that is this linear is left as it is: a correction would bring its own noise.
LINEAR_ENOUGH = 1e-3
# What is further off the fitted curve is no response: a wrong time would be taken for one.
SMOOTH_ENOUGH = 3e-3


@final
@dataclass(frozen=True, eq=False)
class Linearity:
    """The response over an exposure ramp.

    Attributes:
        curve: (c1, c2) of linear = y (1 + c1 y + c2 y^2); (0, 0) where it is left as it is.
        before, after: largest deviation from proportion to exposure, relative, without and with
            the curve.
        level, deviation: (b,) share of the full range, and relative deviation without the curve.
        fitted: errors, condition, and what could not be told.
    """

    curve: tuple[float, float]
    before: float
    after: float
    level: Floats
    deviation: Floats
    fitted: Fitted

    def record(self) -> dict[str, Any]:
        """The numbers and the points of the ramp."""
        return {
            "curve": list(self.curve), "residual_before": self.before,
            "residual_after": self.after, "level": self.level.tolist(),
            "deviation": self.deviation.tolist(), **self.fitted.record(),
        }  # fmt: skip


def fit_linearity(
    frames: Sequence[Any], exposure_s: ArrayLike, noise: NoiseModel, *, lamp: ArrayLike = 1.0
) -> Linearity:
    """The response curve from flat frames of one scene at several exposures.

    Args:
        frames: k frames (h, w), counts.
        exposure_s: (k,) seconds, trusted.
        noise: of the sensor; its curve is not looked at.
        lamp: (k,) brightness of the lamp, relative.

    Raises:
        CalibrationError: fewer than three exposures that span a factor of four, unsaturated.
    """
    exposure = np.asarray(exposure_s, float)
    time: Floats = exposure * np.broadcast_to(np.asarray(lamp, float), exposure.shape)
    signal, count = _regions(frames, exposure, noise)
    usable = np.isfinite(signal) & (signal > 10 * np.sqrt(noise.variance(signal) / count))
    seen = exposure[usable.any(axis=1)]
    if len(np.unique(seen)) < 3 or seen.max() < 4 * seen.min():
        raise CalibrationError(
            f"flat frames at {len(np.unique(seen))} usable exposures"
            + (f" from {seen.min():g} to {seen.max():g} s" if seen.size else "")
            + "; linearity needs three that span a factor of four",
            remedy="capture the flat at exposures between the noise and saturation",
        )
    k, r = np.nonzero(usable)
    y = signal[k, r] / noise.full
    # A region's own brightness is unknown: one column each.
    columns = np.unique(r)
    ratio = np.where(r[:, None] == columns, (time[k] / signal[k, r])[:, None], 0)
    relative = noise.variance(signal[k, r]) / count[k, r] / signal[k, r] ** 2
    # Exposure times are given to four digits at best.
    weight = 1 / (relative + 1e-8)
    ones = np.ones(len(y))
    plain, *_ = solved(ratio, ones, weight)
    off = 1 / np.maximum(ratio @ plain, 1e-300) - 1
    before, level, deviation = _binned(y, off, weight)
    full = np.concatenate([ratio, -y[:, None], -(y**2)[:, None]], axis=1)
    answer, covariance, condition, kept = solved(full, ones, weight)
    after, *_ = _binned(y[kept], (full @ answer - ones)[kept], weight[kept])
    sd = np.sqrt(np.diag(covariance))
    held, curve = {}, (float(answer[-2]), float(answer[-1]))
    if before < LINEAR_ENOUGH:
        held["curve"] = f"0: linear within {100 * before:.3f} %"
        curve, after = (0.0, 0.0), before
    elif after > SMOOTH_ENOUGH:
        held["curve"] = (
            f"0: the ramp is {100 * after:.2f} % off any smooth curve; its exposure times, or the "
            "lamp, are not what they are said to be"
        )
        curve, after = (0.0, 0.0), before
    values = {"c1": curve[0], "c2": curve[1]}
    errors = {"c1": float(sd[-2]), "c2": float(sd[-1])}
    fitted = Fitted(values, errors, condition, after, held)
    return Linearity(curve, before, after, level, deviation, fitted)


def _binned(level: Floats, deviation: Floats, weight: Floats) -> tuple[float, Floats, Floats]:
    """Largest mean deviation of up to 16 ranges of level, and the ranges' means."""
    parts = np.array_split(np.argsort(level), min(16, len(level)))
    means = [
        (np.average(level[at], weights=weight[at]), np.average(deviation[at], weights=weight[at]))
        for at in parts
    ]
    levels, deviations = np.array(means).T
    return float(np.abs(deviations).max()), levels, deviations


def _regions(frames: Sequence[Any], exposure: Floats, noise: NoiseModel) -> tuple[Floats, Floats]:
    """(k, r) mean signal of regions of each frame, NaN where one saturates, and their pixels."""
    signal, count = [], []
    for frame, t in zip(frames, exposure, strict=True):
        above = np.asarray(frame, float) - noise.black - np.asarray(noise.dark) * t
        # The tail of the noise is cut off before the mean reaches saturation.
        near = np.asarray(frame) >= noise.white
        rows = np.array_split(np.arange(above.shape[0]), min(_REGIONS, above.shape[0]))
        cols = np.array_split(np.arange(above.shape[1]), min(_REGIONS, above.shape[1]))
        blocks = [np.ix_(a, b) for a in rows for b in cols]
        signal.append([np.nan if near[at].any() else above[at].mean() for at in blocks])
        count.append([above[at].size for at in blocks])
    return np.array(signal), np.array(count, float)


@final
@dataclass(frozen=True, eq=False)
class Sensitivity:
    """What differs between pixels, and what a flat shows of the lens.

    Attributes:
        pixel: (h, w) sensitivity against the neighbours of the same colour, mean 1; 0 where a
            pixel is dead. sd: deviation of it. noise: deviation that the frames' own noise has
            in it, before it was taken out.
        shading: (h, w) smooth brightness of the flat, 1 at its brightest, each colour alone.
        dead: how many pixels see less than half of their neighbours, or are hot.
    """

    pixel: Floats
    sd: float
    noise: float
    shading: Floats
    dead: int

    def record(self) -> dict[str, Any]:
        """The numbers."""
        return {
            "sd": self.sd, "noise": self.noise, "dead_pixels": self.dead,
            "darkest_shading": float(self.shading.min()),
        }  # fmt: skip


def fit_sensitivity(
    frames: Sequence[Any],
    exposure_s: ArrayLike,
    noise: NoiseModel,
    *,
    period: tuple[int, int],
    hot: Any = None,
    smooth: float = 12.0,
) -> Sensitivity:
    """Relative sensitivity of every pixel from flat frames of an even scene.

    Args:
        frames: k frames (h, w), counts; saturated pixels are left out.
        exposure_s: (k,) seconds.
        noise: of the sensor.
        period: rows and columns after which colours repeat: (2, 2) for a Bayer mosaic, (1, 1)
            for one colour, (1, 3) for three side by side.
        hot: (h, w) pixels known to be of no use, or None.
        smooth: deviation of the Gaussian that divides lens from pixel, pixels of one colour.

    Raises:
        CalibrationError: no frame, or every pixel saturates in all.
    """
    total, weight = np.zeros(np.shape(frames[0])), np.zeros(np.shape(frames[0]))
    for frame, t in zip(frames, np.asarray(exposure_s, float), strict=True):
        below = np.asarray(frame) < noise.white
        above = np.asarray(frame, float) - noise.black - np.asarray(noise.dark) * t
        total += np.where(below, noise.linear(above), 0)
        weight += np.where(below, t, 0)
    if not (weight > 0).any():
        raise CalibrationError(
            f"all {len(frames)} flat frames saturate everywhere",
            remedy="capture the flat at shorter exposures",
        )
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = total / weight
        relative = noise.variance(total) / np.maximum(total, 1) ** 2
    shading, pixel = np.ones_like(mean), np.ones_like(mean)
    for row in range(period[0]):
        for col in range(period[1]):
            at = (slice(row, None, period[0]), slice(col, None, period[1]))
            shading[at] = _smoothed(mean[at], smooth)
    with np.errstate(divide="ignore", invalid="ignore"):
        pixel = mean / shading
    unusable = ~np.isfinite(pixel) | (pixel < 0.5)
    if hot is not None:
        unusable |= hot
    good = pixel[~unusable]
    own = float(np.median(relative[~unusable]))
    told = max(float(np.mean((good - 1) ** 2)) - own, 0.0)
    pixel = 1 + (pixel - 1) * told / max(told + own, 1e-300)
    pixel[unusable] = 0
    for row in range(period[0]):
        for col in range(period[1]):
            at = (slice(row, None, period[0]), slice(col, None, period[1]))
            # Every colour by itself: the colour of the flat is not that of the lens.
            shading[at] /= np.quantile(shading[at], 0.999)
    return Sensitivity(
        pixel, float(np.sqrt(told)), float(np.sqrt(own)), shading, int(unusable.sum())
    )


def _smoothed(plane: Floats, sigma: float) -> Floats:
    """A plane without what differs between neighbours; gaps and outliers don't count.

    Planes are fitted under a Gaussian window: a plain average is wrong at the rim of a plane
    that slopes.
    """
    from scipy.ndimage import gaussian_filter, median_filter

    whole = _polynomial(plane)
    plane = plane / whole
    rows, cols = np.mgrid[: plane.shape[0], : plane.shape[1]].astype(float) / sigma
    finite = np.isfinite(plane)
    filled = np.where(finite, plane, np.nanmedian(plane))
    typical = median_filter(filled, 5, mode="nearest")
    keep = (finite & (np.abs(filled - typical) < 0.25 * np.abs(typical))).astype(float)

    def mean(values: Floats) -> Floats:
        return gaussian_filter(values * keep, sigma, mode="constant")

    m0 = np.maximum(mean(np.ones_like(plane)), 1e-12)
    # Centred coordinates keep the small system well conditioned.
    r, c, v = mean(rows) / m0, mean(cols) / m0, mean(filled) / m0
    rr, cc, rc = (mean(a * b) / m0 - p * q for a, b, p, q in (
        (rows, rows, r, r), (cols, cols, c, c), (rows, cols, r, c)))  # fmt: skip
    rv, cv = mean(rows * filled) / m0 - r * v, mean(cols * filled) / m0 - c * v
    determinant = rr * cc - rc**2
    safe = np.where(np.abs(determinant) > 1e-9, determinant, np.inf)
    slope_r, slope_c = (rv * cc - cv * rc) / safe, (cv * rr - rv * rc) / safe
    return np.asarray(whole * (v + slope_r * (rows - r) + slope_c * (cols - c)))


def _polynomial(plane: Floats, degree: int = 6) -> Floats:
    """The polynomial through the medians of 16 x 16 blocks: the lens, which is curved."""
    from numpy.polynomial import legendre

    h, w = plane.shape
    blocks = [
        (r.mean(), c.mean(), np.nanmedian(plane[np.ix_(r, c)]))
        for r in np.array_split(np.arange(h), min(16, h))
        for c in np.array_split(np.arange(w), min(16, w))
        if np.isfinite(plane[np.ix_(r, c)]).any()
    ]
    rows, cols, values = np.array(blocks).T
    y, x = 2 * rows / max(h - 1, 1) - 1, 2 * cols / max(w - 1, 1) - 1
    degree = max(min(degree, min(h, w, 16) // 2 - 1), 0)
    design = legendre.legvander2d(y, x, [degree, degree])
    answer, *_ = np.linalg.lstsq(design, values, rcond=None)
    shape = answer.reshape(degree + 1, degree + 1)
    grid = legendre.leggrid2d(np.linspace(-1, 1, h), np.linspace(-1, 1, w), shape)
    # Between few blocks a polynomial may swing below what any block shows.
    return np.clip(grid, 0.5 * values.min(), 2 * values.max())
