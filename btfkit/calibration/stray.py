"""Stray light: a share of all light in the frame that lens and housing spread over all of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from btfkit.calibration.merge import Merged
from btfkit.calibration.noise import Fitted, solved
from btfkit.errors import CalibrationError

Floats = NDArray[np.floating]
_MOST = 0.2


@final
@dataclass(frozen=True, eq=False)
class Stray:
    """What is spread.

    Attributes:
        share: of the mean radiance of the frame that is added everywhere.
        fitted: errors and condition; `held` says why the share is 0 where it could not be told.
    """

    share: float
    fitted: Fitted

    def removed(self, merged: Merged, lens: Floats, colours: NDArray[np.intp] | None) -> Merged:
        """A merged frame without it.

        Args:
            merged: (h, w) or (h, w, 3), flat-fielded.
            lens: shading of its shape that the flat was divided by: stray light lacks it.
            colours: (h, w) channel of each pixel of a mosaic; None otherwise.
        """
        if self.share == 0:
            return merged
        added = self.share * frame_means(merged, lens, colours)
        if colours is not None:
            spread = added[colours]
        else:
            spread = np.broadcast_to(added, merged.radiance.shape)
        radiance = (merged.radiance - spread / lens).astype(np.float32)
        return Merged(radiance, merged.variance, merged.validity)


def frame_means(merged: Merged, lens: Floats, colours: NDArray[np.intp] | None) -> Floats:
    """(c,) mean radiance on the sensor, before the flat was divided out; what saturates counts
    as the brightest that does not.

    Args:
        merged: (h, w) or (h, w, 3), flat-fielded. lens: shading, of its shape.
        colours: (h, w) channel of each pixel of a mosaic; None otherwise.
    """
    seen = merged.radiance * lens
    bright = float(np.nanmax(seen)) if np.isfinite(seen).any() else 0.0
    seen = np.where(np.isfinite(seen), seen, bright)
    if merged.radiance.ndim == 3:
        return np.asarray(seen.mean((0, 1)), float)
    if colours is None:
        return np.array([seen.mean()])
    return np.array([seen[colours == c].mean() for c in range(3)])


def fit_stray(level: ArrayLike, expected: ArrayLike, mean: ArrayLike) -> Stray:
    """The share from grey patches of known reflectance: dark ones read too bright.

    Args:
        level: (p, c) radiance of the patches.
        expected: (p,) what they ought to be, any unit: reflectance times irradiance times cosine.
        mean: (p, c) mean radiance of their frame, over the lens's shading at the patch.

    Raises:
        CalibrationError: a share that no lens has.
    """
    value, grey = np.asarray(level, float), np.asarray(expected, float)
    around = np.asarray(mean, float)
    p, c = value.shape
    used = np.isfinite(value)
    # One scale a channel and one share for all.
    design = np.zeros((p, c, c + 1))
    design[:, np.arange(c), np.arange(c)] = grey[:, None]
    design[..., c] = around
    weight = np.where(used, 1 / np.maximum(value, 1e-9) ** 2, 0).ravel()
    held = {}
    if np.ptp(grey) < 0.5 * grey.max() or used.sum() < 2 * (c + 1):
        held["share"] = "0: needs grey patches from dark to bright"
        return Stray(0.0, Fitted({"share": 0.0}, {}, np.inf, 0.0, held))
    target = np.where(used, value, 0).ravel()
    rows: Any = design.reshape(-1, c + 1)
    answer, covariance, condition, keep = solved(rows, target, weight)
    off = (rows @ answer - target)[keep] * np.sqrt(weight[keep])
    share = float(answer[c])
    scatter = float(np.sqrt(np.mean(off**2)))
    sd = float(np.sqrt(covariance[c, c])) * max(scatter, 1e-6)
    if abs(share) > _MOST:
        raise CalibrationError(
            f"grey patches ask for {100 * share:.1f} % of stray light; no lens has so much",
            remedy="correct the patches' reflectances or places in sequence.json",
        )
    if share < 2 * sd:
        held["share"] = f"0: {share:.4f} is within its error {sd:.4f}"
        share = 0.0
    return Stray(share, Fitted({"share": share}, {"share": sd}, condition, scatter, held))
