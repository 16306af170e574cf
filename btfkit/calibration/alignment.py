"""By how much each view of a sequence shows the sample displaced, told by the textures themselves.

A calibrated rig is off by less than a texel, and textures of two views differ by more than a
shift; so each view is asked within the calibration's own error, and believed as far as its
lights agree.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.calibration.registration import Shift, period_of, register
from btfkit.errors import CalibrationError

Floats = NDArray[np.float64]
# Lights that a view is compared under.
_LIGHTS = 3
# The bound in expected errors of the calibration, and in periods; and its least, texels.
_BOUND, _PERIODS, _LEAST = 5.0, 0.45, 0.1
# Two textures are compared under lights that are less apart than this.
_SAME_LIGHT_DEG = 15.0


@final
@dataclass(frozen=True)
class Aligned:
    """One view against the squarest one.

    Attributes:
        pairs: of the view. rows, columns: the shift that is applied, texels.
        sd: of what was found, texels. why: why nothing is applied; empty where something is.
    """

    pairs: tuple[int, ...]
    rows: float = 0.0
    columns: float = 0.0
    sd: float = 0.0
    why: str = ""


def align(
    texture: Callable[[int], NDArray[np.float32]],
    views: Sequence[Sequence[int]],
    light: NDArray[np.floating],
    view: NDArray[np.floating],
    *,
    error: float | None,
) -> list[Aligned]:
    """The shift of each view, of what the calibration leaves.

    Args:
        texture: (h, w) of a pair, NaN where not seen.
        views: pairs of each view.
        light, view: (n, 3) unit vectors of the pairs.
        error: standard deviation of places that is expected of the geometry, texels, of a view
            from above; None where nothing is known of it.

    Returns:
        One a view, in their order; the squarest is not moved.
    """
    tops = [float(view[pairs[0], 2]) for pairs in views]
    first = int(np.argmax(tops))
    period: float | None = None
    kept: dict[int, NDArray[np.float32]] = {}

    def of(pair: int) -> NDArray[np.float32]:
        if pair not in kept:
            kept[pair] = texture(pair)
        return kept[pair]

    out = []
    for number, pairs in enumerate(views):
        members = tuple(int(pair) for pair in pairs)
        if number == first:
            out.append(Aligned(members))
            continue
        for pair in [p for p in kept if p not in views[first]]:
            del kept[pair]
        partners = _partners(members, views[first], light)
        if not partners:
            out.append(Aligned(members, why="no light in common with the squarest view"))
            continue
        if period is None:
            period = period_of(np.asarray(of(partners[0][0]), float)) or np.inf
        spread = None if error is None else error / max(tops[number], 0.1)
        bound = _bound(of(members[0]).shape, period, spread)
        out.append(_aligned(members, partners, of, bound, spread or bound / 2))
    return out


def report(found: Sequence[Aligned], texel_mm: float) -> dict[str, Any]:
    """What was found, as JSON's own types."""
    moved = [a for a in found if not a.why]
    size = [float(np.hypot(a.rows, a.columns)) for a in moved]
    return {
        "views": len(found),
        "untold": [{"pair": a.pairs[0], "why": a.why} for a in found if a.why],
        "largest_texels": max(size, default=0.0),
        "rms_texels": float(np.sqrt(np.mean(np.square(size)))) if size else 0.0,
        "texel_mm": texel_mm,
        "shifts": [
            {"pair": a.pairs[0], "rows": a.rows, "columns": a.columns, "sd": a.sd} for a in moved
        ],
    }


def _partners(
    members: Sequence[int], first: Sequence[int], light: NDArray[np.floating]
) -> list[tuple[int, int]]:
    """Pairs of the squarest view and of this one under lights as nearly the same as there are."""
    ours, theirs = np.asarray(members), np.asarray(first)
    cosine = light[theirs] @ light[ours].T
    order = np.argsort(-cosine, axis=None)
    used: set[int] = set()
    out: list[tuple[int, int]] = []
    for flat in order.tolist():
        a, b = divmod(flat, len(ours))
        if cosine[a, b] < np.cos(np.radians(_SAME_LIGHT_DEG)) or len(out) == _LIGHTS:
            break
        if b not in used:
            used.add(b)
            out.append((int(theirs[a]), int(ours[b])))
    return out


def _bound(shape: Sequence[int], period: float, error: float | None) -> float:
    bound = min(min(shape) / 8, _PERIODS * period)
    return bound if error is None else min(bound, max(_BOUND * error, _LEAST))


def _aligned(
    members: tuple[int, ...],
    partners: list[tuple[int, int]],
    of: Callable[[int], NDArray[np.float32]],
    bound: float,
    expected: float,
) -> Aligned:
    shifts: list[Shift] = []
    why = ""
    for first, second in partners:
        try:
            shifts.append(
                register(np.asarray(of(first), float), np.asarray(of(second), float), within=bound)
            )
        except CalibrationError as error:
            why = str(error)
    if not shifts:
        return Aligned(members, why=why)
    weight = np.array([1 / max(s.sd, 1e-6) ** 2 for s in shifts])
    at = np.array([[s.rows, s.columns] for s in shifts])
    mean = weight @ at / weight.sum()
    # What lights disagree by is no noise of the sensor: shadows move.
    apart = float(np.abs(at - mean).max()) if len(shifts) > 1 else expected
    sd = float(np.hypot(1 / np.sqrt(weight.sum()), apart))
    believed = mean * expected**2 / (expected**2 + sd**2)
    return Aligned(members, float(believed[0]), float(believed[1]), sd)
