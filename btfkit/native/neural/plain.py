"""NeuMIP's evaluation in numpy: the twin of the kernels, and what runs where none was built."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit.native.neural.layout import DIRECTIONS, LEAK, Layout, Network, Networks, Pyramid

Array = NDArray[Any]
# Looks at most along a view ray.
MARCH = 8
# Lowest cosine of a view ray through heights: 84 degrees.
STEEPEST = 0.1
# Where a ray grazes the surface, its crossing moves no faster than 1 / FLATTEST of a height.
FLATTEST = 0.3


def evaluate_plain(
    layout: Layout,
    weights: NDArray[Any],
    texels: NDArray[Any],
    uv: NDArray[Any],
    light: NDArray[Any],
    view: NDArray[Any],
    footprint: NDArray[Any] | None = None,
    *,
    raw: bool = False,
    networks: Networks = "float32",
) -> NDArray[Any]:
    """Reflectance (b, c) for flat queries; `raw` gives the decoder's numbers instead.

    Args:
        layout: the model. weights: (layout.weights,). texels: (layout.texels, 8).
        uv: (b, 2). light, view: (b, 3) unit vectors.
        footprint: (b,) texels of the data's grid; None is 0.5 throughout.
        networks: with "bfloat16" the weights and inputs of all layers but the first are rounded
            to it; products are summed as before.
    """
    known = _directions(light, view, footprint)
    depth = depths_plain(layout, weights, texels, uv, view, networks=networks)
    textures = layout.textures(texels)[1 if layout.offset else 0 :]
    parts = []
    for bank, levels in zip(layout.banks, textures, strict=True):
        moved = uv
        if layout.has_depth and (bank.view or bank.light):
            move = bank.view * step(view, layout) - bank.light * step(light, layout)
            moved = uv + depth[:, None] * move
        parts.append(_between_levels(bank, levels, moved, known["level"] * 8, wrap=layout.wrap))
    half = np.stack([known[name] for name in ("hx", "hy", "hz")], axis=1)
    for k in range(layout.frames):
        axis = parts[0][:, 3 * k : 3 * k + 3]
        parts += [(axis * direction).sum(axis=1, keepdims=True) for direction in (half, light)]
    z = _run(layout.decoder, layout.split(weights)[1], parts, known, networks)
    if raw:
        return z
    c = layout.channels
    y = z[:, :c]
    if layout.output == "mask":
        with np.errstate(over="ignore"):
            y = y * (0.1 + 1 / (1 + np.exp(-z[:, c:])))
    return np.expm1(np.clip(y, 0, 20))


def depths_plain(
    layout: Layout,
    weights: NDArray[Any],
    texels: NDArray[Any],
    uv: NDArray[Any],
    view: NDArray[Any],
    *,
    networks: Networks = "float32",
) -> NDArray[Any]:
    """Ray depth (b,) of the offset stage, tile widths, positive above the plane of uv.

    The lookup lies at uv + depth * H(view), H as `step` gives it.
    """
    if layout.heights is not None:
        surface = layout.surface(texels)
        along = ray(view, layout)
        return crossing(surface, uv, along, wrap=layout.wrap) * lift(view) * layout.depth_scale
    if layout.offset is None:
        return np.zeros(len(uv), texels.dtype)
    pyramid, network = layout.offset
    psi = bilinear(layout.textures(texels)[0][0], uv, wrap=layout.wrap)[:, : pyramid.channels]
    known = _directions(view, view, None)
    raw = _run(network, layout.split(weights)[0], [psi], known, networks)
    return raw[:, 0] * layout.depth_scale


def step(direction: NDArray[Any], layout: Layout) -> NDArray[Any]:
    """Displacement (b, 2) in uv of one tile width of depth: H of the paper, v down the rows."""
    xy = direction[:, :2] / np.maximum(direction[:, 2:], 0.6)
    return xy * np.asarray([1.0, -layout.aspect], direction.dtype)


def ray(view: NDArray[Any], layout: Layout) -> NDArray[Any]:
    """(b, 2) in uv that a view ray moves while it rises by one unit of the heights."""
    xy = view[:, :2] / np.maximum(view[:, 2:], STEEPEST) * layout.depth_scale
    return xy * np.asarray([1.0, -layout.aspect], view.dtype)


def lift(view: NDArray[Any]) -> NDArray[Any]:
    """(b,) ray depth of a height of 1: `step` divides by no less than 0.6, a ray by its cosine."""
    return np.maximum(view[:, 2], 0.6) / np.maximum(view[:, 2], STEEPEST)


def crossing(
    heights: NDArray[Any], uv: NDArray[Any], along: NDArray[Any], *, wrap: bool
) -> NDArray[Any]:
    """Height (b,) at which rays from above first meet a surface of bilinear heights.

    A ray is at uv + t * along at height t. It is looked at a texel apart, or at MARCH places
    where it is longer; between two of them the surface is taken as straight, twice.

    Args:
        heights: (h, w). uv, along: (b, 2).
    """
    h, w = heights.shape
    top, bottom = heights.max(), heights.min()
    count = march_steps(along, float(top - bottom), (h, w))
    surface = heights[..., None]

    def above(t: Array) -> Array:
        return t - bilinear(surface, uv + t[:, None] * along, wrap=wrap)[:, 0]

    def met(high: Array, low: Array, gap: Array, under: Array) -> Array:
        return high + (low - high) * (gap / np.maximum(gap - under, 1e-12))

    low = high = np.full(len(uv), top, heights.dtype)
    under = gap = above(low)
    going = np.ones(len(uv), bool)
    for k in range(1, MARCH + 1):
        high, gap = np.where(going, low, high), np.where(going, under, gap)
        to = top + (bottom - top) * np.minimum(k / count, 1).astype(heights.dtype)
        found = above(to)
        low, under = np.where(going, to, low), np.where(going, found, under)
        going &= found > 0
    first = met(high, low, gap, under)
    rest = above(first)
    short = rest > 0
    high, gap = np.where(short, first, high), np.where(short, rest, gap)
    low, under = np.where(short, low, first), np.where(short, under, rest)
    return met(high, low, gap, under)


def march_steps(along: NDArray[Any], rise: float, size: tuple[int, int]) -> NDArray[Any]:
    """(b,) looks that a ray takes on its way through heights `rise` apart, 1 to MARCH."""
    texels = np.max(np.abs(along) * [size[1], size[0]], axis=1) * rise
    return np.clip(np.ceil(texels), 1, MARCH)


def _directions(
    light: NDArray[Any], view: NDArray[Any], footprint: NDArray[Any] | None
) -> dict[str, NDArray[Any]]:
    total = light + view
    length = np.linalg.norm(total, axis=1, keepdims=True)
    none = length < 1e-6
    half = np.where(none, [[0, 0, 1]], total / np.where(none, 1, length)).astype(light.dtype)
    cos_diff = np.where(none, 0, length / 2)[:, 0].astype(light.dtype)
    level = np.zeros(len(light), light.dtype)
    if footprint is not None:
        level = np.log2(2 * np.clip(footprint, 0.5, 1e30))
    columns = [*light.T, *view.T, *half.T, cos_diff, level / 8]
    return dict(zip(DIRECTIONS, columns, strict=True))


def _run(
    network: Network,
    flat: NDArray[Any],
    features: Sequence[NDArray[Any]],
    known: dict[str, NDArray[Any]],
    networks: Networks,
) -> NDArray[Any]:
    x = np.concatenate([*features, *(known[d][:, None] for d in network.directions)], axis=1)
    layers = network.layers(flat)
    half = networks == "bfloat16"
    if half:
        layers[1:] = [(bfloat16(matrix), bias) for matrix, bias in layers[1:]]
    for matrix, bias in layers[:-1]:
        x = x @ matrix.T + bias
        if network.activation == "relu":
            x = np.maximum(x, 0)
        elif network.activation == "leaky":
            x = np.where(x > 0, x, x * np.asarray(LEAK, x.dtype))
        elif network.activation == "sine":
            x = np.sin(x)
        x = bfloat16(x) if half else x
    matrix, bias = layers[-1]
    return x @ matrix.T + bias


def bfloat16(x: NDArray[Any]) -> NDArray[Any]:
    """The nearest numbers of eight significant bits, ties to even, in the dtype of x."""
    bits = np.asarray(x, np.float32).view(np.uint32)
    near = (bits + 0x7FFF + ((bits >> 16) & 1)) & np.uint32(0xFFFF0000)
    return near.view(np.float32).astype(x.dtype)


def _between_levels(
    bank: Pyramid, levels: list[NDArray[Any]], uv: NDArray[Any], level: NDArray[Any], *, wrap: bool
) -> NDArray[Any]:
    at = np.clip(level - bank.shift, 0, len(levels) - 1)
    found = np.zeros((len(uv), bank.channels), levels[0].dtype)
    for s, texture in enumerate(levels):
        # The paper's eq. 3 has both weights 0 at whole levels; these sum to 1.
        weight = np.maximum(0, 1 - np.abs(at - s))
        rows = np.flatnonzero(weight)
        value = bilinear(texture, uv[rows], wrap=wrap)[:, : bank.channels]
        found[rows] += weight[rows, None] * value
    return found


def bilinear(texture: NDArray[Any], uv: NDArray[Any], *, wrap: bool) -> NDArray[Any]:
    """(b, k) of a texture (h, w, k) at uv (b, 2), tiling or clamped at its borders."""
    h, w, _ = texture.shape
    size = np.asarray([w, h], uv.dtype)
    if wrap:
        uv = uv - np.floor(uv)
    at = uv * size - np.asarray(0.5, uv.dtype)
    at = np.clip(at, -1, size)
    low = np.floor(at)
    fx, fy = (at - low).T[..., None]
    x0, y0 = low.astype(np.int64).T
    if wrap:
        x0, x1, y0, y1 = x0 % w, (x0 + 1) % w, y0 % h, (y0 + 1) % h
    else:
        x1, y1 = np.clip(x0 + 1, 0, w - 1), np.clip(y0 + 1, 0, h - 1)
        x0, y0 = np.clip(x0, 0, w - 1), np.clip(y0, 0, h - 1)
    upper = texture[y0, x0] * (1 - fx) + texture[y0, x1] * fx
    lower = texture[y1, x0] * (1 - fx) + texture[y1, x1] * fx
    return upper * (1 - fy) + lower * fy
