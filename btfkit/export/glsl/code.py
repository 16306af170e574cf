"""A program as one GLSL ES 3.00 function."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.conventions import (
    LEVELS_UNIT,
    LOOKS,
    LOWEST_COSINE,
    MOST_LOG,
    STEEPEST,
)
from btfkit.export import curvature
from btfkit.export.arrays import holes, textures
from btfkit.export.glsl import layers
from btfkit.export.glsl.atlas import Atlas
from btfkit.export.glsl.layers import Source, Weights, vec4
from btfkit.export.numbers import literal
from btfkit.export.sections import filled, sections
from btfkit.native.neural.plain import YUV_TO_RGB
from btfkit.program import Cover, DepthNetwork, Heights, OffsetNetwork, Program, Texture

# Vectors of a query, four numbers each, under the names that `conventions.INPUTS` has.
VECTORS = (
    Source("vec4(light, 0.0)", ("lx", "ly", "lz", "")),
    Source("vec4(view, 0.0)", ("vx", "vy", "vz", "")),
    Source("vec4(halfway, cos_diff)", ("hx", "hy", "hz", "cos_diff")),
    Source("vec4(btfkit_disc(light), btfkit_disc(view))",
           ("lx_disc", "ly_disc", "vx_disc", "vy_disc")),
    Source(f"vec4(level / {LEVELS_UNIT}.0, 0.0, 0.0, 0.0)", ("level", "curvature", "", "")),
)  # fmt: skip


@final
@dataclass(frozen=True, eq=False)
class Shader:
    """A function, and the weights that it fetches.

    Attributes:
        text: GLSL ES 3.00, without a version line.
        weights: (rows, 1024, 4) float32 of `btfkit_weights`, None where all are literals.
    """

    text: str
    weights: NDArray[np.float32] | None


def shader(program: Program, atlas: Atlas, *, model: str) -> Shader:
    """The function `btfkit_evaluate` of a program whose textures lie in an atlas."""
    wide = Weights() if layers.size(program.every_layer) > layers.MOST_LITERALS else None
    body = [*_networks(program, wide), *_features(program), *_answer(program, wide)]
    parts = sections("material.glsl.txt")
    first, last = _chosen(program, wide=wide is not None)
    values = _values(program, model)
    head = filled("".join(parts[name] for name in first), **values)
    looks = "".join(_look(texture, atlas) for texture in textures(program))
    function = filled("".join(parts[name] for name in last), **values)
    text = head + looks + function + "".join(f"  {line}\n" for line in body) + "}\n"
    if program.bends:
        text += filled(parts["on_the_plane"], **values)
    return Shader(text, None if wide is None else _texture(wide.rows))


def _texture(rows: list[NDArray[Any]]) -> NDArray[np.float32]:
    found = np.zeros((-(-len(rows) // 1024) * 1024, 4), np.float32)
    found[: len(rows)] = rows
    return found.reshape(-1, 1024, 4)


def _chosen(program: Program, *, wide: bool) -> tuple[list[str], list[str]]:
    depth, inputs = program.depth, program.every_input
    marched, disc = isinstance(depth, Heights), any(n.endswith("_disc") for n in inputs)
    covered = program.cover is not None and program.cover.kind == "direct"
    sigmoid = covered or any(head.kind in ("mask", "opacity") for head in program.heads)
    first = ["start"] + ["heights_uniform"] * marched + ["weights_uniform"] * wide
    first += ["beside_wrap" if program.wrap else "beside_clamp", "lookup"] + ["march"] * marched
    first += ["rounded"] * program.rounded + ["sigmoid"] * sigmoid
    first += ["sine"] * any(layer.activation == "sine" for layer in program.every_layer)
    first += ["disc"] * disc + ["step"] * isinstance(depth, (Heights, DepthNetwork))
    half = program.frames > 0 or inputs & {"hx", "hy", "hz", "cos_diff"}
    bent_ = program.curved
    last = ["bent"] * bent_ + ["evaluate", "level" if program.leveled else "no_level"]
    last += ["bent_depth"] * bent_ + ["half"] * bool(half)
    return first, last + ["march_depth"] * (marched and not bent_)


def _values(program: Program, model: str) -> dict[str, object]:
    found: dict[str, object] = {
        "model": model, "channels": len(program.channels), "aspect": literal(program.aspect),
        "lowest": literal(LOWEST_COSINE), "steepest": literal(STEEPEST), "looks": LOOKS,
        "below": "" if program.full_sphere else "  if (light.z <= 0.0) return;\n",
        "reduced": "uv - floor(uv)" if program.wrap else "clamp(uv, 0.0, 1.0)",
        "to_tile": "  at -= floor(at);\n" if program.wrap else "  at = clamp(at, 0.0, 1.0);\n",
    }  # fmt: skip
    found |= _curvature(program)
    if isinstance(program.depth, Heights):
        heights = program.depth.heights.astype(np.float16).astype(np.float32)
        found |= {
            "h": heights.shape[0], "w": heights.shape[1], "top": literal(heights.max()),
            "rise": literal(heights.max() - heights.min()), "scale": literal(program.depth.scale),
        }  # fmt: skip
    return found


def _curvature(program: Program) -> dict[str, object]:
    """What a shader says of curvature: nothing where answers do not depend on it."""
    found, more = program.depth, "float curvature, " * program.bends
    if not (isinstance(found, Heights) and found.curved):
        return {"more": more}
    near, text = replace(found, heights=found.heights.astype(np.float16).astype(np.float32)), ""
    for texture in holes(program):
        text = f"  vec4 solid;\n  btfkit_look_{variable(texture)}(at, 0.0, solid);\n"
        text += curvature.hole(near, "solid.x")
    return {"more": more, "hole": text, **curvature.numbers(near)}


def _look(texture: Texture, atlas: Atlas) -> str:
    """The function that reads all channels of a texture, between levels where it has some."""
    places, name = atlas.places[texture.name], variable(texture)
    groups, n = groups_of(texture), len(places)
    out = ", ".join(f"out vec4 {name}_{g}" for g in range(groups))
    low, step = (x[texture.name].reshape(-1, 4) for x in (atlas.low, atlas.step))
    corners = ", ".join(f"ivec3({p.x}, {p.y}, {p.layer})" for p in places)
    sizes = ", ".join(f"ivec2({p.w}, {p.h})" for p in places)
    lines = [
        f"const ivec3 {name}_corner[{n}] = ivec3[{n}]({corners});",
        f"const ivec2 {name}_size[{n}] = ivec2[{n}]({sizes});",
        f"void btfkit_look_{name}(vec2 uv, float level, {out}) {{",
        "  ivec4 at;",
        "  vec2 share;",
    ]
    lines += [f"  level = clamp(level - {literal(texture.shift)}, 0.0, {n - 1}.0);"] * (n > 1)
    s = "0"
    if n > 1:
        lines.append(f"  int s = min(int(level), {n - 1});")
        s = "s"
    lines.append(f"  btfkit_cell(uv, {name}_size[{s}], at, share);")
    for g in range(groups):
        corner = f"{name}_corner[{s}] + ivec3(0, 0, {g})"
        lines.append(f"  {name}_{g} = btfkit_lookup(at, share, {corner});")
    if n > 1:
        lines += ["  float between = level - float(s);", "  if (between > 0.0) {"]
        lines.append(f"    btfkit_cell(uv, {name}_size[s + 1], at, share);")
        for g in range(groups):
            corner = f"{name}_corner[s + 1] + ivec3(0, 0, {g})"
            coarser = f"btfkit_lookup(at, share, {corner})"
            lines.append(f"    {name}_{g} = mix({name}_{g}, {coarser}, between);")
        lines.append("  }")
    for g in range(groups):
        if low[g].any() or (step[g] != 1).any():
            # A byte is read as 0..1.
            scale = vec4(step[g] * (255 if atlas.data.dtype == np.uint8 else 1))
            lines.append(f"  {name}_{g} = {name}_{g} * {scale} + {vec4(low[g])};")
    return "\n".join([*lines, "}", ""])


def variable(texture: Texture) -> str:
    """What variables of a texture begin with."""
    return "t_" + "".join(c if c.isalnum() else "x" for c in texture.name)


def groups_of(texture: Texture) -> int:
    """Groups of four channels."""
    return -(-texture.levels[0].shape[-1] // 4)


def sources_of(texture: Texture) -> list[Source]:
    """The variables that hold a texture's features."""
    names = [*texture.features]
    names += [""] * (-len(names) % 4)
    return [
        Source(f"{variable(texture)}_{g}", tuple(names[4 * g : 4 * g + 4]))
        for g in range(groups_of(texture))
    ]


