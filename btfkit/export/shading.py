"""A program as one function over buffers, in WGSL and in Slang: they differ in spelling alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, final

import numpy as np
from numpy.typing import NDArray

from btfkit.conventions import EPSILON, LEAK, LOOKS, LOWEST_COSINE, STEEPEST
from btfkit.export import curvature
from btfkit.export.arrays import holes, narrowed, textures
from btfkit.export.glsl.code import (
    VECTORS,
    groups_of,
    places,
    reflectance,
    sources_of,
    told,
    variable,
)
from btfkit.export.glsl.layers import Source, Weights, arranged, component, grouped, padded
from btfkit.export.numbers import literal
from btfkit.export.sections import filled, sections
from btfkit.program import Cover, Dense, DepthNetwork, Heights, OffsetNetwork, Program, Texture

Array = NDArray[Any]
Language = Literal["wgsl", "slang"]


@final
@dataclass(frozen=True, eq=False)
class Shaded:
    """A function, and the buffers that it reads.

    Attributes:
        text: of the function `btfkit_evaluate` and what it calls.
        buffers: bytes by name, in the order of their bindings: `weights` and `heights` float32,
            `texels`. None is empty.
        half: whether texels are float16, which loses nothing then; else they are float32.
        starts: by the name of a texture, which texel each of its levels begins with.
    """

    text: str
    buffers: dict[str, bytes]
    half: bool
    starts: dict[str, list[int]]


def shaded(
    program: Program, language: Language, *, model: str, in_textures: bool = False
) -> Shaded:
    """The function of a program in a language, and its buffers.

    Args:
        in_textures: WGSL alone: whether the function is given two textures of 1024 columns, texels
            and numbers (weights, then heights, four a texel), instead of reading buffers.
    """
    return _Writer(program, language, in_textures=in_textures).written(model)


class _Writer:
    """Statements of one function, and the numbers that they read."""

    def __init__(self, program: Program, language: Language, *, in_textures: bool) -> None:
        self.program, self.language, self._in_textures = program, language, in_textures
        self._starts: dict[str, list[int]] = {}
        self.weights = Weights()
        self.texels: list[Array] = []
        self.functions: list[str] = []
        self._at = 0
        every = [level for texture in textures(program) for level in texture.levels]
        self._half = all(narrowed(level).dtype == np.float16 for level in every)

    def written(self, model: str) -> Shaded:
        program = self.program
        body = [*self._networks(), *self._features(), *self._answer()]
        parts = sections(f"material.{self.language}.txt")
        values = {**_values(program, model), **curvature.words(program), **self._curvature()}
        nothing = "return BtfkitAnswer(value, 1.0)" if self.language == "wgsl" else "return"
        below = f"  if (!(light{values['in']}.z > 0.0)) {{ {nothing}; }}\n"
        values["below"] = "" if program.full_sphere else below
        first, last = _chosen(program, half=self._half)
        if self._in_textures:
            first[1] = "texel_texture"
            first[2:2] = ["height_texture"] * isinstance(program.depth, Heights)
        values |= self._data()
        buffers: dict[str, bytes] = {}
        if self.weights.rows:
            buffers["weights"] = np.asarray(self.weights.rows, "<f4").tobytes()
        texels = np.concatenate([array.reshape(-1) for array in self.texels])
        buffers["texels"] = texels.astype("<f2" if self._half else "<f4").tobytes()
        if isinstance(program.depth, Heights):
            buffers["heights"] = program.depth.heights.astype("<f4").tobytes()
        named = [*buffers]
        declared = "".join(
            filled(parts[f"buffer_{name}_half" if name == "texels" and self._half
                         else f"buffer_{name}"], binding=k)
            for k, name in enumerate(() if self._in_textures else named)
        )  # fmt: skip
        text = filled(parts["start"], **values) + declared
        text += filled("".join(parts[name] for name in first), **values)
        text += "".join(self.functions)
        text += filled("".join(parts[name] for name in last), **values)
        text += "".join(f"  {line}\n" for line in body) + parts["end"]
        return Shaded(text, buffers, self._half, self._starts)

    # What both languages spell in their own way.

    def _vec4(self, values: Any) -> str:
        return f"{self._type(4)}({', '.join(literal(value) for value in values)})"

    def _type(self, n: int) -> str:
        return f"vec{n}f" if self.language == "wgsl" else f"float{n}"

    def _made(self, name: str, value: str, n: int = 4) -> str:
        """A variable of n numbers."""
        kind = "var" if self.language == "wgsl" else ("float" if n == 1 else self._type(n))
        return f"{kind} {name} = {value};"

    def _array(self, name: str, n: int, values: Sequence[str] = ()) -> str:
        if self.language == "wgsl":
            kind = f"array<vec4f, {n}>"
            return (
                f"var {name} = {kind}({', '.join(values)});" if values else f"var {name}: {kind};"
            )
        return f"float4 {name}[{n}]" + (f" = {{{', '.join(values)}}};" if values else ";")

    def _loop(self, index: str, n: int, lines: Sequence[str]) -> list[str]:
        kind = "var" if self.language == "wgsl" else "int"
        start = f"for ({kind} {index} = 0; {index} < {n}; {index}++) {{"
        return [start, *(f"  {line}" for line in lines), "}"]

    def _int(self, value: str) -> str:
        return f"i32({value})" if self.language == "wgsl" else f"int({value})"

    def _level_function(self, name: str, places: list[tuple[int, int, int]]) -> str:
        wgsl, last = self.language == "wgsl", len(places) - 1
        kind = "vec3i" if wgsl else "int3"
        start = f"fn {name}(n: i32) -> vec3i {{" if wgsl else f"int3 {name}(int n) {{"
        lines = [start, "  switch (n) {"]
        for k, place in enumerate(places):
            case = "default" if k == last else f"case {k}"
            lines.append(f"    {case}: {{ return {kind}{place}; }}")
        return "\n".join([*lines, "  }", "}", ""])

    def _weight(self, at: str) -> str:
        """Four weights."""
        return f"btfkit_number(numbers, {at})" if self._in_textures else f"btfkit_weights[{at}]"

    def _data(self) -> dict[str, object]:
        """How functions take textures and give them on: not at all where they read buffers."""
        kept = self._in_textures
        found: dict[str, object] = {"height": "btfkit_heights[", "height_end": "]"}
        if kept:
            found = {"height": "btfkit_height(numbers, ", "height_end": ")"}
        for name, parts in (("texels", ("texels",)), ("numbers", ("numbers",)),
                            ("both", ("texels", "numbers"))):  # fmt: skip
            found[name] = "".join(f"{part}, " for part in parts) * kept
            taken = "".join(f"{part}: texture_2d<f32>, " for part in parts)
            found[f"take_{name}"] = taken * kept
        return {**found, "first_height": len(self.weights.rows)}

    # The evaluation.

    def _placed(self, texture: Texture) -> list[str]:
        """Puts a texture's levels into the buffer; statements for variables of its features."""
        name, groups = variable(texture), groups_of(texture)
        places = []
        for level in texture.levels:
            h, w, k = level.shape
            held = np.zeros((h, w, groups * 4), np.float32)
            held[..., :k] = level
            places.append((self._at, w, h))
            self._starts.setdefault(texture.name, []).append(self._at)
            self.texels.append(held)
            self._at += h * w * groups
        self.functions.append(self._level_function(f"btfkit_level_{name}", places))
        return [f"{name}_{g}" for g in range(groups)]

    def _looked(self, texture: Texture, place: str, level: str) -> list[str]:
        names, n = self._placed(texture), len(texture.levels)
        own, groups = variable(texture), groups_of(texture)
        lines = [self._made(f"{own}_uv", place, 2)]
        finer = "0"
        if n > 1:
            at = f"clamp({level} - {literal(texture.shift)}, 0.0, {n - 1}.0)"
            lines += [self._made(f"{own}_at", at, 1)]
            lines += [self._made(f"{own}_finer", f"floor({own}_at)", 1)]
            lines += [self._made(f"{own}_share", f"{own}_at - {own}_finer", 1)]
            finer = self._int(f"{own}_finer")
        given = "texels, " * self._in_textures
        look = f"btfkit_lookup({given}btfkit_level_{own}({{}}), {groups}, {{}}, {own}_uv)"
        lines += [self._made(name, look.format(finer, g)) for g, name in enumerate(names)]
        if n > 1:
            lines.append(f"if ({own}_share > 0.0) {{")
            for g, name in enumerate(names):
                coarser = look.format(f"{finer} + 1", g)
                lines.append(f"  {name} += {own}_share * ({coarser} - {name});")
            lines.append("}")
        return lines

    def _vectors(self, inputs: Sequence[str], prefix: str) -> tuple[list[str], list[Source]]:
        lines, found = [], []
        for k, source in enumerate(VECTORS):
            if {*inputs} & {name for name in source.names if name}:
                text = told(source, inputs).replace("vec4(", f"{self._type(4)}(", 1)
                lines.append(self._made(f"{prefix}{k}", text))
                found.append(Source(f"{prefix}{k}", source.names))
        return lines, found

    def _networks(self) -> list[str]:
        """Opacity, and depth or offset, where networks of their own say them."""
        wgsl, found = self.language == "wgsl", []
        for part in self.program.networks:
            name = "c" if isinstance(part, Cover) else "d"
            looked = self._looked(part.texture, "uv", "0.0")
            lines, sources = self._vectors(part.inputs, f"{name}q")
            sources = [*sources_of(part.texture), *sources]
            some, raw = self._layers(name, part.layers, part.inputs, sources)
            found += [*looked, *lines, *some]
            if isinstance(part, DepthNetwork):
                found.append(self._made("depth", f"{raw[0]} * {literal(part.scale)}", 1))
            elif isinstance(part, OffsetNetwork):
                found.append(self._made("offset", f"{self._type(2)}({raw[0]}, {raw[1]})", 2))
            else:
                direct = f"btfkit_sigmoid({raw[0]})"
                seen = self._chosen("1.0", "0.0", f"view.z >= {raw[0]}")
                found.append(f"opacity = {direct if part.kind == 'direct' else seen};")
                back = "return BtfkitAnswer(value, 0.0);" if wgsl else "return;"
                found.append(f"if (!(opacity > 0.0)) {{ {back} }}")
        return found

    def _features(self) -> list[str]:
        return [line for texture, place in places(self.program)
                for line in self._looked(texture, place, "level")]  # fmt: skip

    def _curvature(self) -> dict[str, object]:
        """What the texts say of curvature; of curved heights their numbers, holes included."""
        program, wgsl = self.program, self.language == "wgsl"
        if not program.curved:
            more = ", curvature: f32" if wgsl else "float curvature, "
            return {"more": more * program.bends, "in": ""}
        found, hole = program.depth, ""
        assert isinstance(found, Heights)
        for texture in holes(program):
            self._placed(texture)
            given = "texels, " * self._in_textures
            solid = f"btfkit_lookup({given}btfkit_level_{variable(texture)}(0), 1, 0, at).x"
            hole = curvature.hole(found, solid)
        more = ", curvature_in: f32" if wgsl else "float curvature, "
        return {"more": more, "in": "_in", "hole": hole, **curvature.numbers(found)}

    def _chosen(self, yes: str, no: str, when: str) -> str:
        if self.language == "wgsl":
            return f"select({no}, {yes}, {when})"
        return f"{when} ? {yes} : {no}"

    def _answer(self) -> list[str]:
        program = self.program
        lines, sources = self._vectors(program.inputs, "q")
        first = [s for texture in program.textures for s in sources_of(texture)]
        sources = first + sources
        for f in range(program.frames):
            names = [program.textures[0].features[3 * f + k] for k in range(3)]
            axis = f"{self._type(3)}({', '.join(component(name, first) for name in names)})"
            value = f"{self._type(4)}(dot({axis}, halfway), dot({axis}, light), 0.0, 0.0)"
            lines.append(self._made(f"frame{f}", value))
            sources.append(Source(f"frame{f}", (f"frame.{f}.half", f"frame.{f}.light", "", "")))
        some, raw = self._layers("h", program.layers, program.inputs, sources)
        heads: dict[str, list[str]] = {}
        for head in program.heads:
            heads[head.kind], raw = raw[: head.count], raw[head.count :]
        lines += some
        values = reflectance(program, heads)
        if "opacity" in heads:
            lines.append(f"opacity = btfkit_sigmoid({heads['opacity'][0]});")
            values = [self._chosen(x, "0.0", "opacity > 0.0") for x in values]
        return lines + [f"value[{k}] = {x};" for k, x in enumerate(values)]

    def _layers(
        self, name: str, layers: Sequence[Dense], inputs: Sequence[str], sources: Sequence[Source]
    ) -> tuple[list[str], list[str]]:
        """Statements that take inputs through layers, and the scalars of the last in order."""
        if not layers:
            return [], [component(input_, sources) for input_ in inputs]
        if layers[0].residual:
            raise TypeError("a first layer that adds its inputs has no form in a shader here")
        used = [source for source in sources if any(n in inputs for n in source.names)]
        found = [self._array(f"{name}0", len(used), [source.text for source in used])]
        matrix, width = arranged(layers[0].weight, inputs, used), len(used)
        for k, layer in enumerate(layers):
            if k:
                matrix = padded(layer.weight, 4 * width)
            cut = self.program.rounded and k + 1 < len(layers)
            found += self._layer(f"{name}{k}", f"{name}{k + 1}", layer, matrix, rounded=cut)
            width = len(matrix) // 4
        n, last = len(layers[-1].bias), f"{name}{len(layers)}"
        return found, [f"{last}[{k // 4}].{'xyzw'[k % 4]}" for k in range(n)]

    def _layer(self, x: str, y: str, layer: Dense, matrix: Array, *, rounded: bool) -> list[str]:
        groups, width = len(matrix) // 4, matrix.shape[1] // 4
        blocks = matrix.reshape(groups, 4, width, 4).transpose(0, 2, 3, 1)
        at, bias = self.weights.place(blocks), self.weights.place(grouped(layer.bias))
        kind = "let" if self.language == "wgsl" else "int"
        sums = [f"{kind} k = {at} + (o * {width} + i) * 4;"]
        for c, axis in enumerate("xyzw"):
            sums.append(f"z += {self._weight(f'k + {c}')} * {x}[i].{axis};")
        lines = [self._made("z", self._weight(f"{bias} + o")), *self._loop("i", width, sums)]
        value = _activated(layer, "z", f"{x}[o]", rounded=rounded)
        plain = layer.gain is None or layer.centre is None
        lines.append(f"{y}[o] = {value if plain else 'z'};")
        found = [self._array(y, groups), *self._loop("o", groups, lines)]
        if layer.gain is None or layer.centre is None:
            return found
        # Sums of rows beyond the last output are 0; `mask` keeps them so.
        n, own = literal(len(layer.bias)), f"{y}_"
        mask, gain, centre = (
            self._weight(f"{self.weights.place(grouped(part))} + o")
            for part in (np.ones(len(layer.bias)), layer.gain, layer.centre)
        )
        one = self._vec4([1] * 4)
        found += [self._made(f"{own}mean", "0.0", 1), self._made(f"{own}square", "0.0", 1)]
        found += self._loop("o", groups, [f"{own}mean += dot({y}[o], {one}) / {n};"])
        centred = f"{y}[o] = ({y}[o] - {own}mean * {one}) * {mask};"
        found += self._loop("o", groups, [centred, f"{own}square += dot({y}[o], {y}[o]) / {n};"])
        scale = f"1.0 / sqrt({own}square + {literal(EPSILON)})"
        found.append(self._made(f"{own}scale", scale, 1))
        normal = f"{y}[o] * {own}scale * {gain} + {centre}"
        last = _activated(layer, "z", f"{x}[o]", rounded=rounded)
        return found + self._loop("o", groups, [self._made("z", normal), f"{y}[o] = {last};"])


