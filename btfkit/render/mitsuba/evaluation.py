"""A program traced by Dr.Jit: weights as literals, textures as buffers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, final

import drjit as dr
import mitsuba as mi
import numpy as np

from btfkit.conventions import (
    CURVATURE_UNIT,
    EPSILON,
    LEAK,
    LEVELS_UNIT,
    LOWEST_COSINE,
    LOWEST_SEEN,
    MOST_LOG,
    displacement,
)
from btfkit.native.neural.plain import YUV_TO_RGB
from btfkit.program import Dense, Heights, OffsetNetwork, Program, Texture, frame_products
from btfkit.render.mitsuba.march import Met, on_curved, on_plane, turned
from btfkit.render.mitsuba.pyramid import Pyramid, Surface
from btfkit.render.picture import to_rgb

Numbers = list[Any]
_TOGETHER = 8
# 38,000 took LLVM nine minutes, 3,000 five seconds.
MOST_WEIGHTS = 12000


class Seen(NamedTuple):
    """All that does not depend on the light.

    Attributes:
        uv, view: as asked. met: where the view ray ends. level: of detail.
        turned: the view in the frame where the ray ends.
        values: numbers of the textures that no light moves, by name.
    """

    uv: Numbers
    view: Numbers
    met: Met
    level: Any
    curvature: Any
    turned: Numbers
    values: dict[str, Numbers]


@final
class Evaluation:
    """The evaluation of a program in the variant that is set.

    Args:
        program: what is computed.

    Attributes:
        pyramids: the textures by name; gradients may flow into their `texels`.
        rgb: (c, 3) rows from channels to linear RGB.

    Raises:
        TypeError: too large networks.
    """

    def __init__(self, program: Program) -> None:
        found = program.depth
        if program.cover is not None or isinstance(found, OffsetNetwork):
            raise TypeError(
                "this material has networks of opacity and offset of its own, which are not "
                "traced; expected one whose rays end at heights or by a network of depth"
            )
        depth_layers = getattr(found, "layers", ())
        weights = sum(layer.weight.size for layer in (*program.layers, *depth_layers))
        if weights > MOST_WEIGHTS:
            raise TypeError(
                f"networks of {weights} weights, each of which becomes an instruction; expected "
                f"at most {MOST_WEIGHTS}: fit a smaller model, or export to C++"
            )
        self._program = program
        self.rgb = to_rgb(program.channels).tolist()
        self._textures = [*program.textures, *([program.scaling] if program.scaling else [])]
        self.pyramids = {t.name: Pyramid(t.levels, program.wrap) for t in self._textures}
        if isinstance(found, Heights):
            self._surface = Surface(found.heights, program.wrap)
            self._holes = None
            if found.opacity is not None:
                self._holes = Surface(found.opacity, program.wrap)
        elif found is not None:
            self._offset = Pyramid(found.texture.levels[:1], program.wrap)

    @property
    def passes(self) -> bool:
        """Whether view rays may pass the material: where it is partly covered, or curved."""
        return self._program.opacity != "none"

    @property
    def curved(self) -> bool:
        """Whether curvature bends view rays."""
        return isinstance(self._program.depth, Heights) and self._program.depth.curved

    def __call__(
        self,
        uv: Numbers,
        light: Numbers,
        view: Numbers,
        footprint: Any,
        active: Any,
        curvature: Any = 0.0,
    ) -> tuple[Numbers, Any]:
        """Reflectance by channel, and opacity.

        Args:
            uv: u and v, in one tile or clamped to it. light, view: x, y, z of unit vectors.
            footprint: texels of the data's grid. active: which lanes are asked.
            curvature: along the projected view ray, 1/tile width.
        """
        return self.answer(self.seen(uv, view, footprint, active, curvature), light, active)

    def seen(
        self, uv: Numbers, view: Numbers, footprint: Any, active: Any, curvature: Any = 0.0
    ) -> Seen:
        """The part of an answer that all lights of a view share; arguments as in a call."""
        program = self._program
        level = dr.log2(2 * dr.clip(footprint, 0.5, 1e30)) if program.leveled else 0 * footprint
        bent = mi.Float(curvature)
        met = self._met(uv, view, level, bent, active)
        turn = view
        if self.curved:
            turn = turned(view, view, met.turn)
            turn[2] = dr.select(met.turn == 0, turn[2], dr.maximum(turn[2], LOWEST_SEEN))
        found = Seen(uv, view, met, level, bent, turn, {})
        for texture in self._textures:
            if not texture.light:
                found.values[texture.name] = self._looked_up(texture, found, None, active)
        return found

    def answer(self, seen: Seen, light: Numbers, active: Any) -> tuple[Numbers, Any]:
        """Reflectance by channel under a light, and opacity."""
        program = self._program
        values = dict(seen.values)
        for texture in self._textures:
            if texture.light:
                values[texture.name] = self._looked_up(texture, seen, light, active)
        toward = turned(light, seen.view, seen.met.turn) if self.curved else light
        known = _known(toward, seen.turned, seen.level, seen.curvature)
        for texture in program.textures:
            known |= dict(zip(texture.features, values[texture.name], strict=True))
        names = iter(frame_products(program.frames))
        half = [known[name] for name in ("hx", "hy", "hz")]
        for k in range(program.frames):
            axis = values[program.textures[0].name][3 * k : 3 * k + 3]
            for direction in (half, toward):
                known[next(names)] = sum(a * b for a, b in zip(axis, direction, strict=True))
        raw = self._run(known)
        white = values[program.scaling.name] if program.scaling else None
        rgb, opacity = self._output(raw, toward, white)
        if program.opacity == "march":
            # Zero, not masked: what is masked would be compiled once more.
            lit = (seen.met.opacity > 0) & (toward[2] > 0)
            rgb, opacity = [dr.select(lit, value, 0) for value in rgb], seen.met.opacity
        return rgb, opacity

    def place(self, seen: Seen) -> Numbers:
        """Where on the tile the view ray ends, u and v."""
        low = dr.maximum(seen.view[2], LOWEST_COSINE)
        moves = displacement(seen.view[0], seen.view[1], low, self._program.aspect)
        return [x + seen.met.depth * move for x, move in zip(seen.uv, moves, strict=True)]

    def opacity(self, seen: Seen, active: Any) -> Any:
        """Of a view alone, however it is lit."""
        if self._program.opacity == "head":
            # The head hears of the light, too; it was trained to tell all lights the same.
            return self.answer(seen, [0 * seen.level, 0 * seen.level, 1 + 0 * seen.level], active)[
                1
            ]
        return seen.met.opacity

    def _run(self, known: dict[str, Any]) -> Numbers:
        """The layers; numbers of the view are summed first, so that lights share the sums."""
        program = self._program
        names = program.inputs
        if not program.layers:
            return [known[name] for name in names]
        lit = {"lx", "ly", "lz", "hx", "hy", "hz", "cos_diff", "lx_disc", "ly_disc"}
        lit |= {name for t in program.textures if t.light for name in t.features}
        late = [name in lit or name.startswith("frame.") for name in names]
        order = sorted(range(len(names)), key=lambda k: late[k])
        first, *rest = program.layers
        if not first.residual:
            first = replace(first, weight=first.weight[:, order])
            names = tuple(names[k] for k in order)
        return _run([first, *rest], [known[n] for n in names], rounded=program.rounded)

    def _met(self, uv: Numbers, view: Numbers, level: Any, bent: Any, active: Any) -> Met:
        program, found = self._program, self._program.depth
        whole, none = mi.Float(1), mi.Float(0)
        if found is None:
            return Met(none, whole, none)
        if isinstance(found, Heights):
            if self._holes is not None:
                return on_curved(
                    found, self._surface, self._holes, uv, view, bent, program.aspect, active
                )
            flat = on_plane(found, self._surface, uv, view, program.aspect, active)
            if not found.curved:
                return Met(flat, whole, none)
            bends = active & (bent != 0)
            met = on_curved(found, self._surface, None, uv, view, bent, program.aspect, bends)
            return Met(
                *(dr.select(bends, a, b) for a, b in zip(met, (flat, whole, none), strict=True))
            )
        assert not isinstance(found, OffsetNetwork)  # refused when this was made
        psi = self._offset(uv[0], uv[1], 0 * uv[0], active)
        columns = _known(view, view, level, none)
        columns |= dict(zip(found.texture.features, psi, strict=True))
        inputs = [columns[name] for name in found.inputs]
        depth = _run(found.layers, inputs, rounded=program.rounded)[0] * float(found.scale)
        return Met(depth, whole, none)

    def _looked_up(
        self, texture: Texture, seen: Seen, light: Numbers | None, active: Any
    ) -> Numbers:
        place = list(seen.uv)
        if self._program.depth is not None:
            for way, share in ((seen.view, texture.view), (light, -texture.light)):
                if not share or way is None:
                    continue
                moves = displacement(
                    way[0], way[1], dr.maximum(way[2], LOWEST_COSINE), self._program.aspect
                )
                place = [x + seen.met.depth * float(share) * move
                         for x, move in zip(place, moves, strict=True)]  # fmt: skip
        level = seen.level - float(texture.shift)
        return self.pyramids[texture.name](place[0], place[1], level, active)

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


def _known(light: Numbers, view: Numbers, level: Any, curvature: Any) -> dict[str, Any]:
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


def _run(layers: Sequence[Dense], x: Numbers, *, rounded: bool) -> Numbers:
    for k, layer in enumerate(layers):
        weights = layer.weight.tolist()
        sums = [mi.Float(bias) for bias in layer.bias.tolist()]
        # A few sums at a time: as many chains as the units take, and they stay in registers.
        for first in range(0, len(sums), _TOGETHER):
            rows = range(first, min(first + _TOGETHER, len(sums)))
            for column, value in enumerate(x):
                for row in rows:
                    sums[row] = dr.fma(weights[row][column], value, sums[row])
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
