"""By how many pixels the nominal pose of a frame is off, told by patches that must be even.

What a rig's builder wrote down is off by a millimetre or two: more than the rim of a patch. The
shift that makes every patch even within itself is right for all of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit.calibration.merge import Merged
from btfkit.calibration.patches import corners_mm
from btfkit.calibration.placement import Placement
from btfkit.sequence import Frame

Floats = NDArray[np.floating]
# Of a patch that is looked at; and relative variances beyond which a patch is simply uneven.
_SHARE, _UNEVEN = 0.85, 0.05
_LIKELY = 1e-3


def shift_of(
    merged: Merged,
    entries: Sequence[Mapping[str, Any]],
    frame: Frame,
    placement: Placement,
    *,
    reach_mm: float,
) -> Floats:
    """(2,) columns and rows to add to where `placement` puts things in a frame.

    Args:
        merged: (h, w) or (h, w, 3) of the frame.
        entries: patches with centre_mm and size_mm; those out of the frame are left out.
        frame: that shows them. placement: nominal.
        reach_mm: how far off it may be.
    """
    if not np.isfinite(merged.radiance).any():
        return np.zeros(2)
    grey, noise = _evened(merged)
    h, w = grey.shape
    boxes, reach = [], 0
    for entry in entries:
        if placement.project is None or "centre_mm" not in entry:
            continue
        corners = placement.project(corners_mm(entry, share=_SHARE), frame)
        low, high = corners.min(axis=0), corners.max(axis=0)
        per_mm = float(np.min(high - low)) / (_SHARE * min(entry["size_mm"]))
        reach = max(reach, round(reach_mm * per_mm))
        boxes.append([*np.round(low), *np.round(high)])
    if not boxes or reach < 1:
        return np.zeros(2)
    box = np.array(boxes, int)
    inside = (box[:, :2] >= reach).all(1) & (box[:, 2:] < np.array([w, h]) - reach - 1).all(1)
    box = box[inside]
    if len(box) < 2:
        return np.zeros(2)
    cost = _uneven(grey, noise, box, reach)
    # Where several shifts do as well, the smallest is the likeliest.
    step = np.arange(-reach, reach + 1) / reach
    cost = cost + _LIKELY * (step[:, None] ** 2 + step**2)
    row, col = np.unravel_index(np.argmin(cost), cost.shape)
    return np.array([col - reach, row - reach], float)


def _uneven(grey: Floats, noise: Floats, box: NDArray[np.intp], reach: int) -> Floats:
    """(2 reach + 1, 2 reach + 1) mean relative variance in boxes (p, 4), for every shift.

    Noise does not count: it would draw dark patches to bright places.
    """
    planes = (grey, grey**2, noise)
    sums = [np.pad(plane.cumsum(0).cumsum(1), ((1, 0), (1, 0))) for plane in planes]
    step = np.arange(-reach, reach + 1)
    left, top, right, bottom = (box[:, i, None] + step for i in range(4))

    def inside(total: Floats) -> Floats:
        """(p, rows, cols) sums over the shifted boxes."""

        def at(rows: Any, cols: Any) -> Floats:
            return np.asarray(total[rows[:, :, None], cols[:, None, :]])

        return at(bottom + 1, right + 1) - at(top, right + 1) - at(bottom + 1, left) + at(top, left)

    area = (box[:, 2] - box[:, 0] + 1) * (box[:, 3] - box[:, 1] + 1)
    mean, square, expected = (inside(total) / area[:, None, None] for total in sums)
    relative = (square - mean**2 - expected) / np.maximum(mean**2, 1e-12)
    return np.asarray(np.clip(relative, 0, _UNEVEN).mean(axis=0))


def _evened(merged: Merged) -> tuple[Floats, Floats]:
    """(h, w) brightness without the mosaic, means of 2 x 2, and its variance; holes are filled
    with the median.
    """
    value, variance = merged.radiance, merged.variance
    if value.ndim == 3:
        value, variance = value.mean(axis=2), variance.mean(axis=2) / value.shape[2]
    seen = np.isfinite(value) & np.isfinite(variance)
    filled = np.where(seen, value, np.median(value[seen])).astype(float)
    return _quads(filled) / 4, _quads(np.where(seen, variance, 0).astype(float)) / 16


def _quads(plane: Floats) -> Floats:
    """(h, w) sums of each pixel, its right, its lower, and their common neighbour."""
    pair = plane + np.concatenate([plane[1:], plane[-1:]], axis=0)
    return np.asarray(pair + np.concatenate([pair[:, 1:], pair[:, -1:]], axis=1))
