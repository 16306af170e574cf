"""From the colours of a camera to linear BT.709: a root polynomial through known patches.

Roots of products scale with the exposure as the channels do, so that the correction is the same
at every brightness; plain polynomials turn the hue of what is lit more.

Source: Finlayson, Mackiewicz, Hurlbert, "Color correction using root-polynomial regression", 2015.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from btfkit import colour
from btfkit.errors import CalibrationError

Floats = NDArray[np.floating]
_TERMS = {1: 3, 2: 6}


@final
@dataclass(frozen=True, eq=False)
class ColourCorrection:
    """A correction of colours.

    Attributes:
        matrix: (3, 3 or 6) linear BT.709 of the terms of `root_polynomial`.
        left_out: (p,) difference (CIEDE2000) of each patch where the others alone decide.
        fitted: (p,) difference where it decides with them.
        condition: of the fit.
    """

    matrix: Floats
    left_out: Floats
    fitted: Floats
    condition: float

    @property
    def degree(self) -> int:
        """1 for a matrix, 2 with roots of products."""
        return 1 if self.matrix.shape[1] == 3 else 2

    def apply(self, rgb: Floats) -> Floats:
        """Linear BT.709 (..., 3) of camera colours (..., 3), any exposure; NaN stays NaN."""
        matrix = self.matrix.astype(rgb.dtype)
        return root_polynomial(rgb, self.degree) @ matrix.T

    def record(self) -> dict[str, Any]:
        """As JSON's own types."""
        return {
            "matrix": self.matrix.tolist(), "left_out": self.left_out.tolist(),
            "fitted": self.fitted.tolist(), "mean_left_out": float(self.left_out.mean()),
            "worst_left_out": float(self.left_out.max()), "condition": self.condition,
        }  # fmt: skip


def root_polynomial(rgb: Floats, degree: int) -> Floats:
    """(..., 3 or 6) red, green, blue, and with degree 2 the roots of their products.

    Negative values, which dark pixels have, are 0 under a root.
    """
    if degree == 1:
        return rgb
    # NaN is no maximum: it goes through.
    red, green, blue = np.moveaxis(np.maximum(rgb, 0), -1, 0)
    roots = np.stack([red * green, green * blue, red * blue], axis=-1)
    return np.concatenate([rgb, np.sqrt(roots)], axis=-1)


def fit_colour(
    camera: ArrayLike, reference: ArrayLike, *, degree: int | None = None
) -> ColourCorrection:
    """The correction through patches of known colour.

    Args:
        camera: (p, 3) means of the patches over what the white reference would read, so that white
            is 1 in every channel.
        reference: (p, 3) linear BT.709 of the patches, white 1.
        degree: 1 or 2; None takes the one that predicts patches left out better.

    Raises:
        CalibrationError: too few patches, saturated ones, or ones that do not tell colours apart.
    """
    x, y = np.asarray(camera, float), np.asarray(reference, float)
    bad = np.flatnonzero(~np.isfinite(x).all(axis=1) | ~(x > 0).all(axis=1))
    if bad.size:
        raise CalibrationError(
            f"colour patch {bad[0]} reads {x[bad[0]].tolist()}; {bad.size} of {len(x)} patches are "
            "saturated or dark",
            remedy="capture the colour reference with more exposures",
        )
    degrees = [degree] if degree else [1, 2]
    tried = [_fitted(x, y, d) for d in degrees if len(x) >= _TERMS[d] + 2]
    if not tried:
        raise CalibrationError(
            f"{len(x)} colour patches; at least {_TERMS[degrees[0]] + 2} are needed",
            remedy="use a chart with more patches",
        )
    best = min(tried, key=lambda found: float(found.left_out.mean()))
    if best.condition > 1e6:
        raise CalibrationError(
            f"the colour patches do not tell colours apart (condition {best.condition:.2g})",
            remedy="use patches of several hues, not greys alone",
        )
    return best


def _fitted(x: Floats, y: Floats, degree: int) -> ColourCorrection:
    matrix, condition = _solved(x, y, degree)
    kept = np.arange(len(x))
    left_out = np.empty(len(x))
    for i in kept:
        others = kept != i
        without, _ = _solved(x[others], y[others], degree)
        left_out[i] = difference(root_polynomial(x[i : i + 1], degree) @ without.T, y[i : i + 1])[0]
    fitted = difference(root_polynomial(x, degree) @ matrix.T, y)
    return ColourCorrection(matrix, left_out, fitted, condition)


def _solved(x: Floats, y: Floats, degree: int) -> tuple[Floats, float]:
    """(3, terms) of least squares, then of least perceived difference, and the condition.

    Rows sum to 1: the white reference is white, and so is every grey, at any exposure.
    """
    terms = root_polynomial(x, degree)
    free, rest = terms[:, 1:] - terms[:, :1], y - terms[:, :1]
    # The eye sees relative differences: dark patches would count for nothing.
    weight = 1 / (colour.rgb_to_xyz(y)[:, 1] + 0.02)
    answer, _, _, singular = np.linalg.lstsq(
        free * weight[:, None], rest * weight[:, None], rcond=None
    )
    # Greys alone leave all of the differences near 0: the terms themselves are the measure.
    condition = float(np.linalg.norm(terms * weight[:, None]) / max(singular[-1], 1e-300))
    return _whole(_perceived(terms, y, answer.T)), condition


def _whole(free: Floats) -> Floats:
    """(3, t) of what is free of it, (3, t - 1)."""
    return np.concatenate([1 - free.sum(axis=1, keepdims=True), free], axis=1)


def _perceived(terms: Floats, y: Floats, free: Floats) -> Floats:
    """What is free of the matrix, moved towards equal steps of lightness and colour (CIELAB)."""
    goal = lab(y)
    step = 1e-6
    for _ in range(8):
        now = terms @ _whole(free).T
        value = lab(now)
        slopes = np.stack([(lab(now + step * e) - value) / step for e in np.eye(3)], axis=-1)
        # CIEDE2000 forgives differences of strong colours: about as much as this.
        forgiven = np.ones_like(value)
        forgiven[:, 1:] += 0.045 * np.hypot(goal[:, 1], goal[:, 2])[:, None]
        moved = terms[:, 1:] - terms[:, :1]
        jacobian = np.einsum("pij,pt->pijt", slopes / forgiven[..., None], moved)
        flat = jacobian.reshape(value.size, -1)
        change, *_ = np.linalg.lstsq(flat, ((goal - value) / forgiven).ravel(), rcond=1e-12)
        free = free + change.reshape(free.shape)
        if np.abs(change).max() < 1e-10 * np.abs(free).max():
            break
    return free


def lab(rgb: Floats) -> Floats:
    """CIELAB (..., 3) under D65 of linear BT.709 (..., 3); CIE 15:2018, 8.2.1."""
    white = colour.rgb_to_xyz(np.ones(3))
    ratio = colour.rgb_to_xyz(np.asarray(rgb, float)) / white
    low = (24 / 116) ** 3
    root = np.where(ratio > low, np.cbrt(np.maximum(ratio, low)), 841 / 108 * ratio + 16 / 116)
    x, y, z = np.moveaxis(root, -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def difference(one: Floats, other: Floats) -> Floats:
    """CIEDE2000 (...) between linear BT.709 colours (..., 3)."""
    # It takes over a second to import.
    from colour.difference import delta_E_CIE2000

    return np.asarray(delta_E_CIE2000(lab(one), lab(other)), float)