def _activated(layer: Dense, z: str, before: str, *, rounded: bool) -> str:
    value = z if layer.omega == 1 else f"{literal(layer.omega)} * {z}"
    if layer.activation != "linear":
        value = f"btfkit_{layer.activation}({value})"
    value = f"btfkit_rounded({value})" if rounded else value
    return f"{before} + {value}" if layer.residual else value


def _chosen(program: Program, *, half: bool) -> tuple[list[str], list[str]]:
    """Sections before the functions of textures, and after them, that the program needs."""
    depth, inputs, every = program.depth, program.every_input, program.every_layer
    marched, disc = isinstance(depth, Heights), any(n.endswith("_disc") for n in inputs)
    covered = program.cover is not None and program.cover.kind == "direct"
    sigmoid = covered or any(head.kind in ("mask", "opacity") for head in program.heads)
    first = ["cell_wrap" if program.wrap else "cell_clamp"]
    first += ["texel_half" if half else "texel", "lookup"] + ["march"] * marched
    first += ["rounded"] * program.rounded + ["sigmoid"] * sigmoid
    first += [a for a in ("relu", "leaky", "sine") if any(x.activation == a for x in every)]
    first += ["disc"] * disc + ["step"] * isinstance(depth, (Heights, DepthNetwork))
    half_ = program.frames > 0 or inputs & {"hx", "hy", "hz", "cos_diff"}
    curved = program.curved
    last = ["bent"] * curved + ["evaluate", "level" if program.leveled else "no_level"]
    last += ["bent_depth"] * curved + ["half"] * bool(half_)
    return first, last + ["march_depth"] * (marched and not curved)


def _values(program: Program, model: str) -> dict[str, object]:
    found: dict[str, object] = {
        "model": model, "channels": len(program.channels), "aspect": literal(program.aspect),
        "lowest": literal(LOWEST_COSINE), "steepest": literal(STEEPEST), "looks": LOOKS,
        "leak": literal(LEAK),
        "reduced": "uv_in - floor(uv_in)" if program.wrap else "saturate(uv_in)",
    }  # fmt: skip
    if isinstance(program.depth, Heights):
        heights = program.depth.heights
        found |= {
            "h": heights.shape[0], "w": heights.shape[1], "top": literal(heights.max()),
            "rise": literal(heights.max() - heights.min()), "scale": literal(program.depth.scale),
        }  # fmt: skip
    return found
