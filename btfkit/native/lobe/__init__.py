"""Lambert under one GGX lobe, fitted to the values of each texel: the kernel's face and its twin.

The reflectance is the tracer's (Smith's masking, Schlick's Fresnel term, what the gloss takes the
diffuse part lacks), isotropic. The error of a pair counts as Geman and McClure have it, so that
shadows and what no lobe explains pull on nothing; it is lowered by damped Gauss-Newton steps.

Sources: Walter et al. 2007 (GGX); Geman and McClure 1987; Marquardt 1963.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from btfkit import native

Array = NDArray[np.float32]
Floats = NDArray[Any]

# As in lobe.cpp.
_GRAZING, _LEAST_ROUGHNESS, MOST_ALBEDO, _MOST_SLOPE = 1e-4, 0.02, 4.0, 20.0
_ROUNDS = 14
# How sharply slopes, roughness, albedo and gloss are held to the start, 1 / deviation^2: next to
# nothing beside data that tell them.
HELD = (0.05, 10.0, 1e-3, 30.0)


class Lobes(NamedTuple):
    """What was fitted to t texels.

    Attributes:
        slope: (t, 2) dz/dx and dz/dy.
        roughness: (t,) GGX alpha.
        albedo, specular: (t, c).
        deviation: (t,) of the values from the fit, robust; NaN where there were too few.
        kept: (t,) share of the weights that was not taken for outliers; NaN as before.
        variance: (t, 3) of the slopes: xx, xy, yy; 0 where they were given.
    """

    slope: Array
    roughness: Array
    albedo: Array
    specular: Array
    deviation: Array
    kept: Array
    variance: Array


class Start(NamedTuple):
    """Where a fit begins: shapes as in `Lobes`."""

    slope: Array
    roughness: Array
    albedo: Array
    specular: Array


def fit_lobes(
    values: Array,
    weight: Array,
    light: Array,
    view: Array,
    start: Start,
    *,
    slopes: bool = True,
    rough: bool = True,
    gloss: bool = True,
    place: Array | None = None,
    near: tuple[bool, bool] = (False, False),
    rounds: int = _ROUNDS,
    held: tuple[float, float, float, float] = HELD,
) -> Lobes:
    """Fit every texel on its own.

    Args:
        values: (t, m, c) of m pairs, one or three channels; NaN is left out.
        weight: (t, m), 0 leaves out.
        light, view: (m, 3) unit vectors, or positions where `near` says so.
        start: where each fit begins, and what it is held to where the data say nothing.
        slopes, rough, gloss: whether slopes, roughness and specular are fitted or taken as given.
        place: (t, 3) of the texels in the unit of the positions.
        near: whether `light` and `view` are positions.
        rounds: steps tried at most.
        held: how sharply slopes, roughness, albedo and gloss are held to the start, 1/deviation^2.
    """
    t, _, c = values.shape
    theta = _packed(start)
    is_free = np.array([slopes, slopes, rough, *([True, gloss] * c)], np.uint8)
    by_slope, by_roughness, by_albedo, by_gloss = held
    prior = np.array([by_slope, by_slope, by_roughness, *([by_albedo, by_gloss] * c)], np.float32)
    places = np.zeros((t, 3), np.float32) if place is None else place
    parts = tuple(
        np.ascontiguousarray(a, np.float32) for a in (values, weight, light, view, places)
    )
    floor = _least_deviation(parts[0], parts[1])
    module = native.load("lobe")
    if module is None or c not in (1, 3):
        y, by, lit, seen, at = parts
        return fit_lobes_plain(
            y, by, lit, seen, at, theta, prior, floor, is_free, near=near, rounds=rounds
        )
    found = np.empty((t, 5), np.float32)
    module.fit(*parts, prior, floor, is_free, *near, rounds, native.threads(), theta, found)
    return _unpacked(theta, found)


def fit_lobes_plain(
    values: Array,
    weight: Array,
    light: Array,
    view: Array,
    place: Array,
    theta: Array,
    prior: Array,
    floor: Array,
    is_free: NDArray[np.uint8],
    *,
    near: tuple[bool, bool] = (False, False),
    rounds: int = _ROUNDS,
) -> Lobes:
    """The same in numpy, all texels side by side, in float64."""
    _, _, c = values.shape
    good = np.logical_and(weight > 0, np.isfinite(values).all(axis=2))
    y = np.where(good[..., None], values, 0).astype(float)
    weights = np.where(good, weight, 0).astype(float)
    lit, seen = _directions(light, place, near[0]), _directions(view, place, near[1])
    total, free = weights.sum(axis=1), np.flatnonzero(is_free)
    enough = (good.sum(axis=1) >= max(3, -(-len(free) // c))) & (total > 0)
    start = np.where(enough[:, None], _clamped(theta.astype(float)), theta)
    best, least = start.copy(), floor.astype(float)

    def looked(at: Floats, scale: Floats) -> tuple[Floats, ...]:
        residual, slopes = _model(at, lit, seen, y)
        square = np.square(residual).mean(axis=2)
        down = 1 / (1 + square / np.square(scale)[:, None])
        pull = (prior * np.square(at - start)).sum(axis=1) * np.square(scale / 3)
        return residual, slopes, square, weights * down**2, (weights * square * down).sum(1) + pull

    def deviation(square: Floats) -> Floats:
        heavy = weights >= 0.5
        any_heavy: NDArray[np.bool_] = np.any(heavy, axis=1, keepdims=True)
        use = np.where(any_heavy, heavy, good)
        ranked = np.sort(np.where(use, square, np.inf), axis=1)
        middle = np.minimum(use.sum(axis=1) // 2, square.shape[1] - 1)
        found = np.take_along_axis(ranked, middle[:, None], axis=1)[:, 0]
        return 1.4826 * np.sqrt(np.where(np.isfinite(found), found, 0))

    sigma = np.maximum(deviation(looked(best, np.ones(len(best)))[2]), least)
    now = looked(best, 3 * sigma)
    damping, running = np.full(len(best), 1e-2), enough.copy()
    for count in range(rounds):
        a, g = _normal_equations(now[0], now[1], now[3])
        noise = np.square(sigma)[:, None]
        system = a[:, free][:, :, free]
        diagonal = np.einsum("tii->ti", system)
        diagonal += noise * prior[free]
        diagonal *= 1 + damping[:, None]
        diagonal += 1e-12 * total[:, None] + 1e-30
        step = np.linalg.solve(system, -(g + noise * prior * (best - start))[:, free, None])[..., 0]
        trial = best.copy()
        trial[:, free] += step
        trial = _clamped(trial)
        then = looked(trial, 3 * sigma)
        better = running & (then[4] < now[4])
        settled = better & (now[4] - then[4] < 1e-4 * now[4]) & (count > 3)
        best = np.where(better[:, None], trial, best)
        tighter = np.maximum(np.minimum(deviation(then[2]), sigma), least)
        sigma = np.where(better, tighter, sigma)
        now = looked(best, 3 * sigma)
        damping = np.where(better, np.maximum(damping / 6, 1e-6), damping * 8)
        running &= ~settled & (damping <= 1e6)
    kept = np.sqrt(weights * now[3]).sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        left = np.sqrt((now[3] * now[2]).sum(axis=1) / np.maximum(kept, 1e-12))
        share = kept / total
    found = np.full((len(best), 5), np.nan)
    found[:, 0], found[:, 1] = left, share
    found[:, 2:] = _variance(now, np.maximum(left, least), prior, free, total)
    found[~enough] = np.nan
    return _unpacked(best.astype(np.float32), found.astype(np.float32))


def better(one: Lobes, other: Lobes) -> Lobes:
    """Of two fits of each texel the one that explains more of its values, better."""
    with np.errstate(invalid="ignore"):
        first, second = (f.deviation / np.maximum(f.kept, 1e-6) for f in (one, other))
        take = second < first
    return Lobes(
        *(
            np.where(take.reshape(-1, *(1,) * (a.ndim - 1)), b, a)
            for a, b in zip(one, other, strict=True)
        )
    )


def shaded(lobes: Start | Lobes, light: Array, view: Array) -> Array:
    """(t, m, c) values of t texels under m pairs (m, 3), as traced without shadows."""
    module = native.load("lobe")
    if module is None:
        return shaded_plain(lobes, light, view)
    (t, c), m = lobes.albedo.shape, len(light)
    rays = [np.ascontiguousarray(d, np.float32) for d in (light, view)]
    out = np.empty((t, m, c), np.float32)
    for k in range(c):
        one = Start(lobes.slope, lobes.roughness, lobes.albedo[:, [k]], lobes.specular[:, [k]])
        values = np.empty((t, m), np.float32)
        module.shade(*rays, np.ascontiguousarray(_packed(one)), native.threads(), values)
        out[..., k] = values
    return out


def shaded_plain(lobes: Start | Lobes, light: Array, view: Array) -> Array:
    """The same in numpy."""
    theta = _packed(Start(lobes.slope, lobes.roughness, lobes.albedo, lobes.specular))
    t, m, c = len(theta), len(light), lobes.albedo.shape[1]
    lit, seen = (np.broadcast_to(d.astype(float), (t, m, 3)) for d in (light, view))
    return _model(theta.astype(float), lit, seen, np.zeros((t, m, c)))[0].astype(np.float32)


def _packed(start: Start) -> Array:
    """(t, 3 + 2 c): slopes, roughness, and albedo and specular of each channel in turn."""
    pairs = np.stack([start.albedo, start.specular], axis=-1).reshape(len(start.slope), -1)
    return np.concatenate([start.slope, start.roughness[:, None], pairs], axis=1).astype(np.float32)


def _unpacked(theta: Array, found: Array) -> Lobes:
    return Lobes(
        theta[:, :2], theta[:, 2], theta[:, 3::2], theta[:, 4::2],
        found[:, 0], found[:, 1], found[:, 2:],
    )  # fmt: skip


def _least_deviation(values: Array, weight: Array) -> Array:
    """(t,) below which a deviation is rounding: a five-hundredth of the texel's own brightness."""
    with np.errstate(invalid="ignore"):
        use = (weight > 0) & np.isfinite(values).all(axis=2)
    bright = np.where(use, np.abs(np.where(use[..., None], values, 0)).mean(axis=2), 0)
    mean = bright.sum(axis=1) / np.maximum(use.sum(axis=1), 1)
    return np.maximum(0.002 * mean, 1e-6).astype(np.float32)


