"""What merged frames read on patches of known place: located from the pose, not detected."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.calibration.merge import Merged
from btfkit.calibration.placement import Placement
from btfkit.errors import CalibrationError
from btfkit.sequence import Frame

Floats = NDArray[np.floating]
# The rim is blurred, and the pose is not exact.
_INNER = 0.6
_FEWEST = 12


@final
@dataclass(frozen=True, eq=False)
class Level:
    """What one patch reads.

    Attributes:
        mean, sd: (c,) radiance, counts a second, and deviation of the mean; NaN where a channel
            saturates on more than a tenth of the patch.
        pixels: (c,) how many count. spread: relative deviation between pixels.
    """

    mean: Floats
    sd: Floats
    pixels: NDArray[np.intp]
    spread: float


def mask_of(
    entry: Mapping[str, Any],
    frame: Frame,
    placement: Placement,
    shape: tuple[int, int],
    shift: Floats | None = None,
) -> NDArray[np.bool_]:
    """(h, w) pixels within the inner part of a patch.

    Args:
        entry: with "window" [row0, row1, col0, col1] in pixels, or "centre_mm" and "size_mm".
        frame: that shows it.
        placement: of the rig.
        shape: of the frame.
        shift: (2,) columns and rows by which the placement is off, or None.

    Raises:
        CalibrationError: neither, or out of the frame.
    """
    mask = np.zeros(shape, bool)
    name = entry.get("name", "the white reference")
    if "window" in entry:
        top, bottom, left, right = (int(x) for x in entry["window"])
        mask[max(top, 0) : bottom, max(left, 0) : right] = True
    elif placement.project is None or "centre_mm" not in entry:
        raise CalibrationError(
            f"{frame.file}: where {name} lies in the frame is not known",
            remedy='add "window": [row0, row1, col0, col1] to it in sequence.json, or rig and '
            "centre_mm",
        )
    else:
        corners = corners_mm(entry, share=_INNER)
        pixels = placement.project(corners, frame) + (0 if shift is None else shift)
        if np.any(pixels < -0.5) or np.any(pixels > np.array(shape[::-1]) - 0.5):
            middle = pixels.mean(axis=0)
            raise CalibrationError(
                f"{frame.file}: {name} is expected at column {middle[0]:.0f}, row {middle[1]:.0f}, "
                f"out of the frame of {shape[1]} x {shape[0]}",
                remedy="correct its place or the rig in sequence.json",
            )
        mask = _inside(pixels, shape)
    if mask.sum() < _FEWEST:
        raise CalibrationError(
            f"{frame.file}: {name} covers {int(mask.sum())} pixels; {_FEWEST} are needed",
            remedy="take the camera closer, or correct size_mm in sequence.json",
        )
    return mask


def corners_mm(entry: Mapping[str, Any], *, share: float = 1.0) -> Floats:
    """(4, 3) corners of a patch, or of the part of it about its centre."""
    x, y, z = (float(v) for v in entry["centre_mm"])
    w, h = (share * float(v) / 2 for v in entry["size_mm"])
    return np.array([[x - w, y - h, z], [x + w, y - h, z], [x + w, y + h, z], [x - w, y + h, z]])


def level_of(merged: Merged, mask: NDArray[np.bool_], colours: NDArray[np.intp] | None) -> Level:
    """Means over a patch, robust against dust.

    Args:
        merged: (h, w) mosaic or one colour, or (h, w, 3).
        mask: (h, w) the patch.
        colours: (h, w) channel of each pixel of a mosaic, None otherwise.
    """
    channels = 3 if colours is not None or merged.radiance.ndim == 3 else 1
    means, sds, counts, spreads = [], [], [], []
    for c in range(channels):
        if colours is not None:
            at = mask & (colours == c)
            values, variance = merged.radiance[at], merged.variance[at]
        else:
            values, variance = merged.radiance[mask], merged.variance[mask]
            if channels == 3:
                values, variance = values[:, c], variance[:, c]
        seen = np.isfinite(values)
        if seen.sum() < 0.9 * max(len(values), 1) or seen.sum() < 3:
            means.append(np.nan)
            sds.append(np.nan)
            counts.append(int(seen.sum()))
            continue
        values, variance = values[seen].astype(float), variance[seen].astype(float)
        middle = np.median(values)
        spread = max(1.4826 * float(np.median(np.abs(values - middle))), 1e-12)
        near = np.abs(values - middle) <= 4 * spread
        means.append(float(values[near].mean()))
        noise = float(np.sqrt(variance[near].mean() / near.sum()))
        sds.append(max(noise, float(values[near].std()) / np.sqrt(near.sum())))
        counts.append(int(near.sum()))
        spreads.append(float(values[near].std()) / abs(means[-1]) if means[-1] else 0.0)
    return Level(
        np.array(means), np.array(sds), np.array(counts), max(spreads) if spreads else float("nan")
    )


def _inside(corners: Floats, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """(h, w) pixels whose centres lie in a convex quadrangle (4, 2) of columns and rows."""
    rows, cols = np.mgrid[: shape[0], : shape[1]]
    sides = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        sides.append((b[0] - a[0]) * (rows - a[1]) - (b[1] - a[1]) * (cols - a[0]))
    signs = np.stack(sides)
    return np.asarray(np.all(signs >= 0, axis=0) | np.all(signs <= 0, axis=0))
