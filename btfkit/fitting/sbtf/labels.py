"""What a known relief tells of rays: where they end, and at which view they begin to pass."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from btfkit.queries import Query, QuerySet
from btfkit.relief.relief import Relief
from btfkit.relief.trace import geometry, silhouette, trace

Array = NDArray[np.float32]


class Labels(NamedTuple):
    """Of b queries; rows that are masked hold 0.

    Attributes:
        offset: (b, 2) from uv to the place that is seen, tiles, the shortest way where it tiles.
        cosine: (b,) of the view below which rays pass.
    """

    offset: Array
    cosine: Array


def labels_of(relief: Relief, queries: QuerySet) -> Labels:
    """Labels of queries on a relief under its surface, by the tracer and by bisection."""
    packed, count = geometry(relief), len(queries)
    h, w = relief.size
    bend = np.zeros(count, np.float32) if queries.curvature is None else queries.curvature
    query = Query(queries.uv, queries.light, queries.view, np.zeros(count, np.float32), bend)
    seen = trace(packed, query, samples=1)
    place = np.stack([(seen.column + 0.5) / w, (seen.row + 0.5) / h], axis=1)
    offset = place - queries.uv
    if relief.wrap == "wrap":
        offset -= np.round(offset)
    offset[seen.met == 0] = 0
    cosine = np.zeros(count, np.float32)
    # Under a concave surface, and on the plane, every ray is stopped.
    convex = np.flatnonzero(queries.valid() & (bend > 0))
    azimuth = np.arctan2(queries.view[convex, 1], queries.view[convex, 0])
    cosine[convex] = silhouette(packed, queries.uv[convex], azimuth, bend[convex])
    return Labels(offset.astype(np.float32), cosine)
