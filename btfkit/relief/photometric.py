"""Photometric stereo that survives shadows and highlights: normals from many lights.

A start by least squares over a window of ranks (neither the darkest values, which are shadows,
nor the brightest, which are highlights), then the tracer's own reflectance, Lambert under one GGX
lobe, fitted robustly a texel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.errors import FitError
from btfkit.native.lobe import Lobes, Start, better, fit_lobes
from btfkit.relief.stack import Stack, slopes

Array = NDArray[np.float32]
Floats = NDArray[Any]

# Ranks of the values that the start takes: measured, see docs/heightfields.md.
LOW_RANK, HIGH_RANK = 0.3, 0.8
# Lights whose directions span less than this (third singular value, a root mean square) lie in a
# plane with the sample: normals along it are free.
_FLATTEST_SPAN = 0.02
# What gloss is taken for where the data do not say.
_GLOSS, _ROUGHNESS = 0.04, (0.25, 0.6)
_STEEPEST = 0.05
# Pairs count by this power of the view's cosine: measured, see docs/heightfields.md.
_UPRIGHT = 2.0
# A slope known to this deviation has half the confidence of one known exactly.
_HALF_SLOPE = 0.05
# Systematic part of a slope's error: interpolation, reflectance that is no single lobe.
SLOPE_ERROR = 0.03
# Values that a block of rows may hold.
_MOST_VALUES = 1 << 24


@final
@dataclass(frozen=True, eq=False)
class Normals:
    """What photometric stereo found.

    Attributes:
        slope: (h, w, 2) dz/dx, dz/dy.
        variance: (h, w, 3) of the slopes, xx, xy, yy; infinite where nothing was found.
        albedo, specular, roughness: (h, w) grey reflectance, as in `Maps`.
        deviation: (h, w) robust, of the values.
        kept: (h, w) share of the values that the reflectance explains.
        confidence: (h, w) 0..1.
    """

    slope: Array
    variance: Array
    albedo: Array
    specular: Array
    roughness: Array
    deviation: Array
    kept: Array
    confidence: Array

    def normal(self) -> Array:
        """(h, w, 3) unit normals, surface frame."""
        return normal_of(self.slope)

    def lobes(self, rows: slice) -> Start:
        """The reflectance of the texels in some rows."""
        return Start(
            self.slope[rows].reshape(-1, 2), self.roughness[rows].reshape(-1),
            self.albedo[rows].reshape(-1, 1), self.specular[rows].reshape(-1, 1),
        )  # fmt: skip


def photometric_stereo(
    stack: Stack,
    *,
    height: Array | None = None,
    visible: NDArray[np.bool_] | None = None,
    start: Normals | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Normals:
    """Normals of every texel from all pairs of a stack.

    Args:
        stack: what was measured.
        height: (h, w) of the surface, texels: where each view sees its points; None is flat.
        visible: (n, h, w) where a pair's light and view are known to reach the surface; None
            leaves shadows to the robust error alone.
        start: normals found before to begin with; None begins with the window of ranks.

    Raises:
        FitError: lights that cannot tell normals.
    """
    check_lights(stack)
    h, w = stack.size
    flat = np.zeros((h, w), np.float32) if height is None else height
    grey = stack.grey
    upright = _upright(stack)
    turned = slopes(flat, wrap=stack.wrap) if start is None else start.slope
    parts: list[Lobes] = []
    step = max(_MOST_VALUES // (w * len(stack.pairs)), 1)
    for first in range(0, h, step):
        rows = slice(first, min(first + step, h))
        values = stack.seen(grey, flat, rows)
        weight = _weights(values, visible, rows) * upright
        weight *= stack.shown(turned[rows].reshape(-1, 2))
        begin = None if start is None else start.lobes(rows)
        parts.append(_fitted(stack, values, weight, stack.place(flat, rows), begin))
        if progress:
            progress(rows.stop, h)
    whole = [np.concatenate([part[k] for part in parts]) for k in range(len(parts[0]))]
    return _normals(Lobes(*whole), (h, w))


def slope_weights(normals: Normals) -> Array:
    """(h, w, 2) weights of the slopes, for integration."""
    by = 1 / (normals.variance[..., [0, 2]] + SLOPE_ERROR**2)
    return by.astype(np.float32)


def check_lights(stack: Stack) -> None:
    """Refuse lights that leave normals open.

    Raises:
        FitError: fewer than three, or all in one plane through the sample.
    """
    if len(stack.lights) < 3:
        raise FitError(
            f"{len(stack.lights)} light directions; normals need at least three that do not lie "
            "in one plane",
            remedy="measure more lights, or read heights out of a model: btfkit heightfield MODEL",
        )
    span = np.linalg.svd(stack.lights, compute_uv=False)[-1] / np.sqrt(len(stack.lights))
    if stack.light_near is None and span < _FLATTEST_SPAN:
        raise FitError(
            f"{len(stack.lights)} lights lie within {np.degrees(span):.1f} degrees of one plane "
            "through the sample; slopes across it cannot be told",
            remedy="add lights beside that plane",
        )


def rank_window(
    values: Array, weight: Array, light: Floats, *, low: float = LOW_RANK, high: float = HIGH_RANK
) -> tuple[Array, Array]:
    """Lambertian slopes and albedo by least squares over the values between two ranks.

    Args:
        values: (t, m) of t texels; NaN is left out. weight: (t, m), 0 leaves out.
        light: (m, 3) unit vectors, or (t, m, 3) of near lights.
        low, high: ranks, 0 the darkest, 1 the brightest.

    Returns:
        (t, 2) slopes dz/dx, dz/dy and (t,) albedo.

    Source: the window of ranks after Ikehata et al. and Shi et al., "A Biquadratic Reflectance
    Model for Radiometric Image Analysis", 2012, section 4.
    """
    good = (weight > 0) & np.isfinite(values)
    ranked = np.argsort(np.argsort(np.where(good, values, np.inf), axis=1), axis=1)
    rank = (ranked + 0.5) / np.maximum(good.sum(axis=1, keepdims=True), 1)
    # A few values are taken as they are: a window of them would leave none.
    few = good.sum(axis=1, keepdims=True) < 8
    use = good & (few | ((rank >= low) & (rank <= high)))
    w, y = use.astype(float), np.where(use, values, 0).astype(float)
    if light.ndim == 2:
        squares = (light[:, :, None] * light[:, None, :]).reshape(-1, 9)
        a, b = (w @ squares).reshape(-1, 3, 3), y @ light
    else:
        a = np.einsum("tm,tmi,tmj->tij", w, light, light)
        b = np.einsum("tm,tmi->ti", y, light)
    a = a + 1e-6 * np.maximum(np.trace(a, axis1=1, axis2=2), 1e-12)[:, None, None] * np.eye(3)
    n = np.linalg.solve(a, b[..., None])[..., 0]
    albedo = np.linalg.norm(n, axis=1)
    unit = n / np.maximum(albedo, 1e-12)[:, None]
    slope = -unit[:, :2] / np.maximum(unit[:, 2:], _STEEPEST)
    return np.where(albedo[:, None] > 0, slope, 0).astype(np.float32), albedo.astype(np.float32)


def normal_of(slope: Floats) -> Array:
    """(..., 3) unit normals of slopes (..., 2) dz/dx, dz/dy."""
    n = np.concatenate([-slope, np.ones((*slope.shape[:-1], 1))], axis=-1)
    return (n / np.linalg.norm(n, axis=-1, keepdims=True)).astype(np.float32)


def _upright(stack: Stack) -> Array:
    """(n,) weights of pairs, 1 of the most upright view: flat ones see texels drawn out."""
    z = np.maximum(stack.view[:, 2], 0) / max(float(stack.views[:, 2].max()), 1e-6)
    return (z**_UPRIGHT).astype(np.float32)


def _weights(values: Array, visible: NDArray[np.bool_] | None, rows: slice) -> Array:
    weight = np.isfinite(values[..., 0]).astype(np.float32)
    if visible is not None:
        seen = visible[:, rows].reshape(len(visible), -1).T
        # Fewer than a handful seen say less than many of which some are shadows.
        enough = (seen & (weight > 0)).sum(axis=1, keepdims=True) >= 8
        weight *= np.where(enough, seen, 0.5)
    return weight


def starts(stack: Stack, grey: Array, weight: Array, place: Array) -> list[Start]:
    """A narrow lobe and a wide one, two valleys of the error, on slopes of the window of ranks.

    Args:
        grey: (t, n) of t texels. weight: (t, n). place: (t, 3) of the texels.
    """
    towards: Floats = stack.light
    if stack.light_near is not None:
        rays = stack.light_near[None] - place[:, None]
        towards = rays / np.linalg.norm(rays, axis=2, keepdims=True)
    slope, albedo = rank_window(grey, weight, towards)
    gloss = np.full((len(grey), 1), _GLOSS, np.float32)
    return [
        Start(slope, np.full(len(grey), roughness, np.float32), albedo[:, None], gloss)
        for roughness in _ROUGHNESS
    ]


def _fitted(stack: Stack, values: Array, weight: Array, place: Array, begin: Start | None) -> Lobes:
    near = stack.light_near is not None, stack.view_near is not None
    light = stack.light if stack.light_near is None else stack.light_near
    view = stack.view if stack.view_near is None else stack.view_near
    firsts = starts(stack, values[..., 0], weight, place) if begin is None else [begin]
    best: Lobes | None = None
    for first in firsts:
        found = fit_lobes(values, weight, light, view, first, place=place, near=near)
        best = found if best is None else better(best, found)
    assert best is not None
    return best


def _normals(lobes: Lobes, size: tuple[int, int]) -> Normals:
    lost = ~np.isfinite(lobes.deviation)
    variance = np.where(lost[:, None], np.inf, lobes.variance)
    # Values that nothing explains say that the rest is explained by chance.
    kept = np.where(lost, 0, lobes.kept)
    spread = np.sqrt(np.where(lost, np.inf, variance[:, 0] + variance[:, 2]))
    confidence = kept / (1 + np.square(spread / _HALF_SLOPE))
    return Normals(
        slope=np.where(lost[:, None], 0, lobes.slope).reshape(*size, 2).astype(np.float32),
        variance=variance.reshape(*size, 3).astype(np.float32),
        albedo=lobes.albedo[:, 0].reshape(size),
        specular=lobes.specular[:, 0].reshape(size),
        roughness=lobes.roughness.reshape(size),
        deviation=lobes.deviation.reshape(size),
        kept=kept.reshape(size).astype(np.float32),
        confidence=np.clip(confidence, 0, 1).reshape(size).astype(np.float32),
    )
