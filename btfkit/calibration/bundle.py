"""One adjustment of the whole rig: camera, axes, board, mirror spheres and lights at once.

A frame's pose is not free: it follows from the readings of the axes, so that sixteen views share
some thirty numbers. What the frames cannot tell is named and held where it was.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.optimize import least_squares

from btfkit.calibration.bundle_problem import Problem
from btfkit.calibration.geometry import Geometry
from btfkit.calibration.sightings import Sighting, SphereSighting
from btfkit.errors import CalibrationError

Floats = NDArray[np.float64]
__all__ = ["Adjustment", "Sighting", "SphereSighting", "adjust"]

# Of a direction in parameter space the frames must tell more than is assumed of it beforehand;
# of a slip, what is assumed is told.
_OBSERVED = 1.0 + 1e-6
_REJECT = 5.0
_HUBER = 3.0
# Frames whose board lies this far from where their readings put it contradict them, px.
_CONTRADICTION_PX = 3.0
_ROUNDS = 5
_REWEIGHED = 2


@final
@dataclass(frozen=True, eq=False)
class Adjustment:
    """The adjusted geometry and how well it is known.

    Attributes:
        geometry: the estimate.
        names: (p,) free parameters. covariance: (p, p) of them, in their units (px, rad, mm).
        condition: of the scaled Jacobian of the free parameters.
        held: parameters that the frames do not tell, held at their start.
        rms: residual of each kind of observation: corner, outline, highlight, px.
        view_rms: (v,) of the points that count in each sighting, px.
        rejected: observations left out.
        slips: (v, a) correction of each reading, radians or mm; 0 where none was allowed.
    """

    geometry: Geometry
    names: tuple[str, ...]
    covariance: Floats
    condition: float
    held: tuple[str, ...]
    rms: dict[str, float]
    view_rms: Floats
    rejected: int
    slips: Floats

    def sd(self, name: str) -> float:
        """Standard deviation of a free parameter."""
        at = self.names.index(name)
        return float(np.sqrt(self.covariance[at, at]))

    def to_json(self) -> dict[str, Any]:
        # Slips are of this run's frames, not of the rig.
        rig = [i for i, name in enumerate(self.names) if not name.startswith("slip.")]
        names = [self.names[i] for i in rig]
        return {
            **self.geometry.to_json(),
            "sd": {name: self.sd(name) for name in names},
            "covariance": {"names": names, "matrix": self.covariance[np.ix_(rig, rig)].tolist()},
            "condition": self.condition,
            "held": [name for name in self.held if not name.startswith("slip.")],
            "residuals_px": self.rms,
            "view_rms_px": self.view_rms.tolist(),
            "rejected": self.rejected,
        }


def adjust(
    start: Geometry,
    sightings: Sequence[Sighting],
    spheres: Sequence[SphereSighting] = (),
    *,
    slip_sd: Mapping[str, float] | None = None,
) -> Adjustment:
    """The geometry that fits all observations best.

    Args:
        start: nominal geometry; good to some degrees and per cent.
        sightings: known points of the board (or of the sample) in frames.
        spheres: outlines and highlights of mirror spheres in frames.
        slip_sd: how far axes stand from their readings, by name, radians or mm; others are
            trusted.

    Raises:
        CalibrationError: too few frames, or frames that contradict their readings.
    """
    if len(sightings) < 3:
        raise CalibrationError(
            f"{len(sightings)} frames show known points; at least 3 are needed",
            remedy="take more target frames",
        )
    problem = Problem(start, sightings, spheres, slip_sd=slip_sd or {})
    x = np.zeros(problem.parameters.size)
    use = np.ones(problem.count, bool)
    free = _observed(problem, x, use, np.ones(problem.parameters.size, bool))
    for turn in range(_ROUNDS):
        x = _minimum(problem, x, use, free, robust=turn == 0)
        residual, _ = problem.evaluate(x)
        if turn == 0:
            _refuse_contradiction(problem, residual)
        keep = _inliers(problem, residual)
        if turn < _REWEIGHED:
            problem.reweigh(residual, keep)
        still = _observed(problem, x, keep, free)
        settled = (keep == use).all() and (still == free).all() and turn > 0
        use, free = keep, still
        if settled:
            break
    return _outcome(problem, x, use, free)


def _minimum(
    problem: Problem, x: Floats, use: NDArray[np.bool_], free: NDArray[np.bool_], *, robust: bool
) -> Floats:
    """Parameters of the least squares, those that are not free left where they are."""
    rows, columns = np.flatnonzero(use), np.flatnonzero(free)

    def full(part: Floats) -> Floats:
        whole = x.copy()
        whole[columns] = part * problem.parameters.scale[columns]
        return whole

    def residual(part: Floats) -> Floats:
        return problem.evaluate(full(part))[0][rows]

    def slopes(part: Floats) -> Any:
        jacobian = problem.evaluate(full(part))[1][rows][:, columns].multiply(
            problem.parameters.scale[columns]
        )
        # Few columns are solved exactly; many, mostly of slips, sparsely.
        return jacobian.toarray() if len(columns) <= 600 else jacobian.tocsr()

    solved = least_squares(
        residual,
        x[columns] / problem.parameters.scale[columns],
        jac=slopes,
        loss="huber" if robust else "linear",
        f_scale=_HUBER,
        xtol=1e-12,
        ftol=1e-12,
        gtol=1e-12,
        max_nfev=100,
    )
    return full(solved.x)


def _observed(
    problem: Problem, x: Floats, use: NDArray[np.bool_], free: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Which of the free parameters the observations tell.

    Each direction along which the scaled problem is flat gives up one parameter: the one that
    has most part in it, those that are usually known beforehand (lens, board) first.
    """
    columns = np.flatnonzero(free)
    _, jacobian = problem.evaluate(x)
    told = np.flatnonzero(use[: problem.told])
    scaled = (jacobian[told][:, columns].multiply(problem.parameters.scale[columns])).toarray()
    _, values, across = np.linalg.svd(scaled, full_matrices=len(scaled) < len(columns))
    sizes = np.zeros(len(columns))
    sizes[: len(values)] = values
    flat = across[sizes < 1 / _OBSERVED]
    if len(flat) == 0:
        return free
    weighted = flat * problem.parameters.give_up[columns]
    _, _, order = linalg.qr(weighted, mode="economic", pivoting=True)
    still = free.copy()
    still[columns[order[: len(flat)]]] = False
    # What is left must be told by itself: giving up one may not have been enough.
    return _observed(problem, x, use, still) if still.any() else still


