"""Heights from parallax: those that a `neumip` finds in pictures, and those that views agree on.

The model finds the relief from nothing; the views then say to a fraction of a texel where their
pictures of one light agree best (a sweep through heights).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, zoom

from btfkit.btf import BTF
from btfkit.errors import FitError
from btfkit.materials.base import Material
from btfkit.native.lobe import shaded
from btfkit.relief.photometric import Normals
from btfkit.relief.stack import Stack, slopes, visibility

Array = NDArray[np.float32]
Floats = NDArray[Any]

# Deviation of the Gaussian over which the views' disagreement is added up, texels.
_WINDOW = 0.6
# Heights looked at on either side, in steps.
_LOOKS = (-2.0, -1.0, 0.0, 1.0, 2.0)
# Systematic errors (resampled pictures, slopes within the window) are this many times the noise.
_SYSTEMATIC = 3.0
_MOST_VALUES = 1 << 22


@final
@dataclass(frozen=True, eq=False)
class Sweep:
    """Where views agree.

    Attributes:
        height: (h, w) texels. variance: (h, w) of it; infinite where no views met.
        disagreement: (h, w) variance between views at that height, over the mean square value.
    """

    height: Array
    variance: Array
    disagreement: Array


def fitted_heights(
    btf: BTF,
    *,
    budget_s: float = 20.0,
    steps: int | None = None,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Array:
    """(h, w) heights in texels that a `neumip` finds within some seconds, or steps, of training.

    Raises:
        FitError: no usable data.
    """
    from btfkit.fitting.fit import fit

    settings = {"levels": "1", "precision": "float32"}
    report = fit(
        btf, model="neumip", budget_s=budget_s, steps=steps, holdout=0.0, seed=seed, device="cpu",
        settings=settings, progress=progress,
    )  # fmt: skip
    return heights_of(report.material)


def heights_of(material: Material) -> Array:
    """(h, w) heights in texels of the grid that a model's view rays end on.

    Raises:
        FitError: the model has no texture of heights.
    """
    stored = material.weights.get("texture.heights")
    if stored is None:
        raise FitError(
            f"this {material.model} has no texture of heights",
            remedy="heights are in a neumip fitted with its defaults (depth=heights): "
            "btfkit fit SOURCE --model neumip",
        )
    scale = float(getattr(material.spec, "depth_scale"))  # noqa: B009
    h, w = material.header.grid
    heights = np.asarray(stored, np.float32)[..., 0] * scale * w
    if heights.shape == (h, w):
        return heights
    factors = h / heights.shape[0], w / heights.shape[1]
    mode = "grid-wrap" if material.header.wrap == "wrap" else "nearest"
    return zoom(heights, factors, order=1, mode=mode, grid_mode=True).astype(np.float32)


def reached(height: Array, towards: Array, *, wrap: bool) -> Array:
    """(h, w) share of directions that reach the surface; heights that few reach are guesses."""
    return visibility(height, towards, wrap=wrap).mean(axis=0).astype(np.float32)


def sweep(stack: Stack, height: Array, normals: Normals | None, *, step: float) -> Sweep:
    """Heights at which the views' pictures of each light agree best, near given ones.

    Of each light, the values that views see of a point are taken as a multiple, its own for each
    light, of what the fitted reflectance answers: 1 in the light, 0 in shadow. What is left over
    is the disagreement.

    Args:
        stack: of several views. height: (h, w) to begin with, texels.
        normals: fitted there; None takes points to look the same from everywhere.
        step: between two looked at, texels.
    """
    looks = np.array(_LOOKS) * step
    seen = visibility(height, stack.views, wrap=stack.wrap)
    sums = [_disagreement(stack, height, look, seen, normals) for look in looks]
    mode = "wrap" if stack.wrap else "nearest"
    costs = np.stack([gaussian_filter(left, _WINDOW, mode=mode) for left, _, _ in sums])
    counts = gaussian_filter(sums[2][1], _WINDOW, mode=mode)
    best = np.clip(costs.argmin(axis=0), 1, len(looks) - 2)

    def at(k: int) -> Floats:
        return np.take_along_axis(costs, (best + k)[None], axis=0)[0]

    low, middle, high = at(-1), at(0), at(1)
    bend = np.maximum(low - 2 * middle + high, 1e-12)
    shift = np.clip((low - high) / (2 * bend), -1, 1)
    lowest = np.maximum(middle - bend * shift**2 / 2, 0)
    second = bend / step**2
    noise = lowest / np.maximum(counts, 1)
    variance = np.where(counts > 4, 2 * noise / second, np.inf)
    # The views of a window are not independent of each other, nor is every error noise.
    variance = _SYSTEMATIC**2 * variance + np.square(0.25 * step)
    # The best look at an end says only that it lies further.
    ends = (costs.argmin(axis=0) == 0) | (costs.argmin(axis=0) == len(looks) - 1)
    variance = np.where(ends, 4 * variance + step**2, variance)
    bright = gaussian_filter(sums[2][2], _WINDOW, mode=mode)
    found = height + looks[best] + shift * step
    return Sweep(
        found.astype(np.float32), variance.astype(np.float32),
        (lowest / np.maximum(bright, 1e-12)).astype(np.float32),
    )  # fmt: skip


def disagreement(stack: Stack, height: Array, normals: Normals | None = None) -> float:
    """Variance between the views of each light, as a part of the mean square value.

    With `height` 0 it is that before parallax is corrected. Without normals the reflectance is
    taken to look the same from everywhere.
    """
    seen = visibility(height, stack.views, wrap=stack.wrap)
    left, _, bright = _disagreement(stack, height, 0.0, seen, normals)
    return float(left.sum() / max(float(bright.sum()), 1e-12))


def _disagreement(
    stack: Stack, height: Array, look: float, seen: NDArray[np.bool_], normals: Normals | None
) -> tuple[Floats, Floats, Floats]:
    """(h, w) squares left over, degrees of freedom, and squares in all, a texel."""
    h, w = stack.size
    grey = stack.grey
    slope = slopes(height, wrap=stack.wrap) if normals is None else normals.slope
    parts = []
    for rows in _blocks(h, w, len(stack.pairs)):
        values = stack.seen(grey, height + np.float32(look), rows)[..., 0]
        model = _expected(stack, normals, rows)
        use = seen[:, rows].reshape(len(seen), -1).T[:, stack.view_of] & np.isfinite(values)
        values = np.where(use, values, 0)
        model = np.where(use, model, 0)
        weight = use * stack.shown(slope[rows].reshape(-1, 2))
        parts.append(_by_light(stack, values, model, weight))
    return tuple(np.concatenate(column).reshape(h, w) for column in zip(*parts, strict=True))  # type: ignore[return-value]


def _by_light(
    stack: Stack, values: Array, model: Array, weight: Array
) -> tuple[Floats, Floats, Floats]:
    """(t,) sums over lights: what no multiple of the model explains, freedom, squares."""
    lights = np.eye(len(stack.lights), dtype=np.float32)[stack.light_of]
    heavy = weight * values
    vm, mm, vv = (part @ lights for part in (heavy * model, weight * model * model, heavy * values))
    # Weighted views count as so many equal ones.
    views = np.square(weight @ lights) / np.maximum(np.square(weight) @ lights, 1e-12)
    several = (weight > 0).astype(np.float32) @ lights > 1
    left = np.where(several, vv - np.square(vm) / np.maximum(mm, 1e-9), 0)
    return (
        np.maximum(left, 0).sum(axis=1),
        np.where(several, np.maximum(views - 1, 0), 0).sum(axis=1),
        np.where(several, vv, 0).sum(axis=1),
    )


def _expected(stack: Stack, normals: Normals | None, rows: slice) -> Array:
    """(t, n) what the fitted reflectance answers without shadows, at least a little."""
    w = stack.size[1]
    t = (rows.stop - rows.start) * w
    if normals is None:
        return np.ones((t, len(stack.pairs)), np.float32)
    answer = shaded(normals.lobes(rows), stack.light, stack.view)[..., 0]
    return np.maximum(answer, 1e-3 * answer.mean(axis=1, keepdims=True) + 1e-6)


def _blocks(h: int, w: int, n: int) -> Iterator[slice]:
    step = max(_MOST_VALUES // (w * n), 1)
    for first in range(0, h, step):
        yield slice(first, min(first + step, h))
