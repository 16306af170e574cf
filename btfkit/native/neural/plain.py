"""Programs in numpy: the twin of the kernels, and what runs where none was built."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit.conventions import (
    EPSILON,
    LEAK,
    LEVELS_UNIT,
    LOOKS,
    LOWEST_COSINE,
    LOWEST_SEEN,
    MOST_LOG,
    STEEPEST,
    displacement,
)
from btfkit.native.neural import bent
from btfkit.native.neural.layout import Layout, Networks
from btfkit.native.neural.lookup import bilinear
from btfkit.program import (
    Cover,
    Dense,
    DepthNetwork,
    OffsetNetwork,
    Program,
    Texture,
    frame_products,
)

Array = NDArray[Any]
Known = dict[str, Array]
YUV_TO_RGB = np.array([[1, 0, 1.13983], [1, -0.39465, -0.5806], [1, 2.03211, 0]])  # BT.601


def answer(
    program: Program,
    uv: Array,
    light: Array,
    view: Array,
    footprint: Array | None = None,
    curvature: Array | None = None,
    drift: Array | None = None,
) -> tuple[Array, Array]:
    """Reflectance (b, c) and opacity (b,) of flat queries.

    Args:
        program: what is computed; its arrays' dtype is that of the answer.
        uv: (b, 2) in 0..1. light, view: (b, 3) unit vectors above the horizon.
        footprint: (b,) texels of the data's grid; None is 0.5 throughout.
        curvature: (b,) 1/tile width; None is the plane.
        drift: (b, 4) of rays that curvature bends, as `bent` has it; None is 0 throughout.
    """
    if program.cover is not None:
        return _covered(program, program.cover, uv, light, view, footprint, curvature)
    raw, scaled, (opacity, lit) = _last_layer(program, uv, light, view, footprint, curvature, drift)
    heads = _heads(program, raw)
    if "opacity" in heads:
        opacity = _sigmoid(heads["opacity"][:, 0])
    rgb = _reflectance(program, heads, scaled, light)
    if program.opacity == "march":
        rgb = rgb * ((opacity > 0) & lit)[:, None]
    return rgb, opacity


def _covered(
    program: Program,
    cover: Cover,
    uv: Array,
    light: Array,
    view: Array,
    footprint: Array | None,
    curvature: Array | None,
) -> tuple[Array, Array]:
    """`answer` of those that a network of opacity lets be seen; the others stop there."""
    found = _looked_up(program, cover, uv, view, curvature)[:, 0]
    opacity = _sigmoid(found) if cover.kind == "direct" else (view[:, 2] >= found)
    opacity = opacity.astype(found.dtype)
    rgb = np.zeros((len(uv), len(program.channels)), found.dtype)
    seen = np.flatnonzero(opacity > 0)
    blur, bend = (None if part is None else part[seen] for part in (footprint, curvature))
    rest = replace(program, cover=None)
    rgb[seen] = answer(rest, uv[seen], light[seen], view[seen], blur, bend)[0]
    return rgb, opacity


def _reflectance(
    program: Program, heads: Mapping[str, Array], scaled: Array | None, light: Array
) -> Array:
    """(b, c) of the heads' numbers."""
    if program.output == "cosine":
        return heads["linear"] * light[:, 2:]
    if program.output == "linear":
        return np.maximum(heads["linear"], 0)
    if program.output == "released":
        return released(heads["log"], heads["mask"])
    y = heads["log"]
    if scaled is not None:
        c = y.shape[1]
        y = scaled[:, :c] + scaled[:, c:] * y
    if "mask" in heads:
        y = y * (0.1 + _sigmoid(heads["mask"]))
    return np.expm1(np.clip(y, 0, MOST_LOG))


def numbers(
    program: Program,
    uv: Array,
    light: Array,
    view: Array,
    footprint: Array | None = None,
    curvature: Array | None = None,
) -> Array:
    """The last layer's numbers (b, outputs), as `answer` takes them."""
    return _last_layer(program, uv, light, view, footprint, curvature)[0]


def depths(program: Program, uv: Array, view: Array, curvature: Array | None = None) -> Array:
    """Ray depth (b,), tile widths, positive above the plane of uv.

    A lookup lies at uv + depth * D(view), D as `step` gives it.
    """
    return marched(program, uv, view, curvature)[0]


