"""The relief that a BTF implies: photometric stereo, parallax, and both in one.

Flat samples and data of one view skip parallax and fusion; the figures say so.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import BTF, Wrap
from btfkit.fitting.analytic import Maps, fit_maps
from btfkit.fitting.heightfield import orientation
from btfkit.fitting.heightfield.alone import SWEEPS, by_light, surface
from btfkit.fitting.heightfield.bounds import Bounds, shadow_bounds
from btfkit.fitting.heightfield.fusion import Fused, fuse
from btfkit.fitting.heightfield.parallax import Sweep, disagreement, fitted_heights, sweep
from btfkit.fitting.heightfield.units import as_reflectance
from btfkit.heldout import split
from btfkit.relief.photometric import (
    Normals,
    check_lights,
    photometric_stereo,
)
from btfkit.relief.relief import Relief
from btfkit.relief.stack import Stack, read_stack, visibility
from btfkit.textures import as_textures

Array = NDArray[np.float32]
Progress = Callable[[int, int], None]

# Height error at which confidence is a half, texels.
_HALF_HEIGHT = 0.25
_MOST_HELD = 12
# Standard deviation of heights of a flat sample, texels.
_FLAT_HEIGHT = 0.1
# Errors of heights by what views disagree: fitted to three traced materials, docs/heightfields.md.
_LEAST_ERROR, _BY_DISAGREEMENT = 0.03, 10.0


@final
@dataclass(frozen=True, eq=False)
class Found:
    """A relief and how it was found.

    Attributes:
        relief: with fitted reflectance maps; heights in tile widths.
        normals: of photometric stereo.
        heights: (h, w) of each source in texels: "normals", "parallax", "fusion".
        deviation: (h, w) expected error of the heights, texels; of normals alone NaN.
        lights, views: (k, 3) distinct directions of what was read.
        lit, seen: (h, w) shares of them that reach the surface.
        maps: the reflectance. held: pairs of the BTF that nothing was fitted to.
        figures: what the report states, JSON types.
    """

    relief: Relief
    normals: Normals
    heights: Mapping[str, Array]
    deviation: Array
    lights: Array
    views: Array
    lit: Array
    seen: Array
    maps: Maps
    held: NDArray[np.intp]
    figures: Mapping[str, Any] = field(default_factory=dict)


def find_relief(
    btf: BTF,
    *,
    budget_s: float = 20.0,
    start: Array | None = None,
    bounded: bool = True,
    holdout: float = 0.05,
    seed: int = 0,
    progress: Progress | None = None,
) -> Found:
    """The relief of a BTF.

    Of a BTF that cannot be reflectance (relative counts a second) values are divided by a power of
    two first, the figure "unit": what 1 of the relief's reflectance stands for.

    Args:
        btf: what was measured.
        budget_s: wall time for the heights that parallax begins with; the rest takes what it takes.
        start: (h, w) heights in texels that a model already found; None fits one.
        bounded: whether shadows bound heights from the side.
        holdout: share of the pairs that nothing is fitted to; at most a dozen are kept.
        seed: of all randomness.
        progress: called with (done, total).

    Raises:
        FitError: lights that leave slopes open, directions of the wrong hand, no usable data.
    """
    began, cpu = time.perf_counter(), time.process_time()
    train, held = _split(len(btf), holdout, seed)
    btf, unit = as_reflectance(btf.subset(train))
    stack, solved = find_heights(
        btf, budget_s=budget_s, start=start, bounded=bounded, seed=seed, progress=progress
    )
    height = solved.heights[solved.best]
    lit, seen = (visibility(height, d, wrap=stack.wrap) for d in (stack.lights, stack.views))
    sure = np.isfinite(solved.deviation)
    confidence = np.where(
        sure,
        1 / (1 + np.square(np.where(sure, solved.deviation, 0) / _HALF_HEIGHT)),
        solved.normals.confidence,
    )
    shape = bare(height, wrap=btf.wrap)
    maps = fit_maps(
        btf, normals=shape.normals(), heights=shape.height, stack=stack, seen=(lit, seen),
        progress=progress,
    )  # fmt: skip
    relief = maps.relief(
        shape.height, wrap=btf.wrap, texel_mm=btf.texel_mm, channels=btf.channels,
        confidence=confidence.astype(np.float32), name="heightfield",
        provenance={
            "found": "heightfield", "data": dict(btf.provenance), "licence": btf.licence,
            **({} if unit == 1 else {"unit": unit}),
        },
    )  # fmt: skip
    figures = {
        "source": solved.best,
        "skipped": solved.why,
        "pairs": len(stack.pairs),
        "lights": len(stack.lights),
        "views": len(stack.views),
        "texels": list(stack.size),
        "curl": solved.curl,
        "shadowed": float(1 - lit.mean()),
        "hidden": float(1 - seen.mean()),
        "saturated": stack.saturated / (math.prod(stack.size) * len(stack.pairs)),
        "unmeasured": stack.unmeasured / (math.prod(stack.size) * len(stack.pairs)),
        "unexplained": float(1 - np.mean(solved.normals.kept)),
        "range_texels": float(np.ptp(height)),
        "offset_texels": float(height.mean()) if solved.why is None else 0.0,
        "clipped_albedo": maps.clipped,
        "unit": unit,
        **solved.figures,
        "seconds": time.perf_counter() - began,
        "cpu_seconds": time.process_time() - cpu,
    }
    return Found(
        relief, solved.normals, solved.heights, solved.deviation, stack.lights, stack.views,
        _share(lit), _share(seen), maps, held, figures,
    )  # fmt: skip


def _share(reached: NDArray[np.bool_]) -> Array:
    """(h, w) share of directions (n, h, w) that reach the surface; few make a guess of it."""
    return reached.mean(axis=0).astype(np.float32)


@final
@dataclass(frozen=True, eq=False)
class Solved:
    """Heights of each source, before reflectance is fitted to them.

    Attributes: as of `Found`, and
        best: the source that heights are taken from. curl: of the slopes, 1/texel.
        why: why parallax and fusion were left out; None where they were not.
    """

    normals: Normals
    heights: Mapping[str, Array]
    best: str
    deviation: Array
    curl: float
    figures: Mapping[str, Any] = field(default_factory=dict)
    why: str | None = None


def find_heights(
    btf: BTF,
    *,
    budget_s: float = 20.0,
    steps: int | None = None,
    limit_s: float | None = None,
    start: Array | None = None,
    bounded: bool = True,
    seed: int = 0,
    progress: Progress | None = None,
) -> tuple[Stack, Solved]:
    """What was read of a BTF, and heights from it; arguments and errors as of `find_relief`.

    Args:
        steps: of the model that parallax begins with, in place of `budget_s`.
        limit_s: wall time after which no round begins but the first.
    """
    began = time.perf_counter()
    stack = read_stack(btf, progress=progress)
    check_lights(stack)
    why = _no_parallax(btf, stack)
    if why is not None:
        return stack, replace(_from_normals(stack), why=why)
    few, many = stack.for_normals(), stack.for_parallax()
    first = photometric_stereo(few)
    turn = orientation.check_lights(first, wrap=stack.wrap)
    orientation.check_shadows(few, first, surface(first, wrap=few.wrap).height)
    orientation.check_views(many, first)
    height = start
    if height is None:
        height = fitted_heights(
            of_stack(btf, stack), budget_s=budget_s, steps=steps, seed=seed, progress=progress
        )
    ends = None if limit_s is None else began + limit_s
    return stack, _in_rounds(few, many, height, turn, bounded=bounded, seed=seed, ends=ends)


def _split(count: int, holdout: float, seed: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    # Few pairs are all needed.
    if count < 16 or not holdout:
        return np.arange(count), np.arange(0)
    return split(count, min(holdout, _MOST_HELD / count), seed)


def _no_parallax(btf: BTF, stack: Stack) -> str | None:
    """Why parallax says nothing here; None where it does."""
    from btfkit.fitting.choice import FLAT_TEXELS, moving

    if len(stack.views) == 1:
        return "parallax and fusion: there is one view, nothing moves; heights have no offset"
    views = stack.for_parallax()
    if len(views.views) < 3 or len(views.pairs) <= len(views.lights):
        return "parallax and fusion: no light is shared by several views"
    moved = moving(btf)
    if moved is not None and moved < FLAT_TEXELS and _is_flat(stack):
        return f"parallax and fusion: the structure moves by less than {FLAT_TEXELS} texels"
    return None


def _is_flat(stack: Stack) -> bool:
    """Whether slopes say so too: structure that repeats hides its own movement."""
    normals = photometric_stereo(stack.for_normals())
    return float(surface(normals, wrap=stack.wrap).height.std()) < _FLAT_HEIGHT


def _from_normals(stack: Stack) -> Solved:
    """Heights from slopes alone, solved again with the relief's own shadows."""
    few = stack.for_normals()
    first = photometric_stereo(few)
    turn = orientation.check_lights(first, wrap=stack.wrap)
    plain = surface(first, wrap=few.wrap)
    orientation.check_shadows(few, first, plain.height)
    normals, whole = by_light(few, (first, plain))
    nothing = np.full(stack.size, np.nan, np.float32)
    figures = {"integration_residual": whole.residual}
    return Solved(normals, {"normals": whole.height}, "normals", nothing, turn, figures)


