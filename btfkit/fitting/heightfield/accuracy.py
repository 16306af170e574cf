"""Errors of a found relief: against a known one, and against the BTF itself."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from btfkit.btf import BTF
from btfkit.fitting.heightfield import Found
from btfkit.materials.evaluation import errors_on_btf
from btfkit.relief.material import TracedRelief, TracedSpec
from btfkit.relief.relief import Relief

Floats = NDArray[Any]
# Places a texel at which slopes are averaged, each way; footprint of a texture, texels.
_FINE, _FOOTPRINT = 4, 0.5
# Normals count where slopes are below this and half of the views see them.
_STEEPEST_DEG, _HALF = 60.0, 0.5


def rerendered(found: Found, btf: BTF) -> dict[str, Any]:
    """Errors of the traced relief on the pairs of a BTF that were held out, or on a few others."""
    pairs = found.held if len(found.held) else np.arange(0, len(btf), max(len(btf) // 8, 1))
    # A ray a texel: what was measured holds the footprint of its texels already.
    errors = errors_on_btf(TracedRelief(found.relief, TracedSpec(samples=1)), btf, pairs=pairs)
    return {"held_out": bool(len(found.held)), **errors}


def against_truth(found: Found, truth: Relief) -> dict[str, Any]:
    """Errors of normals (degrees) and heights (texels) where the relief is known.

    Heights of normals alone have no offset: theirs is taken off first.

    Raises:
        ValueError: reliefs of different sizes.
    """
    if truth.size != found.relief.size:
        raise ValueError(f"the true relief has {truth.size} texels; found were {found.relief.size}")
    w = truth.size[1]
    normal, height = filtered(truth), truth.height * np.float32(w)
    blurred = gaussian_filter(
        height, _FOOTPRINT, mode="wrap" if truth.wrap == "wrap" else "nearest"
    )
    counted = (normal[..., 2] > np.cos(np.radians(_STEEPEST_DEG))) & (found.seen >= _HALF)
    half = (found.lit >= _HALF) & (found.seen >= _HALF)
    degrees = np.degrees(np.arccos(np.clip((found.normals.normal() * normal).sum(-1), -1, 1)))
    result: dict[str, Any] = {
        "normal_median_deg": float(np.median(degrees[counted])),
        "normal_mean_deg": float(degrees[counted].mean()),
        "counted": float(counted.mean()),
        "reached_by_half": float(half.mean()),
        "range_texels": float(np.ptp(height)),
        "heights": {},
    }
    absolute = "fusion" in found.heights
    for name, values in found.heights.items():
        error = values - height if absolute else values - values.mean() - height + height.mean()
        soft = error + height - blurred
        result["heights"][name] = {
            "rms_half": _rms(error[half]), "rms": _rms(error), "bias": float(error.mean()),
            "rms_filtered_half": _rms(soft[half]), "rms_filtered": _rms(soft),
        }  # fmt: skip
    best = found.heights["fusion" if absolute else "normals"]
    error = best - height
    error = error if absolute else error - error.mean()
    result["by_depth"] = _deciles(error, -height)
    key = found.deviation if absolute else -found.normals.confidence
    result["by_confidence"] = _deciles(error, key)
    if absolute:
        order = np.argsort(found.deviation, axis=None)
        result["expected_by_confidence"] = [
            _rms(part) for part in np.array_split(found.deviation.reshape(-1)[order], 10)
        ]
    return result


def filtered(relief: Relief, footprint: float = _FOOTPRINT) -> Floats:
    """(h, w, 3) normals of a relief's bilinear surface, averaged over a Gaussian footprint."""
    h, w = relief.size
    tiles = relief.wrap == "wrap"
    z = relief.height.astype(float) * w
    row, col = ((np.mgrid[: h * _FINE, : w * _FINE] + 0.5) / _FINE - 0.5).astype(float)
    i, j = np.floor(row).astype(int), np.floor(col).astype(int)
    b, a = row - i, col - j

    def corner(down: int, across: int) -> Floats:
        r, c = i + down, j + across
        r, c = (r % h, c % w) if tiles else (np.clip(r, 0, h - 1), np.clip(c, 0, w - 1))
        return z[r, c]

    z00, z01, z10, z11 = corner(0, 0), corner(0, 1), corner(1, 0), corner(1, 1)
    dx = (1 - b) * (z01 - z00) + b * (z11 - z10)
    dy = -((1 - a) * (z10 - z00) + a * (z11 - z01))
    normal = np.stack([-dx, -dy, np.ones_like(dx)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    mode = "wrap" if tiles else "nearest"
    soft = gaussian_filter(normal, (footprint * _FINE, footprint * _FINE, 0), mode=mode)
    middle = slice(_FINE // 2 - 1, _FINE // 2 + 1)
    mean = soft.reshape(h, _FINE, w, _FINE, 3)[:, middle, :, middle].mean(axis=(1, 3))
    return mean / np.linalg.norm(mean, axis=-1, keepdims=True)


def _rms(error: Floats) -> float:
    return float(np.sqrt(np.square(error).mean())) if error.size else float("nan")


def _deciles(error: Floats, key: Floats) -> list[float]:
    """Root mean square errors of ten parts, from the least `key` to the largest."""
    order = np.argsort(key, axis=None)
    return [_rms(part) for part in np.array_split(error.reshape(-1)[order], 10)]
