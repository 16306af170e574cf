"""Errors of a material on a BTF or on queries with answers, by the keys of docs/metrics.md."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from btfkit import gains as nuisance
from btfkit import metrics
from btfkit.btf import BTF
from btfkit.footprint import level_of
from btfkit.materials.base import Material
from btfkit.queries import QuerySet

Window = tuple[slice, slice]
Picture = tuple[NDArray[np.float32], NDArray[np.float32]]
# Texels a side that stand for a large texture where time is short.
_WINDOW = 256


def texel_centres(h: int, w: int) -> NDArray[np.float64]:
    """(h, w, 2) uv of the centres of a grid of texels."""
    u, v = np.meshgrid((np.arange(w) + 0.5) / w, (np.arange(h) + 0.5) / h)
    return np.stack([u, v], axis=-1)


def answer_pair(
    material: Material, btf: BTF, index: int, window: Window | None = None
) -> NDArray[np.float32]:
    """(h, w, c) what a material answers for every texel of pair `index`, or for a window of it."""
    _, h, w, _ = btf.shape
    at = window or (slice(None), slice(None))
    near = btf.light_position is not None or btf.view_position is not None
    light = btf.light_at(index)[at] if near else btf.light[index]
    view = btf.view_at(index)[at] if near else btf.view[index]
    return material.evaluate(texel_centres(h, w)[at], light, view).reflectance


def errors_on_btf(
    material: Material,
    btf: BTF,
    *,
    pairs: ArrayLike | None = None,
    within_s: float | None = None,
    progress: Callable[[int, int], None] | None = None,
    gains: bool = False,
    lpips: Callable[..., float] | None = None,
) -> dict[str, Any]:
    """Errors over whole textures.

    Args:
        material: what answers.
        btf: what was measured.
        pairs: indices of the pairs to compare, in this order; None takes all.
        within_s: seconds after which no further pair is taken; at least one is, and of large
            textures a window at random stands for each. None takes all of everything.
        progress: called with (per mille done, 1000).
        gains: whether errors are told once more with a gain for each pair and channel taken out,
            found on one half of its texels and scored on the other (`btfkit.gains.crossed`).
        lpips: a distance of pictures (`btfkit.lpips.LPIPS`) whose mean is told as `lpips`.

    Returns:
        mse, psnr, mse_log1p, psnr_log1p, mae, psnr_srgb (pooled over all texels), ssim_srgb and
        flip (means over pairs), mean_psnr (mean over pairs of each pair's own, but of
        `exact_pairs`, whose own is infinite; None where no other is left), pairs that were
        compared, of_pairs, masked; where windows were compared, `window`, its height and width;
        with `gains` all errors but mean_psnr once more, as `mse_gains` and so on.

    Raises:
        ValueError: channels differ, or nothing is measured.
    """
    if material.header.channels != btf.channels:
        raise ValueError(
            f"the model answers channels {material.header.channels}; the BTF has {btf.channels}"
        )
    chosen = np.arange(len(btf)) if pairs is None else np.asarray(pairs, np.intp)
    windows = _windows(btf, len(chosen)) if within_s is not None else None
    pictures = (
        _seen(material, btf, int(pair), None if windows is None else windows[k])
        for k, pair in enumerate(chosen)
    )
    found = _errors_of(pictures, len(chosen), within_s, progress, gains=gains, lpips=lpips)
    if windows is not None:
        found["window"] = [_WINDOW if side > _WINDOW else side for side in btf.shape[1:3]]
    return found


def errors_of_pictures(answers: Iterable[NDArray[np.float32]], btf: BTF) -> dict[str, Any]:
    """The same of answers (h, w, c) that are given, one for every pair of a BTF."""
    truths = (btf.texture(pair) for pair in range(len(btf)))
    return _errors_of(zip(answers, truths, strict=True), len(btf), None, None)


def _windows(btf: BTF, count: int) -> list[Window] | None:
    """A window at random for each of `count` textures; None where textures are small."""
    if max(btf.shape[1:3]) <= _WINDOW:
        return None
    rng = np.random.default_rng(0)
    sides = btf.shape[1:3]
    starts = [rng.integers(max(side - _WINDOW, 0) + 1, size=count).tolist() for side in sides]
    return [
        (slice(row, row + _WINDOW), slice(col, col + _WINDOW))
        for row, col in zip(*starts, strict=True)
    ]


def _seen(material: Material, btf: BTF, pair: int, window: Window | None) -> Picture:
    """Answer and truth of a pair, or of a window of it."""
    truth = btf.texture(pair)
    return answer_pair(material, btf, pair, window), truth if window is None else truth[window]


def _errors_of(
    pictures: Iterable[Picture],
    count: int,
    within_s: float | None,
    progress: Callable[[int, int], None] | None,
    *,
    gains: bool = False,
    lpips: Callable[..., float] | None = None,
) -> dict[str, Any]:
    """Errors of answers against truths, of as many of `count` as there is time for."""
    pooled, pictured = metrics.Pooled(), metrics.Pictured(lpips)
    freed, freely = metrics.Pooled(), metrics.Pictured(lpips)
    own: list[float] = []
    start, done = time.perf_counter(), 0
    for answer, truth in pictures:
        pooled.add(answer, truth)
        pictured.add(answer, truth)
        if gains:
            with_gains = nuisance.crossed(answer, truth)
            freed.add(with_gains, truth)
            freely.add(with_gains, truth)
        measured = np.isfinite(truth)
        if measured.any():
            own.append(metrics.psnr(float(np.square(answer - truth)[measured].mean())))
        done += 1
        spent = time.perf_counter() - start
        share = done / count if within_s is None else max(done / count, min(spent / within_s, 1))
        if progress:
            progress(int(1000 * share), 1000)
        # Another pair takes about as long as those before.
        if within_s is not None and pooled.values and spent * (done + 1) / done > within_s:
            break
    finite = [value for value in own if math.isfinite(value)]
    apart = {**freed.errors(), **freely.errors()} if gains else {}
    return {
        **pooled.errors(),
        **pictured.errors(),
        "mean_psnr": float(np.mean(finite)) if finite else None,
        "exact_pairs": len(own) - len(finite),
        "pairs": done,
        "of_pairs": count,
        "masked": pooled.masked,
        **{f"{key}_gains": value for key, value in apart.items()},
    }


def errors_on_queries(material: Material, queries: QuerySet) -> dict[str, Any]:
    """Errors over rows that can be compared; the rest is masked and counted.

    Returns:
        mse, psnr, mse_log1p, psnr_log1p, mae, rows, masked; where footprints differ `levels`, the
        errors by level of detail; where opacity is known `iou`.

    Raises:
        ValueError: the queries have no answers, or no row can be compared.
    """
    if queries.rgb is None:
        raise ValueError("the query file has no answers (rgb) to compare with")
    valid = queries.valid()
    rows = queries.subset(valid)
    if not len(rows) or rows.rgb is None:
        raise ValueError(f"all {len(queries)} rows are masked (not finite, or seen from below)")
    footprint = 0.5 if rows.footprint is None else rows.footprint
    curvature = 0.0 if rows.curvature is None else rows.curvature
    answer = material.evaluate(rows.uv, rows.light, rows.view, footprint, curvature)
    return {**_errors_of_rows(*answer, rows), "masked": int((~valid).sum())}


def errors_on_answers(
    rgb: NDArray[np.float32], opacity: NDArray[np.float32] | None, queries: QuerySet
) -> dict[str, Any]:
    """The same of answers (b, c) and opacities (b,) that are given."""
    if queries.rgb is None or queries.rgb.shape != rgb.shape:
        expected = None if queries.rgb is None else queries.rgb.shape
        raise ValueError(f"answers of shape {rgb.shape}; expected {expected}")
    valid = queries.valid()
    cover = np.ones(len(rgb), np.float32) if opacity is None else opacity
    found = _errors_of_rows(rgb[valid], cover[valid], queries.subset(valid))
    return {**found, "masked": int((~valid).sum())}


def _errors_of_rows(
    rgb: NDArray[np.float32], opacity: NDArray[np.float32], rows: QuerySet
) -> dict[str, Any]:
    """Errors of answers to valid rows."""
    if rows.rgb is None:
        raise ValueError("the query file has no answers (rgb) to compare with")
    truth = rows.rgb if rows.opacity is None else np.where(rows.opacity[:, None] > 0, rows.rgb, 0)
    found: dict[str, Any] = {
        **_pooled(rgb, truth),
        "rows": len(rows),
    }
    if rows.footprint is not None and np.ptp(rows.footprint) > 0:
        level = level_of(rows.footprint)
        nearest = np.round(level).astype(int)
        found["levels"] = [
            {"level": int(n), **_pooled(rgb[nearest == n], truth[nearest == n])}
            for n in np.unique(nearest)
        ]
    if rows.opacity is not None:
        found["iou"] = metrics.iou(opacity, rows.opacity)
    return found


def _pooled(answer: NDArray[np.float32], truth: NDArray[np.float32]) -> dict[str, float]:
    pooled = metrics.Pooled()
    pooled.add(answer, truth)
    errors = pooled.errors()
    del errors["psnr_srgb"]
    return errors
