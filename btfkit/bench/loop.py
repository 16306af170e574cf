"""The whole loop on the twin: what a captured BTF is off from what its tracer knows as true."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit import io
from btfkit.devices.twin.truth import blurred, truth

Floats = NDArray[np.float64]
# Texels of the rim, whose footprints reach beyond the sample.
_RIM = 6


@final
@dataclass(frozen=True, eq=False)
class Looped:
    """Errors of n pairs of a run against the truth of its twin.

    Attributes:
        tilt: (n,) of the view, whole degrees.
        mse: (n,) mean square of log1p.
        seen: (n,) share of the texels that are known. scale: (n,) mean over the truth's mean.
        light, view: (n,) how far the directions at the middle are off, degrees.
    """

    tilt: NDArray[np.int64]
    mse: Floats
    seen: Floats
    scale: Floats
    light: Floats
    view: Floats

    def psnr(self, tilt: int | None = None) -> float:
        """dB of log1p, of one tilt or of all; tilts count alike."""
        tilts = sorted(set(self.tilt.tolist())) if tilt is None else [tilt]
        means = [self.mse[self.tilt == each].mean() for each in tilts]
        return float(-10 * np.log10(np.mean(means)))


def compare(run: Path) -> Looped:
    """A calibrated run of the twin against its truth, at two texels of the sample a texel.

    The truth is traced at the true positions of lamp and camera and blurred as the texture states.

    Raises:
        FileNotFoundError: the run was not made by the twin.
    """
    true = truth(run)
    if true.texel_mm is None:
        raise ValueError(f"{run}: the truth has no size")
    btf = io.open(run, texel_mm=2 * true.texel_mm)
    if btf.blurs is None:
        raise TypeError(f"{run} is no sequence")
    inner = slice(_RIM, -_RIM), slice(_RIM, -_RIM)
    rows = []
    for pair in range(len(btf)):
        found = btf.texture(pair)[inner]
        blur = np.nanmean(btf.blurs.of_pair(pair), (0, 1))
        wanted = blurred(true.texture(pair), blur)[inner]
        seen = np.isfinite(found)
        off = np.log1p(np.maximum(found, -0.5)) - np.log1p(wanted)
        rows.append(((off[seen] ** 2).mean(), seen.mean(), found[seen].mean() / wanted.mean()))
    mse, seen, scale = np.array(rows, np.float64).T
    tilt = np.rint(np.degrees(np.arccos(np.clip(true.view[:, 2], -1, 1)))).astype(np.int64)
    return Looped(
        tilt, mse, seen, scale,
        _apart(btf.light_position, true.light_position),
        _apart(btf.view_position, true.view_position),
    )  # fmt: skip


def _apart(one: NDArray[np.float32] | None, other: NDArray[np.float32] | None) -> Floats:
    """Degrees between (n, 3) directions."""
    first, second = (np.asarray(each, np.float64) for each in (one, other))
    first, second = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (first, second))
    return np.asarray(np.degrees(np.linalg.norm(np.cross(first, second), axis=1)))