def marched(
    program: Program, uv: Array, view: Array, curvature: Array | None = None
) -> tuple[Array, Array, Array]:
    """Ray depth (b,) as `depths`, opacity (b,) and turn (b,) as `bent.Crossing` has them."""
    return _ended(program, uv, view, curvature, None)[:3]


def _ended(
    program: Program, uv: Array, view: Array, curvature: Array | None, drift: Array | None
) -> tuple[Array, Array, Array, Array | None]:
    """`marched`, and how far rays are aside there, as `bent.Crossing` has it."""
    found, dtype = program.depth, program.textures[0].levels[0].dtype
    opacity, turn = np.ones(len(uv), dtype), np.zeros(len(uv), dtype)
    if found is None or isinstance(found, OffsetNetwork):
        return np.zeros(len(uv), dtype), opacity, turn, None
    if isinstance(found, DepthNetwork):
        return _looked_up(program, found, uv, view, None)[:, 0] * found.scale, opacity, turn, None
    if found.opacity is not None:
        bend = np.zeros(len(uv), dtype) if curvature is None else curvature
        end = bent.meet(
            found, uv, view, bend, aspect=program.aspect, wrap=program.wrap, drift=drift
        )
        return end.depth, end.opacity, end.turn, end.aside
    along = ray(view, program.aspect, found.scale)
    met = crossing(found.heights, uv, along, wrap=program.wrap)
    depth = met * lift(view) * found.scale
    aside = None if drift is None else np.zeros_like(uv)
    if found.curved and curvature is not None and (rows := np.flatnonzero(curvature)).size:
        end = bent.meet(
            found, uv[rows], view[rows], curvature[rows], aspect=program.aspect,
            wrap=program.wrap, drift=None if drift is None else drift[rows],
        )  # fmt: skip
        depth[rows], opacity[rows], turn[rows] = end.depth, end.opacity, end.turn
        if aside is not None:
            aside[rows] = end.aside
    return depth, opacity, turn, aside


def _looked_up(
    program: Program,
    found: DepthNetwork | OffsetNetwork | Cover,
    uv: Array,
    view: Array,
    curvature: Array | None,
) -> Array:
    """The numbers (b, n) of a network with a texture of its own, which knows no light."""
    psi = bilinear(found.texture.levels[0], uv, wrap=program.wrap)
    known = _known(view, view, None, curvature) | _columns(found.texture, psi)
    known |= _on_discs(found.inputs, view, view)
    return _run(found.layers, found.inputs, known, rounded=program.rounded)


def evaluate_plain(
    layout: Layout,
    weights: Array,
    texels: Array,
    uv: Array,
    light: Array,
    view: Array,
    footprint: Array | None = None,
    curvature: Array | None = None,
    *,
    raw: bool = False,
    networks: Networks = "float32",
) -> Array:
    """The twin of `Kernel.evaluate`: reflectance (b, c); `raw` gives the decoder's numbers instead.

    Args:
        layout: the model. weights: (layout.weights,). texels: (layout.texels, 8).
        uv: (b, 2). light, view: (b, 3) unit vectors.
        footprint: (b,) texels of the data's grid; None is 0.5 throughout.
        curvature: (b,) 1/tile width, of curved heights; None is the plane.
        networks: with "bfloat16" the weights and inputs of all layers but the first are rounded
            to it; products are summed as before.
    """
    program = layout.program(weights, texels, networks=networks)
    if raw:
        return numbers(program, uv, light, view, footprint, curvature)
    return answer(program, uv, light, view, footprint, curvature)[0]


def depths_plain(
    layout: Layout,
    weights: Array,
    texels: Array,
    uv: Array,
    view: Array,
    curvature: Array | None = None,
    *,
    networks: Networks = "float32",
) -> Array:
    """The twin of `Kernel.depths`."""
    return depths(layout.program(weights, texels, networks=networks), uv, view, curvature)


def released(yuv: Array, mask: Array) -> Array:
    """Reflectance (b, 3) from the six numbers of NeuMIP's published program.

    Source: the program's default configuration, as docs/neumip.md describes it.
    """
    rgb = np.expm1(np.minimum(np.minimum(yuv, MOST_LOG) @ YUV_TO_RGB.T.astype(yuv.dtype), MOST_LOG))
    return np.maximum(rgb * (0.1 + 1 / (1 + np.exp(-np.clip(mask, -80, 80)))), 0)