def _called(texture: Texture, place: str, level: str) -> list[str]:
    variables = [source.text for source in sources_of(texture)]
    return [
        f"vec4 {', '.join(variables)};",
        f"btfkit_look_{variable(texture)}({place}, {level}, {', '.join(variables)});",
    ]


def told(source: Source, inputs: Iterable[str]) -> str:
    """Text of one of `VECTORS`, with the curvature where it is asked for."""
    if "curvature" not in source.names or "curvature" not in inputs:
        return source.text
    return source.text.replace("0.0, 0.0, 0.0)", f"{curvature.softened()}, 0.0, 0.0)")


def _vectors(inputs: Iterable[str], prefix: str) -> tuple[list[str], list[Source]]:
    """Variables for the vectors that inputs are taken from."""
    wanted, lines, found = set(inputs), [], []
    for k, source in enumerate(VECTORS):
        if wanted & {name for name in source.names if name}:
            lines.append(f"vec4 {prefix}{k} = {told(source, inputs)};")
            found.append(Source(f"{prefix}{k}", source.names))
    return lines, found


def _networks(program: Program, wide: Weights | None) -> list[str]:
    """Opacity, and depth or offset, where networks of their own say them."""
    found: list[str] = []
    for name, part in zip("cd", (program.cover, program.depth), strict=True):
        if not isinstance(part, (Cover, DepthNetwork, OffsetNetwork)):
            continue
        lines, sources = _vectors(part.inputs, f"{name}q")
        some, scalars = layers.lines(
            name, part.layers, part.inputs, [*sources_of(part.texture), *sources],
            rounded=program.rounded, wide=wide,
        )  # fmt: skip
        found += [*_called(part.texture, "uv", "0.0"), *lines, *some]
        if isinstance(part, DepthNetwork):
            found.append(f"float depth = {scalars[0]} * {literal(part.scale)};")
        elif isinstance(part, OffsetNetwork):
            found.append(f"vec2 offset = vec2({scalars[0]}, {scalars[1]});")
        else:
            seen = f"view.z >= {scalars[0]} ? 1.0 : 0.0"
            direct = f"btfkit_sigmoid({scalars[0]})"
            found.append(f"opacity = {direct if part.kind == 'direct' else seen};")
            found.append("if (!(opacity > 0.0)) return;")
    return found


