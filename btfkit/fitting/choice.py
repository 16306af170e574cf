"""`auto`: which model and which of its parts the data ask for, and why."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from btfkit import directions
from btfkit.btf import BTF
from btfkit.fitting.sbtf.holes import passed_under, seen_through
from btfkit.queries import QuerySet

# Fewer pairs say little about gloss; fewer than the second are told apart by their neighbours.
_FEW, _SPARSE = 8, 24
# A structure that moves by less, in texels for each unit of tan(view), is flat.
FLAT_TEXELS = 0.02
_BLOCK, _SIGMA = 8, 0.7
_MOST_VIEWS, _LIGHTS_A_VIEW = 16, 3
# Share of rays that pass under something solid, from which on it is no height field's doing.
_UNDER = 0.02
# What a part that is left out would have bought: docs/benchmarks.md, skips; docs/neumip.md.
_OFFSET = "heights would take a sixth of a query's time and buy nothing"
_LEVELS = "coarser ones would take a third more memory and serve wider footprints alone"


@final
@dataclass(frozen=True)
class Choice:
    """What `auto` takes.

    Attributes:
        model: its name. reasons: one sentence each, the model's own first.
        settings: of the parts that are needed or left out, as `--set` would say it.
    """

    model: str
    reasons: tuple[str, ...]
    settings: Mapping[str, str] = field(default_factory=dict)


def choose(source: BTF | QuerySet) -> Choice:
    """The model and the parts for a source; reads about a hundred textures at most."""
    return _for_queries(source) if isinstance(source, QuerySet) else _for_btf(source)


def _for_queries(queries: QuerySet) -> Choice:
    valid = queries.subset(queries.valid())
    bend = np.zeros(len(valid)) if valid.curvature is None else valid.curvature
    holes = seen_through(valid)
    if np.any(bend != 0) or holes:
        curved = "the queries have curvature, under which rays may pass the material"
        through = "rays pass on the plane, through holes that heights alone do not have"
        told = [curved] * bool(np.any(bend != 0)) + [through] * holes
        under = passed_under(valid) if holes else 0.0
        if under > _UNDER:
            told.append(
                f"{under:.0%} of the rays that pass leave where an upright ray is stopped, which "
                "no height field lets them: the one that explains most is taken"
            )
        return Choice("sbtf", tuple(f"sbtf: {reason}" for reason in told))
    reasons = ["neumip: queries have no images that could guide a texture"]
    settings = {}
    if valid.footprint is None or not np.any(valid.footprint > 0.5):
        settings["levels"] = "1"
        reasons.append(f"one level of detail: no query has a footprint above one texel; {_LEVELS}")
    if len(valid) and float(valid.view[:, 2].min()) > 0.999:
        settings["offset"] = "0"
        reasons.append(f"no offset stage: all views are frontal, nothing moves; {_OFFSET}")
    return Choice("neumip", tuple(reasons), settings)


def _for_btf(btf: BTF) -> Choice:
    n, h, w, _ = btf.shape
    lights, views = (directions.unique(d)[0] for d in (btf.light, btf.view))
    if not np.any(btf.light[:, 2] > 0):
        return Choice("lambert", ("lambert: no pair is lit from above the horizon",))
    if n < _FEW:
        return Choice("lambert", (f"lambert: {n} pairs say little about gloss",))
    if h * w == 1:
        return Choice("interpolation", ("interpolation: one texel is a BRDF table",))
    if n < _SPARSE:
        why = f"interpolation: {n} pairs are too few to learn from, and few enough to keep"
        return Choice("interpolation", (why,))
    reasons = [f"neumip: {len(lights)} lights and {len(views)} views of {w} x {h} texels"]
    settings = {"levels": "1"}
    reasons.append(f"one level of detail: a BTF has no footprints; {_LEVELS}; levels=N makes N")
    if len(views) == 1:
        settings["offset"] = "0"
        reasons.append(f"no offset stage: there is one view, nothing moves; {_OFFSET}")
        return Choice("neumip", tuple(reasons), settings)
    moved = moving(btf)
    if moved is not None and moved < FLAT_TEXELS:
        settings["offset"] = "0"
        reasons.append(
            f"no offset stage: the structure stays within {FLAT_TEXELS} texels in all views; "
            + _OFFSET
        )
    elif moved is None:
        reasons.append("offset stage: no two views share a light, so nothing says it is flat")
    else:
        reasons.append(f"offset stage: the structure moves by {moved:.2f} texels at 45 degrees")
    return Choice("neumip", tuple(reasons), settings)


def moving(btf: BTF) -> float | None:
    """How far structure repeatably moves between views, as a relief would make it.

    In blocks of texels an oblique image is explained as the frontal one under the same lights,
    shifted along the projected view by height x tan(view). The heights found from one half of
    the views count as far as the other half finds them too, so that gloss and noise, which move
    nothing, cancel.

    Returns:
        Standard deviation of the heights that both halves agree on, texels; None where no
        oblique view shares a light with the most frontal one.
    """
    lights, light = directions.unique(btf.light)
    views, view = directions.unique(btf.view)
    front = int(np.argmax(views[:, 2]))
    oblique = np.flatnonzero((views[:, 2] > 0.35) & (views[:, 2] < 0.9))
    rng = np.random.default_rng(0)
    bright = lights[:, 2] > 0.5
    halves = [(np.zeros(()), np.zeros(())) for _ in range(2)]
    used = 0
    for other in rng.permutation(oblique[oblique != front])[:_MOST_VIEWS]:
        pairs = _under_equal_lights(light, view, front, int(other), bright)
        if not len(pairs):
            continue
        chosen = pairs[rng.permutation(len(pairs))[:_LIGHTS_A_VIEW]]
        slope = views[other, :2] / views[other, 2] - views[front, :2] / views[front, 2]
        straight, aslant = (_mean_log(btf, chosen[:, k]) for k in range(2))
        weighted, weight = _heights(straight, aslant, slope)
        total = halves[used % 2]
        halves[used % 2] = (total[0] + weighted, total[1] + weight)
        used += 1
    if used < 2:
        return None
    heights = [weighted / np.maximum(weight, 1e-12) for weighted, weight in halves]
    weight = np.sqrt(halves[0][1] * halves[1][1])
    weight = weight / max(float(weight.sum()), 1e-12)
    first, second = (h - np.sum(weight * h) for h in heights)
    return float(np.sqrt(max(np.sum(weight * first * second), 0.0)))


def _under_equal_lights(
    light: NDArray[np.intp],
    view: NDArray[np.intp],
    front: int,
    other: int,
    bright: NDArray[np.bool_],
) -> NDArray[np.intp]:
    """(m, 2) pairs of two views that share a bright light."""
    ours, theirs = (np.flatnonzero((view == which) & bright[light]) for which in (front, other))
    _, first, second = np.intersect1d(light[ours], light[theirs], return_indices=True)
    return np.stack([ours[first], theirs[second]], axis=1)


def _mean_log(btf: BTF, pairs: NDArray[np.intp]) -> NDArray[np.float64]:
    """(h, w) smoothed logarithm of the grey images of some pairs, at most 512 x 512 of it."""
    total = np.zeros(1)
    for pair in pairs:
        image = np.nan_to_num(btf.texture(int(pair))[:512, :512], posinf=0, neginf=0)
        grey = np.maximum(image.mean(axis=-1, dtype=np.float64), 0)
        total = total + np.log(grey + 0.1 * grey.mean() + 1e-6)
    mode = "wrap" if btf.wrap == "wrap" else "nearest"
    return gaussian_filter(total / len(pairs), _SIGMA, mode=mode)


def _heights(
    front: NDArray[np.float64], oblique: NDArray[np.float64], slope: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Heights (blocks,) in texels times their weights, and the weights.

    oblique = gain (front - height x slope . gradient of front), by least squares in each block.
    """
    down, across = np.gradient(front) if min(front.shape) > 1 else (0 * front, 0 * front)
    # Rows run against y.
    moved = -(slope[0] * across - slope[1] * down)
    f, o, m = (_blocks(image) for image in (front, oblique, moved))
    ff, fm, mm = ((a * b).sum(axis=1) for a, b in ((f, f), (f, m), (m, m)))
    # A little stiffness: blocks without structure have no height.
    stiff = 1e-3 * (ff + mm) + 1e-12
    fo, mo = ((a * o).sum(axis=1) for a in (f, m))
    determinant = (ff + stiff) * (mm + stiff) - fm * fm
    gain = ((mm + stiff) * fo - fm * mo) / determinant
    product = ((ff + stiff) * mo - fm * fo) / determinant
    weight = np.square(np.maximum(gain, 0)) * mm
    height = np.clip(product / np.maximum(gain, 0.2), -4, 4)
    return weight * height, weight


def _blocks(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """(blocks, texels) of whole blocks of an image, each less its mean."""
    h, w = image.shape
    side_h, side_w = min(_BLOCK, h), min(_BLOCK, w)
    rows, cols = h // side_h, w // side_w
    cut = image[: rows * side_h, : cols * side_w].reshape(rows, side_h, cols, side_w)
    flat = cut.transpose(0, 2, 1, 3).reshape(rows * cols, -1)
    return flat - flat.mean(axis=1, keepdims=True)