def step(direction: Array, aspect: float) -> Array:
    """Displacement (b, 2) in uv of one tile width of depth, never faster than at LOWEST_COSINE."""
    cosine = np.maximum(direction[:, 2], LOWEST_COSINE)
    return _stacked(*displacement(direction[:, 0], direction[:, 1], cosine, aspect))


def ray(view: Array, aspect: float, scale: float) -> Array:
    """(b, 2) in uv that a view ray moves while it rises by one unit of heights of `scale`."""
    cosine = np.maximum(view[:, 2], STEEPEST)
    x, y = view[:, 0] / cosine * scale, view[:, 1] / cosine * scale
    return _stacked(*displacement(x, y, 1, aspect))


def lift(view: Array) -> Array:
    """(b,) ray depth of a height of 1, as `step` counts it."""
    return np.maximum(view[:, 2], LOWEST_COSINE) / np.maximum(view[:, 2], STEEPEST)


def crossing(heights: Array, uv: Array, along: Array, *, wrap: bool) -> Array:
    """Height (b,) at which rays from above first meet a surface of bilinear heights.

    A ray is at uv + t * along at height t. It is looked at a texel apart, or at LOOKS places
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
    for k in range(1, LOOKS + 1):
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


def march_steps(along: Array, rise: float, size: tuple[int, int]) -> Array:
    """(b,) looks that a ray takes on its way through heights `rise` apart, 1 to LOOKS."""
    texels = np.max(np.abs(along) * [size[1], size[0]], axis=1) * rise
    return np.clip(np.ceil(texels), 1, LOOKS)


def bfloat16(x: Array) -> Array:
    """The nearest numbers of eight significant bits, ties to even, in the dtype of x."""
    bits = np.asarray(x, np.float32).view(np.uint32)
    near = (bits + 0x7FFF + ((bits >> 16) & 1)) & np.uint32(0xFFFF0000)
    return near.view(np.float32).astype(x.dtype)


def on_disc(direction: Array) -> Array:
    """(..., 2) directions (..., 3) on the unit disc: azimuth kept, radius 2/pi x polar angle.

    In x and y alone the cosine has an infinite slope at the horizon; in the angle it is smooth.
    """
    tangential = np.hypot(direction[..., 0], direction[..., 1])
    angle = np.arctan2(tangential, direction[..., 2])
    # At the pole angle / sine is 1.
    stretch = np.where(tangential > 1e-6, angle / np.maximum(tangential, 1e-6), 1)
    return direction[..., :2] * (stretch * (2 / np.pi)).astype(direction.dtype)[..., None]


def _last_layer(
    program: Program,
    uv: Array,
    light: Array,
    view: Array,
    footprint: Array | None,
    curvature: Array | None,
    drift: Array | None = None,
) -> tuple[Array, Array | None, tuple[Array, Array]]:
    """The last layer's numbers, what the scaling texture says there, and the march's opacity.

    With the opacity (b,) it says whether light comes from above where the ray ends, (b,).
    """
    depth, opacity, turn, aside = _ended(program, uv, view, curvature, drift)
    toward, away = step(view, program.aspect), step(light, program.aspect)
    if isinstance(program.depth, OffsetNetwork):
        offset = _looked_up(program, program.depth, uv, view, curvature)
    if turn.any():
        light, view = (bent.turned(direction, view, turn) for direction in (light, view))
        view[:, 2] = np.where(turn == 0, view[:, 2], np.maximum(view[:, 2], LOWEST_SEEN))
    known = _known(light, view, footprint if program.leveled else None, curvature)
    known |= _on_discs(program.inputs, light, view)
    every = [*program.textures, *([program.scaling] if program.scaling else [])]
    values = []
    for texture in every:
        moved = uv
        if isinstance(program.depth, OffsetNetwork) and texture.view:
            moved = uv + texture.view * offset
        elif program.depth is not None and (texture.view or texture.light):
            moved = uv + depth[:, None] * (texture.view * toward - texture.light * away)
            if aside is not None:
                moved = moved + texture.view * aside
        values.append(_between_levels(texture, moved, known["level"] * LEVELS_UNIT, program.wrap))
    for texture, found in zip(program.textures, values, strict=False):
        known |= _columns(texture, found)
    half = np.stack([known[name] for name in ("hx", "hy", "hz")], axis=1)
    names = iter(frame_products(program.frames))
    for k in range(program.frames):
        axis = values[0][:, 3 * k : 3 * k + 3]
        known |= {next(names): (axis * direction).sum(axis=1) for direction in (half, light)}
    raw = _run(program.layers, program.inputs, known, rounded=program.rounded)
    return raw, values[-1] if program.scaling else None, (opacity, light[:, 2] > 0)


def _heads(program: Program, raw: Array) -> dict[str, Array]:
    found, at = {}, 0
    for head in program.heads:
        found[str(head.kind)] = raw[:, at : at + head.count]
        at += head.count
    return found


def _known(light: Array, view: Array, footprint: Array | None, curvature: Array | None) -> Known:
    """The numbers of `conventions.INPUTS` that a query holds, but those on the disc, (b,) each."""
    total = light + view
    length = np.linalg.norm(total, axis=1, keepdims=True)
    none = length < 1e-6
    half = np.where(none, [[0, 0, 1]], total / np.where(none, 1, length)).astype(light.dtype)
    cos_diff = np.where(none, 0, length / 2)[:, 0].astype(light.dtype)
    level = np.zeros(len(light), light.dtype)
    if footprint is not None:
        level = np.log2(2 * np.clip(footprint, 0.5, 1e30))
    curved = np.zeros(len(light), light.dtype) if curvature is None else bent.softened(curvature)
    found = dict(zip(("lx", "ly", "lz", "vx", "vy", "vz"), (*light.T, *view.T), strict=True))
    found |= dict(zip(("hx", "hy", "hz"), half.T, strict=True))
    found |= {"cos_diff": cos_diff, "level": level / LEVELS_UNIT, "curvature": curved}
    return found


def _on_discs(inputs: Sequence[str], light: Array, view: Array) -> Known:
    """The numbers on the disc among a layer's inputs: two arctangents, which few models take."""
    if not any(name.endswith("_disc") for name in inputs):
        return {}
    names = ("lx_disc", "ly_disc", "vx_disc", "vy_disc")
    return dict(zip(names, (*on_disc(light).T, *on_disc(view).T), strict=True))


