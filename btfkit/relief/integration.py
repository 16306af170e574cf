"""Heights from slopes: robust, weighted least squares, held by heights that are known besides.

The equations lie between neighbouring texels: h[i+1] - h[i] is the integral of the slope from one
to the other. They are solved by conjugate gradients; the same equations with equal weights, which
a Fourier (tiles) or cosine transform (samples) solves at once, are the preconditioner.

Sources: Frankot and Chellappa 1988 (Fourier); Simchony et al. 1990 (cosine transform);
Queau et al., "Variational Methods for Normal Integration", 2018 (weights, robust errors).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from btfkit import native

Array = NDArray[np.float32]
Floats = NDArray[Any]

_ROUNDS, _STEPS, _TOLERANCE = 4, 300, 1e-6
# A residual so many times the usual one counts half: a step of the surface, not noise.
_HALF = 2.5
# Texels from which on a transform gains by threads.
_LARGE = 1 << 16
# An equation never loses all its weight: the parts of a surface hang together by something.
_LEAST = 1e-4


@final
@dataclass(frozen=True, eq=False)
class Integrated:
    """A surface and how well slopes fit it.

    Attributes:
        height: (h, w) texels; mean 0 where no height was given.
        residual: root mean square of what the equations leave, texels.
        curl: root mean square of the slopes' curl, which a surface does not have, 1/texel.
        steps: of the solver, in all.
    """

    height: Array
    residual: float
    curl: float
    steps: int


@final
@dataclass(frozen=True, eq=False)
class System:
    """Weighted equations of one surface: the slopes between texels, and heights at texels.

    Attributes:
        across, down: (h, w) differences to the next texel in a row, and in a column, texels.
        by_across, by_down: (h, w) their weights; 0 over the border of a sample.
        known: (h, w) heights. by_known: (h, w) their weights, 0 where unknown.
        wrap: whether the surface tiles.
    """

    across: Floats
    down: Floats
    by_across: Floats
    by_down: Floats
    known: Floats
    by_known: Floats
    wrap: bool

    def times(self, height: Floats) -> Floats:
        """The normal equations' matrix on a surface."""
        ax = self.by_across * (np.roll(height, -1, 1) - height)
        dn = self.by_down * (np.roll(height, -1, 0) - height)
        return np.roll(ax, 1, 1) - ax + np.roll(dn, 1, 0) - dn + self.by_known * height

    def right(self) -> Floats:
        """The normal equations' right side."""
        ax, dn = self.by_across * self.across, self.by_down * self.down
        return np.roll(ax, 1, 1) - ax + np.roll(dn, 1, 0) - dn + self.by_known * self.known

    def residuals(self, height: Floats) -> tuple[Floats, Floats]:
        """What a surface leaves of the slopes' equations, across and down."""
        return (
            np.roll(height, -1, 1) - height - self.across,
            np.roll(height, -1, 0) - height - self.down,
        )

    def solve(self, right: Floats, start: Floats) -> tuple[Floats, int]:
        """The surface of a right side, by preconditioned conjugate gradients; steps taken."""
        precondition = _preconditioner(self)
        x = start
        r = right - self.times(x)
        z = precondition(r)
        p, rz = z, float(np.vdot(r, z))
        limit = _TOLERANCE * max(float(np.linalg.norm(right)), 1e-300)
        step = 0
        while step < _STEPS and float(np.linalg.norm(r)) > limit:
            q = self.times(p)
            along = float(np.vdot(p, q))
            if along <= 0:
                break
            x = x + rz / along * p
            r = r - rz / along * q
            z = precondition(r)
            rz, before = float(np.vdot(r, z)), rz
            p = z + rz / before * p
            step += 1
        return x, step


def integrate(
    slope: Floats,
    weight: Floats | None = None,
    *,
    wrap: bool,
    known: Floats | None = None,
    by_known: Floats | None = None,
    robust: bool = True,
) -> Integrated:
    """The surface of slopes.

    Args:
        slope: (h, w, 2) dz/dx, dz/dy; y runs against the rows.
        weight: (h, w), or (h, w, 2) of each slope, of any scale; 0 masks. None is 1.
        wrap: whether the surface tiles.
        known: (h, w) heights, texels. by_known: (h, w) their weights in the same scale.
        robust: whether residuals that stand out, as at steps, lose weight.
    """
    system, steps = system_of(slope, weight, wrap=wrap, known=known, by_known=by_known), 0
    height = np.zeros(system.across.shape)
    solved = system
    for _ in range(_ROUNDS if robust else 1):
        height, taken = solved.solve(solved.right(), height)
        steps += taken
        solved = softened(system, height)
    if not system.by_known.any():
        height = height - height.mean()
    left = np.concatenate([r[w > 0] for r, w in _weighted(system, height)])
    residual = float(np.sqrt(np.square(left).mean())) if left.size else 0.0
    return Integrated(height.astype(np.float32), residual, curl(slope, wrap=wrap), steps)