def _in_rounds(
    few: Stack,
    many: Stack,
    height: Array,
    turn: float,
    *,
    bounded: bool,
    seed: int,
    ends: float | None,
) -> Solved:
    """Normals, sweep and fusion again and again, from heights that a model found."""
    before = disagreement(many, np.zeros_like(height))
    heights = {"model": height}
    found: tuple[Normals, Sweep, Fused, Bounds | None] | None = None
    done, longest = 0, 0.0
    for step in SWEEPS:
        now = time.perf_counter()
        if found is not None and ends is not None and now + longest > ends:
            break
        last = None if found is None else found[0]
        found = _round(few, many, height, step, last, bounded=bounded, seed=seed)
        height = found[2].height
        done, longest = done + 1, max(longest, time.perf_counter() - now)
    assert found is not None
    normals, swept, fused, bounds = found
    alone = surface(normals, wrap=few.wrap).height
    heights |= {"normals": alone + height.mean() - alone.mean(), "parallax": swept.height}
    heights["fusion"] = height
    figures = {
        "disagreement_flat": before,
        "disagreement": disagreement(many, height),
        "agreement_texels": {
            f"{a} - {b}": float(np.sqrt(np.median(np.square(heights[a] - heights[b]))))
            for a, b in (("normals", "parallax"), ("normals", "fusion"), ("parallax", "fusion"))
        },
        "shadows": None if bounds is None else bounds.kept_by(height),
        "expected_error_texels": float(np.median(_expected_error(fused, swept))),
        "rounds": done,
        "rounds_planned": len(SWEEPS),
        "cut": done < len(SWEEPS),
    }
    return Solved(normals, heights, "fusion", _expected_error(fused, swept), turn, figures)


