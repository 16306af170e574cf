"""One lobe for many texels: gloss that few pairs tell of only together.

A texel that nine pictures show has seen its highlight once, if ever. The mean of texels of like
colour has a lobe that a grid of roughness and gloss is compared with; the texels then begin from
it, and are held to it the more sharply the fewer pairs there are.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2

from btfkit.native.lobe import HELD, Lobes, Start, fit_lobes, shaded

Array = NDArray[np.float32]
Floats = NDArray[Any]

# Kinds of texels, and what lobes are tried for each: GGX alpha, and F0.
_KINDS = 4
_ROUGHNESS = np.geomspace(0.05, 1, 12).astype(np.float32)
_GLOSS = np.geomspace(0.01, 1, 20).astype(np.float32)
# What gloss and roughness most materials have, and the deviations of their logarithms.
_USUAL_GLOSS, _USUAL_ROUGHNESS, _BY_GLOSS, _BY_ROUGHNESS = 0.04, 0.4, 1.0, 1.0
# How far a mean is from any lobe, in parts of its own brightness.
_MISFIT = 0.15
# Pairs with which a texel has its own gloss; with a tenth of them it is held 100 times as sharply.
_OWN_GLOSS_PAIRS = 100
# Slopes are held to the plane: deviation 0.45, where data say nothing.
_HELD_SLOPE = 5.0


def lobes_of(
    values: Array,
    light: Array,
    view: Array,
    *,
    slopes: bool,
    place: Array | None = None,
    near: tuple[Array | None, Array | None] = (None, None),
) -> Lobes:
    """Lobes of texels, alike where texels are.

    Args:
        values: (t, m, c) of m pairs; NaN where not measured.
        light, view: (m, 3) unit vectors, at the centre of the sample.
        slopes: whether the lights tell slopes; else all are 0.
        place, near: of the texels, and of lamps and eyes where they are near, as `fit_lobes` has.
    """
    _, m, c = values.shape
    count = c if c in (1, 3) else 1
    part: Array = values if count == c else np.asarray(values.mean(axis=2, keepdims=True))
    start = shared(part, light, view)
    sharp = max(1.0, (_OWN_GLOSS_PAIRS / m) ** 2)
    held = (_HELD_SLOPE, HELD[1] * sharp, HELD[2], HELD[3] * sharp)
    weight: Array = np.asarray(np.isfinite(values).all(axis=2), np.float32)
    rays: list[Array] = [
        far if by is None else by for far, by in zip((light, view), near, strict=True)
    ]
    are_near = near[0] is not None, near[1] is not None

    def fit(values: Array, start: Start, *, free: bool) -> Lobes:
        return fit_lobes(
            values, weight, rays[0], rays[1], start, slopes=slopes and free, rough=free,
            place=place, near=are_near, held=held,
        )  # fmt: skip

    found = fit(part, start, free=True)
    if count == c:
        return found
    # Spectral data: the shape of the lobe from all channels together, then each one's colours.
    shape = Start(*found[:4])
    colours = [fit(values[..., k : k + 1], shape, free=False) for k in range(c)]
    return found._replace(
        albedo=np.concatenate([one.albedo for one in colours], axis=1),
        specular=np.concatenate([one.specular for one in colours], axis=1),
    )


def shared(values: Array, light: Array, view: Array) -> Start:
    """Lobes of texels (t, m, c), equal for those of one kind; slopes are 0."""
    t, _, c = values.shape
    measured = np.isfinite(values)
    total = np.where(measured, values, 0).sum(axis=1)
    mean = total / np.maximum(measured.sum(axis=1), 1)
    kind = _kinds(np.log(np.maximum(mean, 0) + 1e-3))
    roughness = np.full(t, _USUAL_ROUGHNESS, np.float32)
    specular = np.full((t, c), _USUAL_GLOSS, np.float32)
    albedo = np.clip(mean, 0, 1).astype(np.float32)
    for which in range(int(kind.max()) + 1):
        own = kind == which
        counts = measured[own].sum(axis=0)
        pairs = np.flatnonzero(counts.min(axis=1) > 0)
        if not len(pairs):
            continue
        sums = np.where(measured[own], values[own], 0).sum(axis=0)
        found = _best(sums[pairs] / counts[pairs], light[pairs], view[pairs])
        roughness[own], specular[own], albedo[own] = found
    return Start(np.zeros((t, 2), np.float32), roughness, albedo, specular)


def _kinds(colours: Floats) -> NDArray[np.intp]:
    """(t,) which of a few kinds each texel is of, by its mean colour."""
    t = len(colours)
    distinct = len(np.unique(np.round(colours, 3), axis=0))
    kinds = min(_KINDS, distinct)
    if kinds < 2 or t < 4 * _KINDS:
        return np.zeros(t, np.intp)
    _, labels = kmeans2(colours, kinds, seed=np.random.default_rng(0), minit="++")
    return labels.astype(np.intp)


def _best(mean: Floats, light: Array, view: Array) -> tuple[float, Array, Array]:
    """Roughness, gloss (c,) and albedo (c,) that explain the values (m, c) of a plane best."""
    c = mean.shape[1]
    rough, gloss = (g.reshape(-1) for g in np.meshgrid(_ROUGHNESS, _GLOSS, indexing="ij"))
    flat = np.zeros((len(rough), 2), np.float32)
    white, black = (
        shaded(Start(flat, rough, np.full((len(rough), 1), a, np.float32), gloss[:, None]),
               light, view)[..., 0] for a in (1.0, 0.0)
    )  # fmt: skip
    diffuse = white - black
    shape = len(_ROUGHNESS), len(_GLOSS), c
    cost, albedo = np.empty(shape), np.empty(shape)
    for k in range(c):
        y = np.maximum(mean[:, k], 0)
        # As the errors of logarithms count.
        by = diffuse / np.square(1 + y)
        best = np.clip((by * (y - black)).sum(1) / np.maximum((by * diffuse).sum(1), 1e-9), 0, 1)
        error = np.square(np.log1p(y) - np.log1p(best[:, None] * diffuse + black)).sum(axis=1)
        wide = _MISFIT * np.log1p(y).mean() + 1e-4
        cost[..., k] = (error / wide**2 / 2).reshape(shape[:2])
        albedo[..., k] = best.reshape(shape[:2])
    cost += np.square(np.log(_GLOSS / _USUAL_GLOSS) / _BY_GLOSS)[None, :, None] / 2
    chosen = cost.argmin(axis=1)
    total = np.take_along_axis(cost, chosen[:, None], axis=1)[:, 0].sum(axis=1)
    total += np.square(np.log(_ROUGHNESS / _USUAL_ROUGHNESS) / _BY_ROUGHNESS) / 2
    at = int(total.argmin())
    every = np.arange(c)
    found = albedo[at, chosen[at], every].astype(np.float32)
    return float(_ROUGHNESS[at]), _GLOSS[chosen[at]], found