def places(program: Program) -> Iterator[tuple[Texture, str]]:
    """Textures that the answer reads, and where, in terms that all shading languages share."""
    for texture in [*program.textures, *([program.scaling] if program.scaling else [])]:
        moves = []
        if isinstance(program.depth, OffsetNetwork):
            place = f"uv + {literal(texture.view)} * offset" if texture.view else "uv"
        else:
            if program.depth is not None and texture.view:
                way = "toward" if program.curved else "btfkit_step(view)"
                moves.append(f"{literal(texture.view)} * {way}")
            if program.depth is not None and texture.light:
                way = "away" if program.curved else "btfkit_step(light)"
                moves.append(f"{literal(-texture.light)} * {way}")
            place = f"uv + depth * ({' + '.join(moves)})" if moves else "uv"
        yield texture, place


def _features(program: Program) -> list[str]:
    return [line for texture, place in places(program)
            for line in _called(texture, place, "level")]  # fmt: skip


def _answer(program: Program, wide: Weights | None) -> list[str]:
    lines, sources = _vectors(program.inputs, "q")
    sources = [s for texture in program.textures for s in sources_of(texture)] + sources
    for f in range(program.frames):
        first = sources_of(program.textures[0])
        axis = ", ".join(
            layers.component(program.textures[0].features[3 * f + k], first) for k in range(3)
        )
        with_ = f"dot(vec3({axis}), halfway), dot(vec3({axis}), light), 0.0, 0.0"
        lines.append(f"vec4 frame{f} = vec4({with_});")
        sources.append(Source(f"frame{f}", (f"frame.{f}.half", f"frame.{f}.light", "", "")))
    some, raw = layers.lines(
        "h", program.layers, program.inputs, sources, rounded=program.rounded, wide=wide
    )
    heads: dict[str, list[str]] = {}
    for head in program.heads:
        heads[head.kind], raw = raw[: head.count], raw[head.count :]
    return [*lines, *some, *_output(program, heads)]


def _output(program: Program, heads: dict[str, list[str]]) -> list[str]:
    lines: list[str] = []
    if "opacity" in heads:
        lines += [
            f"opacity = btfkit_sigmoid({heads['opacity'][0]});",
            "if (!(opacity > 0.0)) return;",
        ]
    return lines + [f"value[{k}] = {x};" for k, x in enumerate(reflectance(program, heads))]


def reflectance(program: Program, heads: dict[str, list[str]]) -> list[str]:
    """Each channel's reflectance as text, in GLSL and in what is like it."""
    c, most = len(program.channels), literal(MOST_LOG)
    if program.output == "cosine":
        return [f"{x} * light.z" for x in heads["linear"]]
    if program.output == "linear":
        return [f"max({x}, 0.0)" for x in heads["linear"]]
    if program.output == "released":
        logs = [f"min({x}, {most})" for x in heads["log"]]
        sums = [
            " + ".join(f"{literal(m)} * {x}" for m, x in zip(row, logs, strict=True))
            for row in YUV_TO_RGB
        ]
        masks = [f"(0.1 + btfkit_sigmoid({x}))" for x in heads["mask"]]
        return [
            f"max((exp(min({y}, {most})) - 1.0) * {mask}, 0.0)"
            for y, mask in zip(sums, masks, strict=True)
        ]
    logs = heads["log"]
    if program.scaling:
        white = sources_of(program.scaling)
        names = program.scaling.features
        logs = [
            f"({layers.component(names[k], white)} + {layers.component(names[c + k], white)} * {x})"
            for k, x in enumerate(logs)
        ]
    if "mask" in heads:
        logs = [
            f"{y} * (0.1 + btfkit_sigmoid({m}))" for y, m in zip(logs, heads["mask"], strict=True)
        ]
    return [f"exp(clamp({y}, 0.0, {most})) - 1.0" for y in logs]
