"""Errors of a found relief: against a known one, and against the BTF itself."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from btfkit.btf import BTF
from btfkit.fitting.heightfield import Found
from btfkit.fitting.heightfield.parallax import reached
from btfkit.materials.evaluation import errors_on_btf
from btfkit.relief import synth
from btfkit.relief.material import TracedRelief, TracedSpec
from btfkit.relief.relief import Relief
from btfkit.relief.trace import traced_btf

Floats = NDArray[Any]
# Places a texel at which slopes are averaged, each way; footprint of a texture, texels.
_FINE, _FOOTPRINT = 4, 0.5
# Normals count where slopes are below this and half of the views see them.
_STEEPEST_DEG, _HALF = 60.0, 0.5
# A picture of the relief that a BTF names correlates with its own, of so many rays a texel.
_SAME, _RAYS = 0.9, 16


def rerendered(found: Found, btf: BTF) -> dict[str, Any]:
    """Errors of the traced relief on the pairs of a BTF that were held out, or on a few others."""
    pairs = found.held if len(found.held) else np.arange(0, len(btf), max(len(btf) // 8, 1))
    # A ray a texel: what was measured holds the footprint of its texels already.
    errors = errors_on_btf(TracedRelief(found.relief, TracedSpec(samples=1)), btf, pairs=pairs)
    return {"held_out": bool(len(found.held)), **errors}


def truth_of(btf: BTF) -> Relief | None:
    """The procedural relief that a BTF was traced from, where its provenance names one.

    None where there is none, or where a picture of the BTF does not look like it: pictures may
    have been turned or moved since.
    """
    _, h, w, _ = btf.shape
    relief = synth.known(btf.provenance, (h, w))
    above = np.flatnonzero((btf.light[:, 2] > 0) & (btf.view[:, 2] > 0))
    if relief is None or not len(above):
        return None
    pair = above[[int(np.argmax(btf.view[above, 2]))]]
    traced = traced_btf(relief, btf.light[pair], btf.view[pair], samples=_RAYS)
    pictures = btf.texture(int(pair[0])), traced.texture(0)
    # Rays of a few differ from texel to texel; structures do not.
    one, other = (gaussian_filter(p.mean(axis=-1), 1.0, mode="nearest") for p in pictures)
    good = np.isfinite(one) & np.isfinite(other)
    if good.sum() < 2 or min(one[good].std(), other[good].std()) == 0:
        return None
    return relief if np.corrcoef(one[good], other[good])[0, 1] > _SAME else None


def against_truth(found: Found, truth: Relief) -> dict[str, Any]:
    """Errors of normals (degrees) and heights (texels) where the relief is known.

    Heights of normals alone have no offset: theirs is taken off first. What lights and views
    reach is what they reach of the true relief.

    Raises:
        ValueError: reliefs of different sizes.
    """
    if truth.size != found.relief.size:
        raise ValueError(f"the true relief has {truth.size} texels; found were {found.relief.size}")
    height = truth.height * np.float32(truth.size[1])
    normal = filtered(truth)
    lit, seen = reached_by_half(truth, found.lights, found.views)
    counted = (normal[..., 2] > np.cos(np.radians(_STEEPEST_DEG))) & seen
    degrees = np.degrees(np.arccos(np.clip((found.normals.normal() * normal).sum(-1), -1, 1)))
    source = str(found.figures["source"])
    absolute = source != "normals"
    result: dict[str, Any] = {
        "normal_median_deg": float(np.median(degrees[counted])),
        "normal_mean_deg": float(degrees[counted].mean()),
        "counted": float(counted.mean()),
        "reached_by_half": float((lit & seen).mean()),
        "range_texels": float(np.ptp(height)),
        "heights": {
            name: errors_of_heights(values, truth, lit & seen, absolute=absolute)
            for name, values in found.heights.items()
        },
    }
    error = found.heights[source] - height
    error = error if absolute else error - error.mean()
    result["by_depth"] = _deciles(error, -height)
    expected = bool(np.isfinite(found.deviation).all())
    key = found.deviation if expected else -found.normals.confidence
    result["by_confidence"] = _deciles(error, key)
    if expected:
        order = np.argsort(found.deviation, axis=None)
        result["expected_by_confidence"] = [
            _rms(part) for part in np.array_split(found.deviation.reshape(-1)[order], 10)
        ]
    return result


def errors_of_heights(
    height: Floats, truth: Relief, half: NDArray[np.bool_], *, absolute: bool = True
) -> dict[str, float]:
    """Root mean square errors of heights (h, w), and their mean, texels.

    Args:
        height: (h, w) texels. truth: the relief as it is.
        half: (h, w) where half of the lights and views reach it.
        absolute: whether the heights have an offset; else it is taken off.

    Returns:
        of all and of what half reaches, and of both against the truth within the footprint.
    """
    true = truth.height * np.float32(truth.size[1])
    mode = "wrap" if truth.wrap == "wrap" else "nearest"
    error = height - true
    error = error if absolute else error - error.mean()
    soft = error + true - gaussian_filter(true, _FOOTPRINT, mode=mode)
    return {
        "rms_half": _rms(error[half]), "rms": _rms(error), "bias": float(error.mean()),
        "rms_filtered_half": _rms(soft[half]), "rms_filtered": _rms(soft),
    }  # fmt: skip


def reached_by_half(
    truth: Relief, lights: Floats, views: Floats
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(h, w) where half of the lights (k, 3), and of the views, reach a relief."""
    height, wrap = truth.height * np.float32(truth.size[1]), truth.wrap == "wrap"
    lit, seen = (reached(height, d, wrap=wrap) >= _HALF for d in (lights, views))
    return lit, seen


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
