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

from btfkit.relief.integration import System, softened, system_of

Array = NDArray[np.float32]
Floats = NDArray[Any]

_ROUNDS = 4
# Systematic part of a slope's error: interpolation, reflectance that is no single lobe.
_SLOPE_ERROR = 0.03
# A height so many deviations off counts half.
_HALF = 2.5
_SAMPLES = 6


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
    seed: int = 0,
) -> Fused:
    """The surface that slopes and heights agree on best.

    Args:
        slope: (h, w, 2) dz/dx, dz/dy. slope_variance: (h, w, 2) of each; infinite where unknown.
        height: (h, w) texels. height_variance: (h, w); infinite where unknown.
        wrap: whether the surface tiles. seed: of the deviation's samples.
    """
    by_slope = 1 / (np.maximum(slope_variance, 0) + _SLOPE_ERROR**2)
    by_height = 1 / np.maximum(height_variance, 1e-6)
    base = system_of(slope, by_slope, wrap=wrap, known=height, by_known=by_height)
    now, found, steps = base, np.where(np.isfinite(height), height, 0).astype(float), 0
    for _ in range(_ROUNDS):
        found, taken = now.solve(now.right(), found)
        steps += taken
        now = _softened(base, found)
    return Fused(found.astype(np.float32), _deviation(now, found, seed), steps)


def _softened(system: System, height: Floats) -> System:
    """Less weight for what stands out, of slopes (steps) and of heights (wrong matches)."""
    known = system.by_known * np.square(height - system.known) / _HALF**2
    return replace(softened(system, height), by_known=system.by_known / (1 + known))


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
