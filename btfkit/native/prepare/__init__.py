"""What every query goes through before a model answers it, in one pass.

Directions are normalised, uv is reduced to one tile or clamped to it, and queries that a model
cannot answer are left out.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from btfkit import native

Array = NDArray[np.float32]
# Shorter vectors have no direction.
_SHORTEST = 1e-30


class Prepared(NamedTuple):
    """The m queries of b that are to be answered, one after the other.

    Attributes:
        uv: (m, 2) in 0..1. light, view: (m, 3) unit vectors.
        footprint, curvature: (m,), or (1,) where one holds for all.
        rows: (m,) which of the b they are; None where m = b.
        masked: of the b, how many are not finite or seen from below.
        blurred, curved: whether a query that is not masked has a footprint above 0.5, a curvature.
    """

    uv: Array
    light: Array
    view: Array
    footprint: Array
    curvature: Array
    rows: NDArray[np.int32] | None
    masked: int
    blurred: bool
    curved: bool


class Lights(NamedTuple):
    """Lights that all queries of a call share.

    Attributes:
        light: (k, 3) unit vectors of those that are to be answered. rows: (k,) which of the m.
        good: (m,) whether there is a direction at all.
    """

    light: Array
    rows: NDArray[np.intp]
    good: NDArray[np.bool_]


def prepare_lights(light: Array, *, below: bool) -> Lights:
    """Shared lights (m, 3) made ready; `below`: whether those below the horizon are answered."""
    unit, good = _unit(light)
    rows = np.flatnonzero(good if below else good & (unit[:, 2] > 0))
    return Lights(np.ascontiguousarray(unit[rows]), rows, good)


def prepare(
    uv: NDArray[Any],
    light: Array,
    view: Array,
    footprint: Array,
    curvature: Array,
    opacity: Array,
    *,
    wrap: bool,
    below: bool,
) -> Prepared:
    """Queries made ready for a model.

    Args:
        uv: (b, 2) float32 or float64, in which it is reduced: huge places keep their texel.
        light, view: (b, 3) of any length. footprint, curvature: (b,).
            Each of the five may have one row that holds for all.
        opacity: (b,) set here to 0 where a query is masked, 1 elsewhere.
        wrap: whether uv is reduced to one tile, or clamped to it.
        below: whether lights below the horizon are to be answered.

    Every array is contiguous.
    """
    module = native.load("prepare")
    if module is None:
        return prepare_plain(uv, light, view, footprint, curvature, opacity, wrap=wrap, below=below)
    b = len(opacity)
    places, lights, views = (np.empty((b, k), np.float32) for k in (2, 3, 3))
    wide, bent = (
        np.empty(0 if len(part) == 1 else b, np.float32) for part in (footprint, curvature)
    )
    rows = np.empty(b, np.int32)
    call = module.prepare32 if uv.dtype == np.float32 else module.prepare64
    out = (places, lights, views, wide, bent, opacity, rows)
    m, good, blurred, curved = call(
        uv, light, view, footprint, curvature, wrap, below, *out, native.threads()
    )
    return Prepared(
        places[:m],
        lights[:m],
        views[:m],
        np.maximum(footprint, 0) if len(footprint) == 1 else wide[:m],
        curvature if len(curvature) == 1 else bent[:m],
        None if m == b else rows[:m],
        b - good,
        blurred,
        curved,
    )


def prepare_plain(
    uv: NDArray[Any],
    light: Array,
    view: Array,
    footprint: Array,
    curvature: Array,
    opacity: Array,
    *,
    wrap: bool,
    below: bool,
) -> Prepared:
    """`prepare` in numpy."""
    b = len(opacity)
    light, lit = _unit(light)
    view, seen = _unit(view)
    finite = np.isfinite(uv).all(axis=1) & np.isfinite(footprint) & np.isfinite(curvature)
    good = np.broadcast_to(finite & lit & seen & (view[:, 2] >= 0), b)
    opacity[:] = good
    answered = np.broadcast_to(good if below else good & (light[:, 2] > 0), b)
    rows = np.flatnonzero(answered)

    def kept(part: NDArray[Any]) -> NDArray[Any]:
        return np.ascontiguousarray(np.broadcast_to(part, (b, *part.shape[1:]))[rows])

    with np.errstate(invalid="ignore"):
        place = uv - np.floor(uv) if wrap else np.clip(uv, 0, 1)
    return Prepared(
        kept(place.astype(np.float32)),
        kept(light),
        kept(view),
        np.maximum(footprint if len(footprint) == 1 else kept(footprint), 0),
        curvature if len(curvature) == 1 else kept(curvature),
        None if len(rows) == b else rows.astype(np.int32),
        b - int(good.sum()),
        bool((good & (footprint > 0.5)).any()),
        bool((good & (curvature != 0)).any()),
    )


def _unit(direction: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Unit vectors (b, 3) float32, and (b,) whether there was a direction to normalise."""
    length = np.linalg.norm(direction.astype(np.float64), axis=1)
    good = np.isfinite(length) & (length > _SHORTEST)
    unit = direction / np.where(good, length, 1.0)[:, None]
    return unit.astype(np.float32), good
