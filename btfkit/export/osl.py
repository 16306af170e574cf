"""A program as a function in Open Shading Language, its textures as EXR of three channels.

Scalars and unrolled layers; texels are fetched one by one, since a renderer's own filters are
not ours. Four channels would be multiplied by the fourth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.conventions import EPSILON, LEAK, LEVELS_UNIT, LOOKS, LOWEST_COSINE, MOST_LOG, STEEPEST
from btfkit.export.numbers import literal
from btfkit.export.sections import filled, sections
from btfkit.native.neural.plain import YUV_TO_RGB
from btfkit.program import Dense, Heights, OffsetNetwork, Program, Texture

Array = NDArray[Any]
# Each becomes a term of an expression.
MOST_WEIGHTS = 12000
_INPUTS = {
    **{f"{d}{axis}": f"{name}[{k}]"
       for d, name in (("l", "light"), ("v", "view"), ("h", "halfway"))
       for k, axis in enumerate("xyz")},
    **{f"{d}{axis}_disc": f"{name}_disc[{k}]"
       for d, name in (("l", "light"), ("v", "view")) for k, axis in enumerate("xy")},
    "cos_diff": "cos_diff", "level": f"(level / {LEVELS_UNIT}.0)", "curvature": "0.0",
}  # fmt: skip


@final
@dataclass(frozen=True, eq=False)
class Written:
    """A function in OSL and what it reads.

    Attributes:
        text: the functions `btfkit_evaluate` and, where there are heights, `btfkit_depth`.
        textures: (h, w, 3) float32 by the name of its parameter and file.
    """

    text: str
    textures: dict[str, Array]


def written(program: Program) -> Written:
    """The functions of a program.

    Curved heights answer as on the plane.

    Raises:
        TypeError: networks that are too large, rounded, or that OSL is not written for.
    """
    if program.cover is not None or isinstance(program.depth, OffsetNetwork):
        raise TypeError(
            "this material has networks of opacity and offset of its own, which OSL is not "
            "written for; expected one whose rays end at heights or by a network of depth"
        )
    if isinstance(program.depth, Heights) and program.depth.opacity is not None:
        raise TypeError(
            "the heights of this material have holes, which OSL is not written for; expected "
            "heights without"
        )
    if program.rounded:
        raise TypeError("networks rounded to bfloat16 have no form in OSL; fit with float32 ones")
    layers = [*program.layers, *getattr(program.depth, "layers", ())]
    weights = sum(layer.weight.size for layer in layers)
    if weights > MOST_WEIGHTS:
        raise TypeError(f"networks of {weights} weights; OSL takes at most {MOST_WEIGHTS} here")
    return _Writer(program).written()


class _Writer:
    def __init__(self, program: Program) -> None:
        self.program = program
        self.textures: dict[str, Array] = {}

    def written(self) -> Written:
        program = self.program
        parts = sections("material.osl.txt")
        depth = self._depth()
        body = [*self._features(), *self._answer()]
        names = ", ".join(f"string {name}" for name in self.textures)
        values: dict[str, object] = {
            "files": names, "given": ", ".join(self.textures), "aspect": literal(program.aspect),
            "lowest": literal(LOWEST_COSINE), "steepest": literal(STEEPEST), "looks": LOOKS,
            "leak": literal(LEAK), "depth": "\n".join(f"  {line}" for line in depth),
            "body": "\n".join(f"  {line}" for line in body),
            "level": "log2(2.0 * clamp(footprint, 0.5, 1e30))" if program.leveled else "0.0",
            "reduced": "x - floor(x)" if program.wrap else "clamp(x, 0.0, 1.0)",
            "wrapped": "(k + n) % n" if program.wrap else "clamp(k, 0, n - 1)",
            "lit": "1" if program.full_sphere else "light[2] > 0.0",
        }  # fmt: skip
        chosen = ["start"]
        if isinstance(program.depth, Heights):
            h, w = program.depth.heights.shape
            top, bottom = program.depth.heights.max(), program.depth.heights.min()
            values |= {"h": h, "w": w, "top": literal(top), "rise": literal(top - bottom),
                       "scale": literal(program.depth.scale)}  # fmt: skip
            chosen.append("march")
        chosen += ["depth", "evaluate"]
        return Written(filled("".join(parts[name] for name in chosen), **values), self.textures)

    def _depth(self) -> list[str]:
        found = self.program.depth
        if found is None:
            return ["return 0.0;"]
        if isinstance(found, Heights):
            self.textures["btfkit_heights"] = np.repeat(found.heights[..., None], 3, axis=2)
            return ["return btfkit_march(btfkit_heights, u, v, view);"]
        assert not isinstance(found, OffsetNetwork)  # `written` refuses it
        lines, values = self._looked(found.texture, "u", "v", "0.0")
        known = dict(_INPUTS) | values
        lines = ["vector light = view;", *_HALF, *_discs(found.inputs), *lines]
        some, raw = _layers("d", found.layers, [known[name] for name in found.inputs])
        return [*lines, *some, f"return ({raw[0]}) * {literal(found.scale)};"]

    def _features(self) -> list[str]:
        program, lines = self.program, []
        self._known: dict[str, str] = dict(_INPUTS)
        lines += _HALF + _discs(program.inputs)
        for texture in [*program.textures, *([program.scaling] if program.scaling else [])]:
            at = ["u", "v"]
            if program.depth is not None and (texture.view or texture.light):
                for k, sign in ((0, ""), (1, f"{literal(-program.aspect)} * ")):
                    for way, share in (("view", texture.view), ("light", -texture.light)):
                        if share:
                            at[k] += (f" + depth * {literal(share)} * {sign}{way}[{k}] / "
                                      f"max({way}[2], {literal(LOWEST_COSINE)})")  # fmt: skip
            some, values = self._looked(texture, at[0], at[1], "level")
            lines += some
            self._known |= values
        first = program.textures[0].features
        for k in range(program.frames):
            axis = ", ".join(self._known[name] for name in first[3 * k : 3 * k + 3])
            lines.append(f"vector axis_{k} = vector({axis});")
            for name, way in (("half", "halfway"), ("light", "light")):
                self._known[f"frame.{k}.{name}"] = f"dot(axis_{k}, {way})"
        return lines

    def _looked(
        self, texture: Texture, u: str, v: str, level: str
    ) -> tuple[list[str], dict[str, str]]:
        """Statements that read a texture, and what its features are called then."""
        name = "btfkit_" + texture.name.replace(".", "_")
        h, w = sum(x.shape[0] for x in texture.levels), max(x.shape[1] for x in texture.levels)
        channels, count = texture.levels[0].shape[-1], len(texture.levels)
        groups = -(-channels // 3)
        held = np.zeros((groups, h, w, 3), np.float32)
        tops = np.cumsum([0, *(x.shape[0] for x in texture.levels)])
        for top, x in zip(tops, texture.levels, strict=False):
            for c in range(channels):
                held[c // 3, top : top + x.shape[0], : x.shape[1], c % 3] = x[..., c]
        lines = [f"float {name}_u = {u}, {name}_v = {v};"]
        sizes = ", ".join(f"{top}, {x.shape[0]}, {x.shape[1]}"
                          for top, x in zip(tops, texture.levels, strict=False))  # fmt: skip
        lines.append(f"int {name}_levels[{3 * count}] = {{{sizes}}};")
        shift = literal(texture.shift)
        lines.append(f"float {name}_at = clamp({level} - {shift}, 0.0, {count - 1}.0);")
        values = {}
        for g in range(groups):
            own = f"{name}_{g}"
            self.textures[own] = held[g]
            lines.append(f"color {own}_ = btfkit_lookup({own}, {name}_levels, {count}, "
                         f"{name}_at, {name}_u, {name}_v, {w}, {h});")  # fmt: skip
            for k in range(3):
                if 3 * g + k < channels:
                    values[texture.features[3 * g + k]] = f"{own}_[{k}]"
        return lines, values

    def _answer(self) -> list[str]:
        program = self.program
        lines, raw = _layers("h", program.layers, [self._known[n] for n in program.inputs])
        heads: dict[str, list[str]] = {}
        for head in program.heads:
            heads[head.kind], raw = raw[: head.count], raw[head.count :]
        if "opacity" in heads:
            lines.append(f"opacity = 1.0 / (1.0 + exp(-({heads['opacity'][0]})));")
        masks = [f"(0.1 + 1.0 / (1.0 + exp(-({x}))))" for x in heads.get("mask", [])]
        most = literal(MOST_LOG)
        if program.output == "cosine":
            values = [f"({x}) * light[2]" for x in heads["linear"]]
        elif program.output == "released":
            logs = [f"min({x}, {most})" for x in heads["log"]]
            sums = [" + ".join(f"{literal(m)} * {y}" for m, y in zip(row, logs, strict=True))
                    for row in YUV_TO_RGB]  # fmt: skip
            values = [f"max((exp(min({y}, {most})) - 1.0) * {mask}, 0.0)"
                      for y, mask in zip(sums, masks, strict=True)]  # fmt: skip
        else:
            logs = heads["log"]
            if program.scaling:
                names = program.scaling.features
                c = len(logs)
                logs = [f"({self._known[names[k]]} + {self._known[names[c + k]]} * ({y}))"
                        for k, y in enumerate(logs)]  # fmt: skip
            if masks:
                logs = [f"({y}) * {mask}" for y, mask in zip(logs, masks, strict=True)]
            values = [f"expm1(clamp({y}, 0.0, {most}))" for y in logs]
        return lines + _coloured(program.channels, values)


_HALF = [
    "vector both = light + view;",
    "float span = length(both);",
    "vector halfway = span < 1e-6 ? vector(0.0, 0.0, 1.0) : both / max(span, 1e-6);",
    "float cos_diff = span < 1e-6 ? 0.0 : span / 2.0;",
]


def _discs(inputs: Sequence[str]) -> list[str]:
    ways = [way for way in ("light", "view") if f"{way[0]}x_disc" in inputs]
    return [f"vector {way}_disc = btfkit_disc({way});" for way in ways]


def _coloured(channels: tuple[str, ...], values: list[str]) -> list[str]:
    """Linear RGB of the channels."""
    from btfkit.render.studio import visible

    to = visible(channels)
    lines = [f"float value_{k} = {x};" for k, x in enumerate(values)]
    sums = [" + ".join(f"{literal(m)} * value_{k}" for k, m in enumerate(to[:, c]) if m) or "0.0"
            for c in range(3)]  # fmt: skip
    return [*lines, f"rgb = color({', '.join(sums)});"]


def _layers(name: str, layers: Sequence[Dense], x: list[str]) -> tuple[list[str], list[str]]:
    """Statements that take scalars through layers, and the names of the last."""
    lines: list[str] = []
    for k, layer in enumerate(layers):
        own = [f"{name}{k}_{o}" for o in range(len(layer.bias))]
        for o, (row, bias) in enumerate(zip(layer.weight, layer.bias, strict=True)):
            terms = [
                literal(bias),
                *(f"{literal(number)}*{v}" for number, v in zip(row, x, strict=True) if number),
            ]
            lines.append(f"float {own[o]} = {' + '.join(terms)};")
        if layer.gain is not None and layer.centre is not None:
            n, mean, scale = literal(len(own)), f"{name}{k}_mean", f"{name}{k}_scale"
            lines.append(f"float {mean} = ({' + '.join(own)}) / {n};")
            squares = " + ".join(f"({o} - {mean})*({o} - {mean})" for o in own)
            lines.append(f"float {scale} = 1.0 / sqrt(({squares}) / {n} + {literal(EPSILON)});")
            lines += [f"{o} = ({o} - {mean}) * {scale} * {literal(g)} + {literal(c)};"
                      for o, g, c in zip(own, layer.gain, layer.centre, strict=True)]  # fmt: skip
        for to, before in zip(own, x if layer.residual else [""] * len(own), strict=True):
            value = to if layer.omega == 1 else f"({literal(layer.omega)} * {to})"
            value = _ACTIVATED[layer.activation].format(value)
            lines.append(f"{to} = {before} + {value};" if before else f"{to} = {value};")
        x = own
    return lines, x


_ACTIVATED = {
    "linear": "{0}",
    "relu": "max({0}, 0.0)",
    "leaky": f"max({{0}}, {literal(LEAK)} * {{0}})",
    "sine": "sin({0})",
}


def parameters(written_: Written) -> str:
    """The shader parameters that its textures are."""
    return "".join(f'  string {name} = "{name}.exr",\n' for name in written_.textures)
