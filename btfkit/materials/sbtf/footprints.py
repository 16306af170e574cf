"""Soft outlines: what a footprint sees of rays that are stopped or pass."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from btfkit.materials.base import Array
from btfkit.queries import Query

# Rays of a footprint that may pass: an outline then has as many steps of grey.
RAYS = 12
# Tiles that a footprint is taken as at most: a wider one sees what this one does.
_WIDEST = 4.0
_GOLDEN = np.pi * (3 - np.sqrt(5))


def offsets(count: int = RAYS) -> NDArray[np.float64]:
    """(count, 2) places of a Gaussian kernel of standard deviation 1, of equal weights.

    They are the same for every query, so that nothing flickers where a footprint moves. On a
    spiral of rings that hold as much of the kernel each; their mean is 0 and their variance 1.
    """
    k = np.arange(count)
    radius = np.sqrt(-2 * np.log(1 - (k + 0.5) / count))
    place = np.stack([radius * np.cos(k * _GOLDEN), radius * np.sin(k * _GOLDEN)], axis=1)
    place -= place.mean(axis=0)
    return np.asarray(place @ np.linalg.inv(np.linalg.cholesky(np.cov(place.T, bias=True))).T)


def softened(
    query: Query,
    drift: Array | None,
    rows: NDArray[np.intp],
    grid: tuple[int, int],
    ask: Callable[[Query, Array | None], tuple[Array, Array]],
) -> tuple[Array, Array]:
    """Answers (..., b, c) and opacity (b,), of some rows as means over their footprints.

    Args:
        query: flat; its light (b, 3), or lights (m, 3) or (m, b, 3) that views share.
        drift: (b, 4) of its rays, or None.
        rows: of footprints, wider than that of a texel, that rays may pass in part.
        grid: (h, w) that footprints count in.
        ask: what a query with rays of no width answers, and their drift.
    """
    rgb, opacity = ask(query, drift)
    if not len(rows):
        return rgb, opacity
    shared = rgb.ndim == 3 and query.light.ndim == 2
    light = query.light if shared else query.light[..., rows, :]
    part = Query(
        query.uv[rows], np.ascontiguousarray(light), query.view[rows], query.footprint[rows],
        query.curvature[rows],
    )  # fmt: skip
    off = None if drift is None else np.ascontiguousarray(drift[rows])
    # What a texel's own footprint does not hold, as levels of textures are blurred.
    wide = np.minimum(part.footprint.astype(float), _WIDEST * max(grid))
    spread = np.sqrt(wide**2 - 0.25)[:, None] / np.array(grid[::-1])
    total, stopped = np.zeros((*rgb.shape[:-2], len(rows), rgb.shape[-1])), np.zeros(len(rows))
    for offset in offsets():
        moved = (part.uv + spread * offset).astype(part.uv.dtype)
        colour, solid = ask(part._replace(uv=moved), off)
        total += colour * solid[:, None]
        stopped += solid
    rgb, opacity = rgb.copy(), opacity.copy()
    rgb[..., rows, :] = total / np.maximum(stopped, 1e-9)[:, None]
    opacity[rows] = stopped / RAYS
    return rgb, opacity