def _inliers(problem: Problem, residual: Floats) -> NDArray[np.bool_]:
    """Observations within the noise of their kind; both numbers of a pixel go together."""
    keep = np.ones(problem.count, bool)
    for kind in ("corner", "outline", "highlight"):
        rows = problem.rows(kind)
        if len(rows) == 0:
            continue
        width = problem.width(kind)
        size = np.abs(residual[rows]).reshape(-1, width).max(axis=1)
        sd = problem.sd_px(kind).reshape(-1, width).max(axis=1)
        # Never so tight as to reject what a hundredth of a pixel explains.
        spread = np.maximum(1.4826 * float(np.median(size)), 0.01 / sd)
        keep[rows] = np.repeat(size < _REJECT * spread, width)
    return keep


def _refuse_contradiction(problem: Problem, residual: Floats) -> None:
    rms = problem.by_sighting(residual, np.median)
    limit = max(_CONTRADICTION_PX, 10 * float(np.median(rms)))
    bad = np.flatnonzero(rms > limit)
    if bad.size:
        at = bad[np.argmax(rms[bad])]
        raise CalibrationError(
            f"frame {problem.names_of_sightings[at]}: its axes put the target {rms[at]:.1f} px "
            f"from where the image shows it; other frames agree to {np.median(rms):.2f} px",
            remedy="check the readings of this frame, or leave it out",
        )


def _outcome(
    problem: Problem, x: Floats, use: NDArray[np.bool_], free: NDArray[np.bool_]
) -> Adjustment:
    residual, jacobian = problem.evaluate(x)
    rows, columns = np.flatnonzero(use), np.flatnonzero(free)
    scale = problem.parameters.scale[columns]
    scaled = jacobian[rows][:, columns].multiply(scale).toarray()
    values = np.linalg.svd(scaled, compute_uv=False)
    condition = float(values[0] / values[-1])
    freedom = max(len(rows) - len(columns), 1)
    # Each kind of observation is as good as its residuals say, not as was expected of it.
    noise = np.ones(problem.count)
    rms = {}
    for kind in ("corner", "outline", "highlight"):
        of_kind = problem.rows(kind)
        of_kind = of_kind[use[of_kind]]
        if len(of_kind):
            missed = residual[of_kind] * problem.sd_px(kind)[use[problem.rows(kind)]]
            rms[kind] = float(np.sqrt((missed**2).mean() * problem.width(kind)))
            noise[of_kind] = np.sqrt((residual[of_kind] ** 2).mean() * len(rows) / freedom)
    _, values, across = np.linalg.svd(scaled / noise[rows][:, None], full_matrices=False)
    spread = (across.T / values) * scale[:, None]
    told = free.copy()
    return Adjustment(
        geometry=problem.parameters.geometry(x),
        names=tuple(problem.parameters.names[i] for i in columns),
        covariance=spread @ spread.T,
        condition=condition,
        held=tuple(problem.parameters.names[i] for i in np.flatnonzero(~told)),
        rms=rms,
        view_rms=problem.by_sighting(
            np.where(use, residual, np.nan),
            lambda e: np.sqrt(np.nanmean(e**2)) if np.isfinite(e).any() else np.inf,
        ),
        rejected=int((~use).sum()),
        slips=problem.parameters.slips(x),
    )
