"""A program traced by Dr.Jit: weights as literals, textures as buffers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import drjit as dr
import mitsuba as mi
import numpy as np

from btfkit.conventions import (
    EPSILON,
    LEAK,
    LEVELS_UNIT,
    LOOKS,
    LOWEST_COSINE,
    MOST_LOG,
    STEEPEST,
    displacement,
)
from btfkit.native.neural.plain import YUV_TO_RGB
from btfkit.program import Dense, Heights, Program, Texture, frame_products

Numbers = list[Any]
# 38,000 took LLVM nine minutes, 3,000 five seconds.
MOST_WEIGHTS = 12000


@final
class Evaluation:
    """The evaluation of a program in the variant that is set.

    Args:
        program: what is computed.

    Raises:
        TypeError: the view ray bends with curvature, or too large networks.
    """

    def __init__(self, program: Program) -> None:
        found = program.depth
        if isinstance(found, Heights) and found.curved:
            raise TypeError(
                "the view ray of this material bends with curvature, which Mitsuba's shapes do "
                "not tell; expected one whose heights lie on the plane"
            )
        depth_layers = getattr(found, "layers", ())
        weights = sum(layer.weight.size for layer in (*program.layers, *depth_layers))
        if weights > MOST_WEIGHTS:
            raise TypeError(
                f"networks of {weights} weights, each of which becomes an instruction; expected "
                f"at most {MOST_WEIGHTS}: fit a smaller model, or export to C++"
            )
        self._program = program
        self._pyramids = {t.name: _Pyramid(t.levels, program.wrap) for t in program.textures}
        if program.scaling:
            self._pyramids[program.scaling.name] = _Pyramid(program.scaling.levels, program.wrap)
        if isinstance(found, Heights):
            self._heights = _Pyramid((found.heights[..., None],), program.wrap)
        elif found is not None:
            self._heights = _Pyramid(found.texture.levels[:1], program.wrap)

    def __call__(
        self, uv: Numbers, light: Numbers, view: Numbers, footprint: Any, active: Any
    ) -> tuple[Numbers, Any]:
        """Reflectance by channel, and opacity.

        Args:
            uv: u and v, in one tile or clamped to it. light, view: x, y, z of unit vectors.
            footprint: texels of the data's grid. active: which lanes are asked.
        """
        program = self._program
        level = dr.log2(2 * dr.clip(footprint, 0.5, 1e30)) if program.leveled else 0 * footprint
        known = _known(light, view, level)
        depth = self._depth(uv, view, known, active)
        values = {}
        for texture in [*program.textures, *([program.scaling] if program.scaling else [])]:
            u, v = self._moved(texture, uv, light, view, depth)
            values[texture.name] = self._pyramids[texture.name](
                u, v, level - float(texture.shift), active
            )
        for texture in program.textures:
            known |= dict(zip(texture.features, values[texture.name], strict=True))
        names = iter(frame_products(program.frames))
        half = [known[name] for name in ("hx", "hy", "hz")]
        for k in range(program.frames):
            axis = values[program.textures[0].name][3 * k : 3 * k + 3]
            for direction in (half, light):
                known[next(names)] = sum(a * b for a, b in zip(axis, direction, strict=True))
        raw = _run(program.layers, [known[n] for n in program.inputs], rounded=program.rounded)
        white = values[program.scaling.name] if program.scaling else None
        return self._output(raw, light, white)

    def _depth(self, uv: Numbers, view: Numbers, known: dict[str, Any], active: Any) -> Any:
        found = self._program.depth
        if found is None:
            return None
        if not isinstance(found, Heights):
            psi = self._heights(uv[0], uv[1], 0 * uv[0], active)
            columns = known | dict(zip(found.texture.features, psi, strict=True))
            inputs = [columns[name] for name in found.inputs]
            return _run(found.layers, inputs, rounded=self._program.rounded)[0] * float(found.scale)
        low, scale = dr.maximum(view[2], STEEPEST), float(found.scale)
        along = displacement(view[0] / low * scale, view[1] / low * scale, 1, self._program.aspect)
        met = self._crossing(found.heights, uv, along, active)
        return met * dr.maximum(view[2], LOWEST_COSINE) / low * scale

    def _crossing(self, heights: Any, uv: Numbers, along: Sequence[Any], active: Any) -> Any:
        """As `native.neural.plain.crossing`."""
        h, w = heights.shape
        top, bottom = float(heights.max()), float(heights.min())

        def above(t: Any) -> Any:
            u, v = uv[0] + t * along[0], uv[1] + t * along[1]
            return t - self._heights(u, v, 0 * t, active)[0]

        def met(high: Any, low: Any, gap: Any, under: Any) -> Any:
            return high + (low - high) * (gap / dr.maximum(gap - under, 1e-12))

        texels = dr.maximum(dr.abs(along[0]) * w, dr.abs(along[1]) * h) * (top - bottom)
        count = dr.clip(dr.ceil(texels), 1, LOOKS)
        low = high = mi.Float(top) + 0 * uv[0]
        under = gap = above(low)
        going = mi.Bool(True)
        for k in range(1, LOOKS + 1):
            high, gap = dr.select(going, low, high), dr.select(going, under, gap)
            low = dr.select(going, top + (bottom - top) * dr.minimum(k / count, 1), low)
            under = dr.select(going, above(low), under)
            going &= under > 0
        first = met(high, low, gap, under)
        rest = above(first)
        return dr.select(rest > 0, met(first, low, rest, under), met(high, first, gap, rest))

    def _moved(
        self, texture: Texture, uv: Numbers, light: Numbers, view: Numbers, depth: Any
    ) -> Numbers:
        if depth is None or not (texture.view or texture.light):
            return uv
        place = list(uv)
        for way, share in ((view, texture.view), (light, -texture.light)):
            cosine = dr.maximum(way[2], LOWEST_COSINE)
            moves = displacement(way[0], way[1], cosine, self._program.aspect)
            place = [x + depth * float(share) * move for x, move in zip(place, moves, strict=True)]
        return place

    def _output(self, raw: Numbers, light: Numbers, white: Numbers | None) -> tuple[Numbers, Any]:
        heads: dict[str, Numbers] = {}
        for head in self._program.heads:
            heads[head.kind], raw = raw[: head.count], raw[head.count :]
        opacity = _sigmoid(heads["opacity"][0]) if "opacity" in heads else mi.Float(1)
        if self._program.output == "cosine":
            return [value * light[2] for value in heads["linear"]], opacity
        masks = [0.1 + _sigmoid(mask) for mask in heads.get("mask", [])]
        if self._program.output == "released":
            logs = [dr.minimum(y, MOST_LOG) for y in heads["log"]]
            sums = [sum(float(m) * y for m, y in zip(row, logs, strict=True)) for row in YUV_TO_RGB]
            values = [_expm1(dr.minimum(y, MOST_LOG)) for y in sums]
            return [dr.maximum(v * m, 0) for v, m in zip(values, masks, strict=True)], opacity
        logs = heads["log"]
        if white is not None:
            c = len(logs)
            logs = [white[k] + white[c + k] * y for k, y in enumerate(logs)]
        if masks:
            logs = [y * mask for y, mask in zip(logs, masks, strict=True)]
        return [_expm1(dr.clip(y, 0, MOST_LOG)) for y in logs], opacity


@final
class _Pyramid:
    """Levels of a texture in one buffer."""

    def __init__(self, levels: Sequence[Any], wrap: bool) -> None:
        self._wrap, self._count, self._channels = wrap, len(levels), levels[0].shape[-1]
        sizes = np.array([level.shape[:2] for level in levels], np.uint32)
        starts = np.cumsum([0, *(int(h) * int(w) for h, w in sizes)])[:-1].astype(np.uint32)
        flat = [np.asarray(level, np.float32).reshape(-1) for level in levels]
        self._texels = mi.Float(np.concatenate(flat))
        self._heights, self._widths = (mi.UInt32(sizes[:, k].copy()) for k in range(2))
        self._starts = mi.UInt32(starts)

    def __call__(self, u: Any, v: Any, level: Any, active: Any) -> Numbers:
        """Every channel, between texels and levels."""
        at = dr.clip(level, 0, self._count - 1)
        finer = mi.UInt32(at)
        found = self._level(u, v, finer, active)
        if self._count == 1:
            return found
        share = at - mi.Float(finer)
        coarser = self._level(u, v, dr.minimum(finer + 1, self._count - 1), active)
        return [a + share * (b - a) for a, b in zip(found, coarser, strict=True)]

    def _level(self, u: Any, v: Any, s: Any, active: Any) -> Numbers:
        w, h, start = (dr.gather(mi.UInt32, table, s, active)
                       for table in (self._widths, self._heights, self._starts))  # fmt: skip
        (x0, x1, fx), (y0, y1, fy) = self._beside(u, w), self._beside(v, h)
        rows = [(start + y * w, share) for y, share in ((y0, 1 - fy), (y1, fy))]
        taps = [((row + x) * self._channels, share * part)
                for row, share in rows for x, part in ((x0, 1 - fx), (x1, fx))]  # fmt: skip
        return [
            sum(share * dr.gather(mi.Float, self._texels, at + k, active) for at, share in taps)
            for k in range(self._channels)
        ]

    def _beside(self, place: Any, size: Any) -> tuple[Any, Any, Any]:
        wide = mi.Float(size)
        inside = place - dr.floor(place) if self._wrap else dr.clip(place, 0, 1)
        at = inside * wide - 0.5
        low = dr.floor(at)
        first, most = mi.Int32(low), mi.Int32(size) - 1
        second = first + 1
        if self._wrap:
            first = dr.select(first < 0, most, first)
            second = dr.select(second > most, 0, second)
        return mi.UInt32(dr.clip(first, 0, most)), mi.UInt32(dr.clip(second, 0, most)), at - low


def _known(light: Numbers, view: Numbers, level: Any) -> dict[str, Any]:
    total = [a + b for a, b in zip(light, view, strict=True)]
    length = dr.sqrt(sum(x * x for x in total))
    none = length < 1e-6
    half = [dr.select(none, pole, x / dr.maximum(length, 1e-6))
            for x, pole in zip(total, (0, 0, 1), strict=True)]  # fmt: skip
    found = dict(zip(("lx", "ly", "lz", "vx", "vy", "vz"), (*light, *view), strict=True))
    found |= dict(zip(("hx", "hy", "hz"), half, strict=True))
    found |= {"cos_diff": dr.select(none, 0, length / 2), "level": level / LEVELS_UNIT}
    found["curvature"] = 0 * level
    for name, way in (("l", light), ("v", view)):
        sine = dr.sqrt(way[0] * way[0] + way[1] * way[1])
        stretch = dr.select(sine > 1e-6, dr.atan2(sine, way[2]) / dr.maximum(sine, 1e-6), 1)
        for axis, x in zip("xy", way, strict=False):
            found[f"{name}{axis}_disc"] = x * stretch * (2 / np.pi)
    return found


def _run(layers: Sequence[Dense], x: Numbers, *, rounded: bool) -> Numbers:
    for k, layer in enumerate(layers):
        sums = []
        for row, bias in zip(layer.weight.tolist(), layer.bias.tolist(), strict=True):
            total = mi.Float(bias)
            for weight, value in zip(row, x, strict=True):
                total = dr.fma(weight, value, total)
            sums.append(total)
        if layer.gain is not None and layer.centre is not None:
            sums = _normalised(sums, layer.gain.tolist(), layer.centre.tolist())
        y = [_activated(layer, layer.omega * z if layer.omega != 1 else z) for z in sums]
        if rounded and k + 1 < len(layers):
            y = [_bfloat16(value) for value in y]
        x = [a + b for a, b in zip(x, y, strict=True)] if layer.residual else y
    return x


def _normalised(sums: Numbers, gain: list[float], centre: list[float]) -> Numbers:
    mean = sum(sums) / len(sums)
    apart = [z - mean for z in sums]
    scale = 1 / dr.sqrt(sum(z * z for z in apart) / len(sums) + EPSILON)
    return [z * scale * g + c for z, g, c in zip(apart, gain, centre, strict=True)]


def _activated(layer: Dense, z: Any) -> Any:
    if layer.activation == "relu":
        return dr.maximum(z, 0)
    if layer.activation == "leaky":
        return dr.maximum(z, LEAK * z)
    return dr.sin(z) if layer.activation == "sine" else z


def _bfloat16(x: Any) -> Any:
    bits = dr.reinterpret_array(mi.UInt32, x)
    near = (bits + 0x7FFF + ((bits >> 16) & 1)) & 0xFFFF0000
    return dr.reinterpret_array(mi.Float, near)


def _sigmoid(x: Any) -> Any:
    return 1 / (1 + dr.exp(-x))


def _expm1(x: Any) -> Any:
    return dr.exp(x) - 1
