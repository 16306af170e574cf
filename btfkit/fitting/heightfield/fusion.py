"""Slopes and heights as one weighted problem: fine detail from light, the rest from parallax.

Photometric stereo knows slopes, its errors add up over long ways; parallax knows heights, texel
by texel, but coarsely. Weighted by their variances they are one system of equations. Shadows
bound it from the side: a point that the light reaches cannot lie under its neighbours' shadow.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.fitting.heightfield.bounds import SOFT_EDGE, Bounds
from btfkit.relief.integration import System, softened, system_of
from btfkit.relief.photometric import SLOPE_ERROR

Array = NDArray[np.float32]
Floats = NDArray[Any]

_ROUNDS = 4
# A height so many deviations off counts half.
_HALF = 2.5
_SAMPLES = 6
# Median of a squared normal number of variance 1; and no source gains more than this.
_MEDIAN_SQUARE, _LEAST_SCALE = 0.4549, 0.3


@final
@dataclass(frozen=True, eq=False)
class Fused:
    """A surface from both.

    Attributes:
        height: (h, w) texels. deviation: (h, w) expected of its error, texels.
        steps: of the solver.
    """

    height: Array
    deviation: Array
    steps: int


def fuse(
    slope: Floats,
    slope_variance: Floats,
    height: Floats,
    height_variance: Floats,
    *,
    wrap: bool,
    bounds: Bounds | None = None,
    seed: int = 0,
) -> Fused:
    """The surface that slopes and heights agree on best.

    Args:
        slope: (h, w, 2) dz/dx, dz/dy. slope_variance: (h, w, 2) of each; infinite where unknown.
        height: (h, w) texels. height_variance: (h, w); infinite where unknown.
        wrap: whether the surface tiles. seed: of the deviation's samples.
        bounds: that shadows set; a height beyond one is drawn back to it.
    """
    by_slope = 1 / (np.maximum(slope_variance, 0) + SLOPE_ERROR**2)
    by_height = 1 / np.maximum(height_variance, 1e-6)
    base = system_of(slope, by_slope, wrap=wrap, known=height, by_known=by_height)
    now, found, steps = base, np.where(np.isfinite(height), height, 0).astype(float), 0
    for _ in range(_ROUNDS):
        found, taken = now.solve(now.right(), found)
        steps += taken
        base = _reweighted(base, found)
        now = _bounded(_softened(base, found), found, bounds)
    return Fused(found.astype(np.float32), _deviation(now, found, seed), steps)


def _reweighted(system: System, height: Floats) -> System:
    """Each source's variances scaled to what its equations leave: neither is as sure as it says.

    Source: variance components, Foerstner 1979; by medians, which outliers leave alone.
    """
    rx, ry = system.residuals(height)
    slopes = np.concatenate(
        [(system.by_across * rx**2).reshape(-1), (system.by_down * ry**2).reshape(-1)]
    )
    heights = (system.by_known * np.square(height - system.known))[system.by_known > 1e-6]
    scale = [
        max(float(np.median(part)) / _MEDIAN_SQUARE, _LEAST_SCALE) if part.size else 1.0
        for part in (slopes, heights)
    ]
    return replace(
        system, by_across=system.by_across / scale[0], by_down=system.by_down / scale[0],
        by_known=system.by_known / scale[1],
    )  # fmt: skip


def _softened(system: System, height: Floats) -> System:
    """Less weight for what stands out, of slopes (steps) and of heights (wrong matches)."""
    known = system.by_known * np.square(height - system.known) / _HALF**2
    return replace(softened(system, height), by_known=system.by_known / (1 + known))


def _bounded(system: System, height: Floats, bounds: Bounds | None) -> System:
    """The same equations, and those of the bounds that a surface breaks."""
    if bounds is None:
        return system
    low, high = height < bounds.lower, height > bounds.upper
    at = np.where(low, bounds.lower, np.where(high, bounds.upper, 0.0))
    by = np.where(low | high, 1 / SOFT_EDGE**2, 0.0)
    both = system.by_known + by
    known = (system.by_known * system.known + by * at) / np.maximum(both, 1e-30)
    return replace(system, known=known, by_known=both)


def _deviation(system: System, height: Floats, seed: int) -> Array:
    """(h, w) of the posterior: solutions of the same equations with noise of their own variance.

    Source: Papandreou and Yuille, "Gaussian Sampling by Local Perturbations", 2010.
    """
    rng = np.random.default_rng(seed)
    total = np.zeros_like(height)

    def noisy(weight: Floats) -> Floats:
        return rng.standard_normal(weight.shape) / np.sqrt(np.maximum(weight, 1e-12))

    for _ in range(_SAMPLES):
        noise = replace(
            system, across=noisy(system.by_across), down=noisy(system.by_down),
            known=noisy(system.by_known),
        )  # fmt: skip
        total += np.square(noise.solve(noise.right(), np.zeros_like(height))[0])
    return np.sqrt(total / _SAMPLES).astype(np.float32)