def _round(
    few: Stack,
    many: Stack,
    height: Array,
    step: float,
    before: Normals | None,
    *,
    bounded: bool,
    seed: int,
) -> tuple[Normals, Sweep, Fused, Bounds | None]:
    """Normals, sweep, fusion and bounds around heights, with the relief's own visibility."""
    lit, looked = (visibility(height, d, wrap=few.wrap) for d in (few.lights, few.views))
    visible = lit[few.light_of] & looked[few.view_of]
    normals = photometric_stereo(few, height=height, visible=visible, start=before)
    swept = sweep(many, height, normals, step=step)
    bounds = shadow_bounds(few, height, normals) if bounded else None
    fused = fuse(
        normals.slope, normals.variance[..., [0, 2]], swept.height,
        # What views disagree about, seams above all, must not lift what they agree on.
        swept.variance + np.square(_BY_DISAGREEMENT * swept.disagreement),
        wrap=few.wrap, bounds=bounds, seed=seed,
    )  # fmt: skip
    return normals, swept, fused, bounds


def _expected_error(fused: Fused, swept: Sweep) -> Array:
    """(h, w) texels: noise, and what grows with the views' disagreement: hidden parts, seams."""
    systematic = _LEAST_ERROR**2 + np.square(_BY_DISAGREEMENT * swept.disagreement)
    return np.sqrt(np.square(fused.deviation) + systematic).astype(np.float32)


def of_stack(btf: BTF, stack: Stack) -> BTF:
    """The pairs of a stack, from memory where they lie there."""
    if isinstance(stack.values, np.memmap):
        return btf.subset(stack.pairs)
    textures = as_textures(np.ascontiguousarray(stack.values.transpose(2, 0, 1, 3)))
    return replace(btf.subset(stack.pairs), textures=textures, validity=None, variance=None)


def bare(height: Array, *, wrap: Wrap) -> Relief:
    """The relief of heights (h, w) in texels, black."""
    h, w = height.shape
    black, rough = np.zeros((h, w, 3), np.float32), np.ones((h, w), np.float32)
    return Relief(height / np.float32(w), black, black, rough, wrap=wrap)