def _directions(of: Array, place: Array, near: bool) -> Floats:
    """(t, m, 3) unit vectors."""
    rays = np.broadcast_to(of.astype(float), (len(place), *of.shape))
    if not near:
        return rays
    rays = rays - place[:, None]
    return rays / np.maximum(np.linalg.norm(rays, axis=2, keepdims=True), 1e-15)


def _clamped(theta: Floats) -> Floats:
    low = np.array([-_MOST_SLOPE, -_MOST_SLOPE, _LEAST_ROUGHNESS])
    high = np.array([_MOST_SLOPE, _MOST_SLOPE, 1.0])
    channels = (theta.shape[1] - 3) // 2
    return np.clip(
        theta,
        np.concatenate([low, np.zeros(2 * channels)]),
        np.concatenate([high, np.tile([MOST_ALBEDO, 1.0], channels)]),
    )


def _model(theta: Floats, light: Floats, view: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Residuals (t, m, c), and their derivatives (t, m, c, 5) by slopes, roughness, albedo, f0."""
    length = np.sqrt(1 + np.square(theta[:, :2]).sum(axis=1))
    n = np.concatenate([-theta[:, :2], np.ones((len(theta), 1))], axis=1) / length[:, None]
    half = light + view
    half = half / np.sqrt(np.maximum(np.square(half).sum(axis=2, keepdims=True), 1e-30))
    vh5 = (1 - np.maximum((view * half).sum(axis=2), 0)) ** 5
    cosine = [np.einsum("tk,tmk->tm", n, d) for d in (light, view, half)]
    by_slope = [
        (cos[..., None] * n[:, None, :2] - d[..., :2]) / length[:, None, None]
        for cos, d in zip(cosine, (light, view, half), strict=True)
    ]
    nl, raw_v, raw_h = cosine
    nv, nh = np.maximum(raw_v, _GRAZING), np.maximum(raw_h, 0)
    by_slope[1] = by_slope[1] * (raw_v > _GRAZING)[..., None]
    by_slope[2] = by_slope[2] * (raw_h > 0)[..., None]
    lobe, d_lobe, d_rough = _gloss(np.maximum(nl, 1e-6), nv, nh, theta[:, 2:3], by_slope)
    albedo, f0 = theta[:, None, 3::2], theta[:, None, 4::2]
    grows = np.where(50 * f0 < 1, 49.0, -1.0)
    rest = np.minimum(50 * f0, 1) - f0
    nl_, lit, lobe_ = nl[..., None], (nl > 0)[..., None], lobe[..., None]
    gl, gv = 1 - nl_, 1 - nv[..., None]
    fl, fv = 1 - f0 - rest * gl**5, 1 - f0 - rest * gv**5
    fh = f0 + rest * vh5[..., None]
    inner = albedo * fl * fv + lobe_ * fh
    by_nl = inner + nl_ * albedo * 5 * rest * gl**4 * fv
    by_nv = nl_ * albedo * fl * 5 * rest * gv**4
    slopes = [
        by_nl * by_slope[0][..., k, None]
        + by_nv * by_slope[1][..., k, None]
        + nl_ * fh * d_lobe[..., k, None]
        for k in range(2)
    ]
    rough, diffuse = nl_ * fh * d_rough[..., None], nl_ * fl * fv
    dark = (1 + grows * gl**5) * fv + fl * (1 + grows * gv**5)
    gloss = nl_ * (lobe_ * (1 + grows * vh5[..., None]) - albedo * dark)
    rows = np.stack(np.broadcast_arrays(*slopes, rough, diffuse, gloss), axis=-1)
    return np.where(lit, nl_ * inner, 0) - y, np.where(lit[..., None], rows, 0)


def _gloss(
    nl: Floats, nv: Floats, nh: Floats, a: Floats, by_slope: list[Floats]
) -> tuple[Floats, Floats, Floats]:
    """pi D G / (4 nl nv) (t, m), and its derivatives by the slopes (t, m, 2) and roughness."""
    aside = np.maximum(1 - nh * nh, 0)
    d = aside / a**2 + nh * nh
    l2, v2 = np.maximum(1 - nl * nl, 0), np.maximum(1 - nv * nv, 0)
    sl, sv = np.sqrt(nl * nl + a * a * l2), np.sqrt(nv * nv + a * a * v2)
    ml, mv = nl + sl, nv + sv
    lobe = 1 / (a * a * d * d * ml * mv)
    logs = (
        -(1 + nl * (1 - a * a) / sl) / ml,
        -(1 + nv * (1 - a * a) / sv) / mv,
        -4 * nh * (1 - 1 / a**2) / d,
    )
    moved = sum(log[..., None] * s for log, s in zip(logs, by_slope, strict=True))
    by_a = -2 / a + 4 * aside / a**3 / d - a * l2 / (sl * ml) - a * v2 / (sv * mv)
    return lobe, lobe[..., None] * moved, lobe * by_a


def _normal_equations(residual: Floats, rows: Floats, w: Floats) -> tuple[Floats, Floats]:
    """J'WJ (t, p, p) and J'Wr (t, p) over pairs and channels."""
    t, _, c = residual.shape
    a, g = np.zeros((t, 3 + 2 * c, 3 + 2 * c)), np.zeros((t, 3 + 2 * c))
    for k in range(c):
        slot = np.array([0, 1, 2, 3 + 2 * k, 4 + 2 * k])
        weighted = rows[:, :, k] * w[..., None] / c
        a[:, slot[:, None], slot] += np.einsum("tmi,tmj->tij", weighted, rows[:, :, k])
        g[:, slot] += np.einsum("tmi,tm->ti", weighted, residual[:, :, k])
    return a, g


def _variance(
    now: tuple[Floats, ...], noise: Floats, prior: Array, free: NDArray[np.intp], total: Floats
) -> Floats:
    """(t, 3) xx, xy, yy of the slopes; 0 where they are given."""
    if free[0] != 0:
        return np.zeros((len(noise), 3))
    a, _ = _normal_equations(now[0], now[1], now[3])
    system = a[:, free][:, :, free]
    diagonal = np.einsum("tii->ti", system)
    diagonal += np.square(noise)[:, None] * prior[free] + 1e-12 * total[:, None] + 1e-30
    inverse = np.linalg.inv(system)[:, :2, :2] * np.square(noise)[:, None, None]
    return np.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], axis=1)
