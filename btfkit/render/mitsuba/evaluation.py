"""A program traced by Dr.Jit: weights as literals, textures as buffers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple, final

import drjit as dr
import mitsuba as mi

from btfkit.conventions import (
    LOWEST_COSINE,
    LOWEST_SEEN,
    MOST_LOG,
    displacement,
)
from btfkit.native.neural.plain import YUV_TO_RGB
from btfkit.program import (
    Dense,
    DepthNetwork,
    Heights,
    OffsetNetwork,
    Program,
    Texture,
    frame_products,
)
from btfkit.render.mitsuba import layers
from btfkit.render.mitsuba.march import Met, on_curved, on_plane, turned
from btfkit.render.mitsuba.pyramid import Pyramid, Surface
from btfkit.render.picture import to_rgb

Numbers = list[Any]
# 38,000 took LLVM nine minutes, 3,000 five seconds.
MOST_WEIGHTS = 12000


class Seen(NamedTuple):
    """All that does not depend on the light.

    Attributes:
        uv, view: as asked. met: where the view ray ends. level: of detail.
        turned: the view in the frame where the ray ends.
        offset: how far a network moves lookups, u and v. values: numbers of the textures that no
            light moves, by name. begun: sums of the first layer over what no light changes.
    """

    uv: Numbers
    view: Numbers
    met: Met
    offset: Numbers
    level: Any
    curvature: Any
    turned: Numbers
    values: dict[str, Numbers]
    begun: Numbers


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
        weights = sum(layer.weight.size for layer in program.every_layer)
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
        self._own = [Pyramid(part.texture.levels[:1], program.wrap) for part in program.networks]
        self._early, self._late, self._layers = _parted(program)

    @property
    def passes(self) -> bool:
        """Whether view rays may pass the material: where it is partly covered, or curved."""
        return self._program.opacity != "none"

    @property
    def bends(self) -> bool:
        """Whether answers depend on curvature."""
        return self._program.bends

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
        met, offset = self._met(uv, view, level, bent, active)
        turn = view
        if self._program.curved:
            turn = turned(view, view, met.turn)
            turn[2] = dr.select(met.turn == 0, turn[2], dr.maximum(turn[2], LOWEST_SEEN))
        found = Seen(uv, view, met, offset, level, bent, turn, {}, [])
        for texture in self._textures:
            if not texture.light:
                found.values[texture.name] = self._looked_up(texture, found, None, active)
        if not self._early:
            return found
        known = layers.known(turn, turn, level, bent)
        for texture in program.textures:
            if not texture.light:
                known |= dict(zip(texture.features, found.values[texture.name], strict=True))
        early, first = self._early
        return found._replace(begun=layers.sums(first, [known[name] for name in early]))

    def answer(self, seen: Seen, light: Numbers, active: Any) -> tuple[Numbers, Any]:
        """Reflectance by channel under a light, and opacity."""
        program = self._program
        values = dict(seen.values)
        for texture in self._textures:
            if texture.light:
                values[texture.name] = self._looked_up(texture, seen, light, active)
        toward = turned(light, seen.view, seen.met.turn) if self._program.curved else light
        known = layers.known(toward, seen.turned, seen.level, seen.curvature)
        for texture in program.textures:
            known |= dict(zip(texture.features, values[texture.name], strict=True))
        names = iter(frame_products(program.frames))
        half = [known[name] for name in ("hx", "hy", "hz")]
        for k in range(program.frames):
            axis = values[program.textures[0].name][3 * k : 3 * k + 3]
            for direction in (half, toward):
                known[next(names)] = sum(a * b for a, b in zip(axis, direction, strict=True))
        raw = self._run(known, seen.begun, active)
        white = values[program.scaling.name] if program.scaling else None
        rgb, opacity = self._output(raw, toward, white)
        if program.opacity == "march":
            # Zero, not masked: what is masked would be compiled once more.
            lit = (seen.met.opacity > 0) & (toward[2] > 0)
            rgb, opacity = [dr.select(lit, value, 0) for value in rgb], seen.met.opacity
        if program.opacity == "network":
            opacity = seen.met.opacity
            rgb = [dr.select(opacity > 0, value, 0) for value in rgb]
        return rgb, opacity

    def place(self, seen: Seen) -> Numbers:
        """Where on the tile the view ray ends, u and v."""
        low = dr.maximum(seen.view[2], LOWEST_COSINE)
        moves = displacement(seen.view[0], seen.view[1], low, self._program.aspect)
        moved = [x + seen.met.depth * move for x, move in zip(seen.uv, moves, strict=True)]
        return [x + move for x, move in zip(moved, seen.offset, strict=True)]

    def opacity(self, seen: Seen, active: Any) -> Any:
        """Of a view alone, however it is lit."""
        if self._program.opacity == "head":
            # The head hears of the light, too; it was trained to tell all lights the same.
            return self.answer(seen, [0 * seen.level, 0 * seen.level, 1 + 0 * seen.level], active)[
                1
            ]
        return seen.met.opacity

    def _run(self, known: dict[str, Any], begun: Numbers, active: Any) -> Numbers:
        """The layers, as a function of the kernel: an evaluation and a sample both call it.

        Unrolled twice they leave the processor's cache of instructions, and take twice as long.
        """
        x = [known[name] for name in self._late]
        if not self._layers:
            return x
        rounded, count = self._program.rounded, len(self._layers[-1].bias)

        def asked(begun: Numbers, x: Numbers) -> Numbers:
            return layers.run(self._layers, x, rounded=rounded, begun=begun or None)

        def idle(begun: Numbers, x: Numbers) -> Numbers:
            return [mi.Float(0)] * count

        # Two of them: a single one would be unrolled where it is called.
        which = dr.select(active, mi.UInt32(0), 1)
        found: Numbers = dr.switch(which, [asked, idle], begun, x)
        return found

    def _met(
        self, uv: Numbers, view: Numbers, level: Any, bent: Any, active: Any
    ) -> tuple[Met, Numbers]:
        """Where view rays end, and how far a network moves lookups."""
        program = self._program
        if isinstance(program.depth, Heights):
            return self._marched(program.depth, uv, view, bent, active), [mi.Float(0), mi.Float(0)]
        depth, opacity, none = mi.Float(0), mi.Float(1), mi.Float(0)
        offset = [none, none]
        for part, texture in zip(program.networks, self._own, strict=True):
            psi = texture(uv[0], uv[1], 0 * uv[0], active)
            known = layers.known(view, view, level, bent)
            known |= dict(zip(part.texture.features, psi, strict=True))
            inputs = [known[name] for name in part.inputs]
            numbers = layers.run(part.layers, inputs, rounded=program.rounded)
            if isinstance(part, DepthNetwork):
                depth = numbers[0] * float(part.scale)
            elif isinstance(part, OffsetNetwork):
                offset = numbers
            elif part.kind == "direct":
                opacity = layers.sigmoid(numbers[0])
            else:
                opacity = dr.select(view[2] >= numbers[0], mi.Float(1), 0)
        return Met(depth, opacity, none), offset

    def _marched(self, found: Heights, uv: Numbers, view: Numbers, bent: Any, active: Any) -> Met:
        program, whole, none = self._program, mi.Float(1), mi.Float(0)
        if self._holes is not None:
            return on_curved(
                found, self._surface, self._holes, uv, view, bent, program.aspect, active
            )
        flat = on_plane(found, self._surface, uv, view, program.aspect, active)
        if not found.curved:
            return Met(flat, whole, none)
        bends = active & (bent != 0)
        met = on_curved(found, self._surface, None, uv, view, bent, program.aspect, bends)
        return Met(*(dr.select(bends, a, b) for a, b in zip(met, (flat, whole, none), strict=True)))

    def _looked_up(
        self, texture: Texture, seen: Seen, light: Numbers | None, active: Any
    ) -> Numbers:
        place = list(seen.uv)
        if isinstance(self._program.depth, OffsetNetwork):
            if texture.view:
                place = [x + float(texture.view) * move
                         for x, move in zip(place, seen.offset, strict=True)]  # fmt: skip
        elif self._program.depth is not None:
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
        opacity = layers.sigmoid(heads["opacity"][0]) if "opacity" in heads else mi.Float(1)
        if self._program.output == "cosine":
            return [value * light[2] for value in heads["linear"]], opacity
        if self._program.output == "linear":
            return [dr.maximum(value, 0) for value in heads["linear"]], opacity
        masks = [0.1 + layers.sigmoid(mask) for mask in heads.get("mask", [])]
        if self._program.output == "released":
            logs = [dr.minimum(y, MOST_LOG) for y in heads["log"]]
            sums = [sum(float(m) * y for m, y in zip(row, logs, strict=True)) for row in YUV_TO_RGB]
            values = [layers.expm1(dr.minimum(y, MOST_LOG)) for y in sums]
            return [dr.maximum(v * m, 0) for v, m in zip(values, masks, strict=True)], opacity
        logs = heads["log"]
        if white is not None:
            c = len(logs)
            logs = [white[k] + white[c + k] * y for k, y in enumerate(logs)]
        if masks:
            logs = [y * mask for y, mask in zip(logs, masks, strict=True)]
        return [layers.expm1(dr.clip(y, 0, MOST_LOG)) for y in logs], opacity


def _parted(program: Program) -> tuple[Any, tuple[str, ...], tuple[Dense, ...]]:
    """Inputs that no light changes with their part of the first layer, the others, the layers."""
    names = program.inputs
    if not program.layers or program.layers[0].residual:
        return None, names, program.layers
    lit = {"lx", "ly", "lz", "hx", "hy", "hz", "cos_diff", "lx_disc", "ly_disc"}
    lit |= {name for t in program.textures if t.light for name in t.features}
    late = [name in lit or name.startswith("frame.") for name in names]
    first, *rest = program.layers
    early, after = ([k for k, each in enumerate(late) if each == which] for which in (False, True))
    part = (tuple(names[k] for k in early), replace(first, weight=first.weight[:, early]))
    others = tuple(names[k] for k in after)
    return part, others, (replace(first, weight=first.weight[:, after]), *rest)
