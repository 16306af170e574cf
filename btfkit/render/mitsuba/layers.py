"""Layers traced by Dr.Jit: weights as literals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from btfkit.conventions import CURVATURE_UNIT, EPSILON, LEAK, LEVELS_UNIT
from btfkit.program import Dense

Numbers = list[Any]
# Parts of a sum that are taken at once: in one chain each product would wait for the one before.
_PARTS = 3


def known(light: Numbers, view: Numbers, level: Any, curvature: Any) -> dict[str, Any]:
    """The numbers of a query that layers may take, by name."""
    total = [a + b for a, b in zip(light, view, strict=True)]
    length = dr.sqrt(sum(x * x for x in total))
    none = length < 1e-6
    half = [dr.select(none, pole, x / dr.maximum(length, 1e-6))
            for x, pole in zip(total, (0, 0, 1), strict=True)]  # fmt: skip
    found = dict(zip(("lx", "ly", "lz", "vx", "vy", "vz"), (*light, *view), strict=True))
    found |= dict(zip(("hx", "hy", "hz"), half, strict=True))
    found |= {"cos_diff": dr.select(none, 0, length / 2), "level": level / LEVELS_UNIT}
    found["curvature"] = curvature / (CURVATURE_UNIT + dr.abs(curvature))
    for name, way in (("l", light), ("v", view)):
        sine = dr.sqrt(way[0] * way[0] + way[1] * way[1])
        stretch = dr.select(sine > 1e-6, dr.atan2(sine, way[2]) / dr.maximum(sine, 1e-6), 1)
        for axis, x in zip("xy", way, strict=False):
            found[f"{name}{axis}_disc"] = x * stretch * (2 / np.pi)
    return found


def run(
    layers: Sequence[Dense], x: Numbers, *, rounded: bool, begun: Numbers | None = None
) -> Numbers:
    """What layers make of numbers.

    Args:
        rounded: whether what goes from one to the next is rounded to bfloat16.
        begun: stands for the biases of the first layer.
    """
    for k, layer in enumerate(layers):
        z = sums(layer, x, begun if k == 0 else None)
        if layer.gain is not None and layer.centre is not None:
            z = _normalised(z, layer.gain.tolist(), layer.centre.tolist())
        y = [_activated(layer, layer.omega * each if layer.omega != 1 else each) for each in z]
        if rounded and k + 1 < len(layers):
            y = [_bfloat16(value) for value in y]
        x = [a + b for a, b in zip(x, y, strict=True)] if layer.residual else y
    return x


def sums(layer: Dense, x: Numbers, begun: Numbers | None = None) -> Numbers:
    """Biases, or what is `begun`, and the weighted sums of a layer."""
    starts = begun or [mi.Float(bias) for bias in layer.bias.tolist()]
    ends = sorted({len(x) * k // _PARTS for k in range(1, _PARTS + 1)})
    found = []
    for start, row in zip(starts, layer.weight.tolist(), strict=True):
        total, first = start, 0
        for end in ends:
            part = None
            for weight, value in zip(row[first:end], x[first:end], strict=True):
                part = weight * value if part is None else dr.fma(weight, value, part)
            if part is not None:
                total = total + part
            first = end
        found.append(total)
    return found


def _normalised(sums: Numbers, gain: list[float], centre: list[float]) -> Numbers:
    mean = sum(sums) / len(sums)
    apart = [z - mean for z in sums]
    scale = 1 / dr.sqrt(sum(z * z for z in apart) / len(sums) + EPSILON)
    return [z * scale * g + c for z, g, c in zip(apart, gain, centre, strict=True)]


def _activated(layer: Dense, z: Any) -> Any:
    # Not dr.maximum, which takes six instructions to let NaN of either side pass.
    if layer.activation == "relu":
        return dr.select(z < 0, 0, z)
    if layer.activation == "leaky":
        low = LEAK * z
        return dr.select(low > z, low, z)
    return dr.sin(z) if layer.activation == "sine" else z


def _bfloat16(x: Any) -> Any:
    bits = dr.reinterpret_array(mi.UInt32, x)
    near = (bits + 0x7FFF + ((bits >> 16) & 1)) & 0xFFFF0000
    return dr.reinterpret_array(mi.Float, near)


def sigmoid(x: Any) -> Any:
    """1 / (1 + exp(-x))."""
    return 1 / (1 + dr.exp(-x))


def expm1(x: Any) -> Any:
    """exp(x) - 1."""
    return dr.exp(x) - 1
