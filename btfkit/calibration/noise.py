"""How raw counts scatter about their mean: what weights in a merge come from."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from btfkit.errors import CalibrationError

Floats = NDArray[np.floating]
# Variance of rounding to whole counts, where the noise spans the step between two of them.
QUANTISATION = 1 / 12


@final
@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Mean and variance of the counts of a linear sensor.

    A pixel of sensitivity s that is exposed for t seconds to radiance L reads on average
    black + t (s L + dark) counts, with variance read^2 + 1/12 + t (s L + dark) / gain.

    Attributes:
        gain: electrons a count. read: deviation of a count in the dark, without rounding, counts.
        white: the count at which the sensor saturates; counts from here on say nothing.
        black: counts without light; a number, or (h, w).
        dark: counts a second without light; a number, or (h, w).
        sensitivity: (h, w) of each pixel relative to their mean, or None where all are alike.
        curve: (c1, c2) of linear = y (1 + c1 y + c2 y^2), y counts above black over the full
            range; (0, 0) where the sensor is linear.
    """

    gain: float
    read: float
    white: float
    black: float | Floats = 0.0
    dark: float | Floats = 0.0
    sensitivity: Floats | None = None
    curve: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        for name, value, low in (("gain", self.gain, 0.0), ("read", self.read, -1e-30)):
            if not (math.isfinite(value) and value > low):
                raise CalibrationError(
                    f"the noise model has {name} {value:g}; expected a positive number",
                    remedy="give more flat and dark frames, or the sensor's data sheet",
                )
        if not np.all(np.isfinite(self.black)) or not self.full > 0:
            raise CalibrationError(
                f"black level {float(np.mean(self.black)):g} and saturation {self.white:g} counts "
                "leave no range between them",
                remedy="correct black and white of the sensor in sequence.json",
            )

    @property
    def full(self) -> float:
        """Counts between black and saturation."""
        return float(self.white - np.mean(self.black))

    @property
    def floor(self) -> float:
        """Variance of a count without light, rounding included, counts^2."""
        return self.read**2 + QUANTISATION

    def variance(self, signal: ArrayLike) -> Floats:
        """Variance of counts that are on average `signal` (...) above black, counts^2."""
        return self.floor + np.maximum(np.asarray(signal, float), 0) / self.gain

    def linear(self, signal: Floats) -> Floats:
        """Counts above black (...) in proportion to light."""
        if self.curve == (0.0, 0.0):
            return signal
        y = signal / self.full
        return signal * (1 + self.curve[0] * y + self.curve[1] * y * y)

    def bound(self, radiance: ArrayLike, exposure_s: ArrayLike) -> Floats:
        """Least deviation that an unbiased merge of these exposures can have (Cramer-Rao).

        Args:
            radiance: (...) counts a second.
            exposure_s: (k,) seconds; those that saturate tell nothing.

        Returns:
            (...) counts a second; infinite where all saturate.
        """
        t = np.asarray(exposure_s, float)
        mean = np.asarray(radiance, float)[..., None] * t
        variance = self.variance(mean)
        # The mean tells most; how much the counts scatter tells a little more.
        told = t**2 / variance + 0.5 * (t / self.gain / variance) ** 2
        with np.errstate(divide="ignore"):
            return 1 / np.sqrt(np.where(mean < self.full, told, 0).sum(axis=-1))

    def cropped(self, rows: slice, cols: slice) -> NoiseModel:
        """The model of a window of the sensor."""

        def cut(value: Any) -> Any:
            return value[rows, cols] if np.ndim(value) == 2 else value

        return replace(
            self,
            black=cut(self.black),
            dark=cut(self.dark),
            sensitivity=None if self.sensitivity is None else cut(self.sensitivity),
        )

    def record(self) -> dict[str, Any]:
        """The numbers of the model, maps as their means and deviations."""
        numbers: dict[str, Any] = {
            "gain_e_per_count": self.gain,
            "read_counts": self.read,
            "read_e": self.read * self.gain,
            "white": self.white,
            "black": float(np.mean(self.black)),
            "dark_counts_per_s": float(np.mean(self.dark)),
            "curve": list(self.curve),
        }
        if self.sensitivity is not None:
            numbers["sensitivity_sd"] = float(np.std(self.sensitivity))
        return numbers


@final
@dataclass(frozen=True)
class Fitted:
    """What a fit says of itself.

    Attributes:
        values, sd: parameters by name and one deviation of each.
        condition: of the scaled normal equations; large where parameters are told apart badly.
        residual: largest, relative to what was fitted.
        held: parameters that the frames cannot tell and that were held fixed, and why.
    """

    values: dict[str, float]
    sd: dict[str, float]
    condition: float
    residual: float
    held: dict[str, str] = field(default_factory=dict)

    def record(self) -> dict[str, Any]:
        """As JSON's own types."""
        return {
            "values": self.values, "sd": self.sd, "condition": self.condition,
            "residual": self.residual, "held": self.held,
        }  # fmt: skip


def solved(
    design: Floats,
    target: Floats,
    weight: Floats,
    *,
    start: Floats | None = None,
    rounds: int = 8,
) -> tuple[Floats, Floats, float, NDArray[np.bool_]]:
    """Weighted least squares that leaves rows out that lie beyond five deviations.

    Args:
        design: (b, p) rows. target: (b,). weight: (b,) one over the variance of a row.
        start: (p,) a solution that decides which rows count first, or None for all of them.
        rounds: of leaving out.

    Returns:
        solution (p,), covariance (p, p), condition number, and which rows count (b,).

    Raises:
        CalibrationError: fewer rows than parameters.
    """
    keep = np.isfinite(target) & np.isfinite(weight) & (weight > 0)
    if start is not None:
        off = np.abs(design @ start - target) * np.sqrt(weight)
        keep &= off <= 5 * max(1.0, float(np.median(off[keep])) / 0.6745)
    size = np.sqrt(np.mean(design**2, axis=0))
    scale = np.where(size > 0, size, 1.0)
    answer, covariance, condition = np.zeros(design.shape[1]), np.eye(design.shape[1]), np.inf
    for _ in range(rounds):
        if keep.sum() < design.shape[1]:
            raise CalibrationError(
                f"{int(keep.sum())} usable measurements for {design.shape[1]} unknowns",
                remedy="add frames at other exposures",
            )
        root = np.sqrt(weight[keep])[:, None]
        scaled = design[keep] / scale * root
        inner, *_ = np.linalg.lstsq(scaled, target[keep] * root[:, 0], rcond=None)
        singular = np.linalg.svd(scaled, compute_uv=False)
        condition = float(singular[0] / max(singular[-1], 1e-300))
        answer = inner / scale
        normal = np.linalg.pinv(scaled.T @ scaled)
        residual = np.abs(design @ answer - target) * np.sqrt(weight)
        # Weights say how large residuals ought to be; where all are larger, the median counts.
        spread = max(1.0, float(np.median(residual[keep])) / 0.6745)
        covariance = normal / np.outer(scale, scale) * spread**2
        new = np.isfinite(residual) & (weight > 0) & (residual <= 5 * spread)
        if np.array_equal(new, keep):
            break
        keep = new
    return answer, covariance, condition, keep