def system_of(
    slope: Floats,
    weight: Floats | None = None,
    *,
    wrap: bool,
    known: Floats | None = None,
    by_known: Floats | None = None,
) -> System:
    """The equations of `integrate`."""
    h, w, _ = slope.shape
    ones = np.ones((h, w, 2))
    by = ones if weight is None else np.broadcast_to(
        weight[..., None] if weight.ndim == 2 else weight, (h, w, 2)
    )  # fmt: skip
    by = np.where(np.isfinite(slope) & np.isfinite(by), by, 0).astype(float)
    value = np.where(by > 0, slope, 0).astype(float)
    across, by_across = _between(value[..., 0], by[..., 0], 1, wrap)
    down, by_down = _between(-value[..., 1], by[..., 1], 0, wrap)
    zero = np.zeros((h, w))
    return System(
        across, down, by_across, by_down,
        zero if known is None else np.where(np.isfinite(known), known, 0).astype(float),
        zero if by_known is None or known is None
        else np.where(np.isfinite(known), by_known, 0).astype(float),
        wrap,
    )  # fmt: skip


def softened(system: System, height: Floats) -> System:
    """The same equations, those that a surface leaves unusually far open with less weight."""
    (rx, wx), (ry, wy) = _weighted(system, height)
    usual = np.median(np.abs(np.concatenate([rx[wx > 0], ry[wy > 0]]))) if wx.any() else 0.0
    half = max(_HALF * 1.4826 * float(usual), 1e-3)

    def soft(weight: Floats, residual: Floats) -> Floats:
        return weight * np.maximum(1 / (1 + np.square(residual / half)), _LEAST)

    return System(
        system.across, system.down, soft(wx, rx), soft(wy, ry),
        system.known, system.by_known, system.wrap,
    )  # fmt: skip


def curl(slope: Floats, *, wrap: bool) -> float:
    """Root mean square curl of slopes (h, w, 2) around squares of four texels, 1/texel."""
    p, q = slope[..., 0].astype(float), -slope[..., 1].astype(float)
    if min(p.shape) < 2:
        return 0.0
    upper, left = p + np.roll(p, -1, 1), q + np.roll(q, -1, 0)
    around = (upper + np.roll(left, -1, 1) - np.roll(upper, -1, 0) - left) / 2
    inner = around if wrap else around[:-1, :-1]
    known = inner[np.isfinite(inner)]
    return float(np.sqrt(np.square(known).mean())) if known.size else 0.0


def _weighted(system: System, height: Floats) -> tuple[tuple[Floats, Floats], ...]:
    rx, ry = system.residuals(height)
    return (rx, system.by_across), (ry, system.by_down)


def _between(value: Floats, weight: Floats, axis: int, wrap: bool) -> tuple[Floats, Floats]:
    """Integral of a slope from each texel to the next along an axis, and its weight.

    Of fourth order, (-1, 13, 13, -1) / 24, where all four slopes are known; else their mean.
    """
    if value.shape[axis] == 1:
        return np.zeros_like(value), np.zeros_like(value)
    v = [np.roll(value, -k, axis) for k in (-1, 0, 1, 2)]
    w = [np.roll(weight, -k, axis) for k in (-1, 0, 1, 2)]
    four = (w[0] > 0) & (w[3] > 0)
    last: tuple[slice | int, ...] = (slice(None),) * axis
    if not wrap:
        for at in (0, -2, -1):
            four[(*last, at)] = False
    found = np.where(four, (13 * (v[1] + v[2]) - v[0] - v[3]) / 24, (v[1] + v[2]) / 2)
    both = np.where((w[1] > 0) & (w[2] > 0), 2 * w[1] * w[2] / np.maximum(w[1] + w[2], 1e-300), 0)
    if not wrap:
        both[(*last, -1)] = 0
    # Masked texels hang on their neighbours as by a slack membrane.
    least = _LEAST * float(both.mean() if both.any() else 1.0)
    slack = np.maximum(both, least)
    if not wrap:
        slack[(*last, -1)] = 0
    return np.where(both > 0, found, 0), slack


def _preconditioner(system: System) -> Any:
    """Solves the equations of equal weights: what the weights are in the mean."""
    h, w = system.across.shape
    known = float(system.by_known.mean())
    mean = [float(part.mean()) for part in (system.by_across, system.by_down)]
    if system.wrap:
        kx, ky = np.arange(w // 2 + 1) / w, np.arange(h) / h
        lx, ly = (4 * np.square(np.sin(np.pi * k)) for k in (kx, ky))
    else:
        lx, ly = (4 * np.square(np.sin(np.pi * np.arange(n) / (2 * n))) for n in (w, h))
    values = mean[0] * lx + mean[1] * ly[:, None] + known
    inverse = np.where(values > 1e-12 * values.max(), 1 / np.maximum(values, 1e-300), 0)

    threads = native.threads() if h * w >= _LARGE else 1

    def apply(residual: Floats) -> Floats:
        with scipy.fft.set_workers(threads):
            if system.wrap:
                return scipy.fft.irfft2(scipy.fft.rfft2(residual) * inverse, s=(h, w))
            return scipy.fft.idctn(scipy.fft.dctn(residual, norm="ortho") * inverse, norm="ortho")

    return apply