def _columns(texture: Texture, values: Array) -> Known:
    return dict(zip(texture.features, values.T, strict=True))


def _run(
    layers: Sequence[Dense], inputs: Sequence[str], known: Mapping[str, Array], *, rounded: bool
) -> Array:
    x = np.stack([known[name] for name in inputs], axis=1)
    for k, layer in enumerate(layers):
        weight = bfloat16(layer.weight) if rounded and k else layer.weight
        z = x @ weight.T + layer.bias
        if layer.gain is not None and layer.centre is not None:
            z = z - z.mean(axis=1, keepdims=True)
            z = z / np.sqrt(np.square(z).mean(axis=1, keepdims=True) + EPSILON)
            z = z * layer.gain + layer.centre
        y = _activated(layer, z if layer.omega == 1 else layer.omega * z)
        if rounded and k + 1 < len(layers):
            y = bfloat16(y)
        x = x + y if layer.residual else y
    return x


def _activated(layer: Dense, z: Array) -> Array:
    if layer.activation == "relu":
        return np.maximum(z, 0)
    if layer.activation == "leaky":
        return np.where(z > 0, z, z * np.asarray(LEAK, z.dtype))
    return np.sin(z) if layer.activation == "sine" else z


def _between_levels(texture: Texture, uv: Array, level: Array, wrap: bool) -> Array:
    levels = texture.levels
    at = np.clip(level - texture.shift, 0, len(levels) - 1)
    found = np.zeros((len(uv), levels[0].shape[-1]), levels[0].dtype)
    for s, one in enumerate(levels):
        # The paper's eq. 3 has both weights 0 at whole levels; these sum to 1.
        weight = np.maximum(0, 1 - np.abs(at - s))
        rows = np.flatnonzero(weight)
        found[rows] += weight[rows, None] * bilinear(one, uv[rows], wrap=wrap)
    return found


def _sigmoid(x: Array) -> Array:
    with np.errstate(over="ignore"):
        return 1 / (1 + np.exp(-x))


def _stacked(du: Array, dv: Array) -> Array:
    return np.stack([du, dv], axis=1)
