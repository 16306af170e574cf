"""`cpp`: one C++17 header, a file of numbers, and a program that uses both."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit.conventions import (
    CURVATURE_UNIT,
    CURVED_FINER,
    EPSILON,
    LEAK,
    LEVELS_UNIT,
    LOOKS,
    LOWEST_COSINE,
    LOWEST_SEEN,
    MOST_BEND,
    MOST_LOG,
    SLACK,
    STEEPEST,
)
from btfkit.export import lobes
from btfkit.export.arrays import narrowed
from btfkit.export.numbers import literal
from btfkit.export.sections import filled, sections
from btfkit.materials.base import Material
from btfkit.native.neural import bent
from btfkit.native.neural.plain import YUV_TO_RGB
from btfkit.program import (
    Cover,
    Dense,
    DepthNetwork,
    Heights,
    OffsetNetwork,
    Program,
    Texture,
)

SPACE = "btfkit_material"
# Inputs of `conventions.INPUTS` by the names of the header's variables.
_INPUTS = {
    **{f"{d}{axis}": f"{name}[{k}]"
       for d, name in (("l", "light"), ("v", "view"), ("h", "half"))
       for k, axis in enumerate("xyz")},
    **{f"{d}{axis}_disc": f"{name}_disc[{k}]"
       for d, name in (("l", "light"), ("v", "view"))
       for k, axis in enumerate("xy")},
    "cos_diff": "cos_diff",
    "level": f"level / {LEVELS_UNIT}",
    "curvature": f"curvature / (std::fabs(curvature) + {CURVATURE_UNIT}f)",
}  # fmt: skip


def write(material: Material, program: Program, folder: Path) -> None:
    """`material.hpp`, `material.bin`, `lobes.hpp` and `example.cpp`."""
    header, numbers = source(program, model=material.model, texel_mm=material.header.texel_mm)
    (folder / "material.hpp").write_text(header)
    (folder / "material.bin").write_bytes(numbers)
    (folder / "lobes.hpp").write_text(lobes.cpp(material))
    example = sections("material.hpp.txt")["example"]
    (folder / "example.cpp").write_text(filled(example, space=SPACE, **_curvature(program)))


def source(program: Program, *, model: str, texel_mm: float | None = None) -> tuple[str, bytes]:
    """The header's text and the bytes of its numbers."""
    store = _Store()
    body = [*_networks(program, store), *_features(program, store), *_answer(program, store)]
    constants = store.constants(program)
    h, w = program.grid
    edge = texel_mm or 0.0
    values = {
        "model": model, "space": SPACE, "channels": len(program.channels),
        "counts": f"{sum(a.size for a in store.singles + store.halves)} numbers",
        "tile_mm": f"{w * edge!r}, {h * edge!r}",
        "below": "" if program.full_sphere else "    if (light[2] <= 0) return out;\n",
        "reduced": "float(u - std::floor(u)), float(v - std::floor(v))" if program.wrap
        else "float(std::clamp(u, 0.0, 1.0)), float(std::clamp(v, 0.0, 1.0))",
        "steepest": _number(STEEPEST), "lowest": _number(LOWEST_COSINE), "looks": LOOKS,
        "epsilon": _number(EPSILON),
        "scale": _number(_scale(program)),
        **_curvature(program),
    }  # fmt: skip
    parts = sections("material.hpp.txt")
    chosen = _chosen(program)
    before = "".join(parts[name] for name in ("start", "evaluate_start", *chosen[0]))
    after = "".join(parts[name] for name in ("evaluate_end", "sum", *chosen[1]))
    lines = "".join(f"    {line}\n" for line in body)
    return filled(before, **values) + lines + filled(after, **values) + constants + filled(
        parts["end"], **values
    ), store.bytes()


class _Store:
    """Arrays by their place in the file: float32 first, then those that halves hold exactly."""

    def __init__(self) -> None:
        self.singles: list[NDArray[np.float32]] = []
        self.halves: list[NDArray[np.float16]] = []
        self._levels: list[str] = []
        self._named: list[tuple[str, Sequence[NDArray[np.floating]]]] = []

    def single(self, *arrays: NDArray[np.floating]) -> int:
        """Where arrays lie, one after the other, as float32."""
        at = sum(array.size for array in self.singles)
        self.singles += [np.ascontiguousarray(array, np.float32) for array in arrays]
        return at

    def levels(self, name: str, levels: Sequence[NDArray[np.floating]]) -> str:
        """Name of the constant that says where levels of a texture lie."""
        self._named.append((name, levels))
        return name

    def constants(self, program: Program) -> str:
        """Text of all constants; every texture has its place from here on."""
        wide = {id(level): narrowed(level) for _, levels in self._named for level in levels}
        at: dict[int, int] = {}
        for _, levels in self._named:
            for level in levels:
                kept = wide[id(level)]
                if kept.dtype == np.float32 and id(level) not in at:
                    at[id(level)] = self.single(kept)
        start = sum(array.size for array in self.singles)
        for _, levels in self._named:
            for level in levels:
                kept = wide[id(level)]
                if kept.dtype == np.float16 and id(level) not in at:
                    at[id(level)] = start + sum(array.size for array in self.halves)
                    self.halves.append(np.ascontiguousarray(kept))
        lines = [
            f"static constexpr std::size_t kSingles = {start};",
            f"static constexpr std::size_t kHalves = {sum(a.size for a in self.halves)};",
            f"static constexpr std::uint64_t kSum = {fnv(self.bytes())}ull;",
            f"static constexpr float kAspect = {_number(program.aspect)};",
        ]
        for name, levels in self._named:
            places = [f"{{{at[id(x)]}, {x.shape[0]}, {x.shape[1]}}}" for x in levels]
            single = name in ("kHeights", "kOpacity")
            brackets = "" if single else "[]"
            listed = places[0] if single else "{" + ", ".join(places) + "}"
            lines.append(f"static constexpr Level {name}{brackets} = {listed};")
        if isinstance(program.depth, Heights):
            heights = program.depth.heights
            lines.append(f"static constexpr float kTop = {_number(heights.max())};")
            lines.append(f"static constexpr float kBottom = {_number(heights.min())};")
        return "".join(f"  {line}\n" for line in lines)

    def bytes(self) -> bytes:
        """The file, little-endian."""
        found = [array.astype("<f4").tobytes() for array in self.singles]
        return b"".join(found + [array.astype("<f2").tobytes() for array in self.halves])


def fnv(data: bytes) -> int:
    """FNV-1a of bytes, 64 bits."""
    found = 14695981039346656037
    for byte in data:
        found = (found ^ byte) * 1099511628211 & 0xFFFFFFFFFFFFFFFF
    return found


def _scale(program: Program) -> float:
    found = program.depth
    return found.scale if isinstance(found, (Heights, DepthNetwork)) else 0.0


def _curvature(program: Program) -> dict[str, object]:
    """What a header says of curvature: nothing where rays are straight."""
    if not program.bends:
        return {**dict.fromkeys(("more", "given", "bad", "tenth"), ""), "columns": 9}
    found = program.depth
    said = {
        "more": ", curvature", "given": ", float curvature = 0",
        "bad": " || !std::isfinite(curvature)", "tenth": ", row[9]", "columns": 10,
    }  # fmt: skip
    if not isinstance(found, Heights):
        return said
    low, high = bent.sharpest(found)
    most = "std::numeric_limits<float>::infinity()"
    reach = _number(bent.hole_range(found))
    hole = (
        "    float solid = 0;\n    lookup<1>(kOpacity, u, v, 1, &solid);\n"
        f"    height += {_number(SLACK)} * {reach};\n"
        f"    return std::max(z - height, (0.5f - solid) * {reach});\n  }}\n"
    )
    return {
        **said,
        "flattest": _number(low) if np.isfinite(low) else f"-{most}",
        "sharpest": _number(high) if np.isfinite(high) else most,
        "seen": _number(LOWEST_SEEN), "bend": _number(MOST_BEND), "finer": _number(CURVED_FINER),
        "more_looks": found.looks, "holes": "false" if found.opacity is None else "true",
        "hole": "    return z - height;\n  }\n" if found.opacity is None else hole,
    }  # fmt: skip


def _number(value: Any) -> str:
    return literal(value) + "f"


def _chosen(program: Program) -> tuple[list[str], list[str]]:
    """Sections before the generated lines, and after them, that the program needs."""
    inputs, depth, layers = program.every_input, program.depth, program.every_layer
    covered = program.cover is not None and program.cover.kind == "direct"
    sigmoid = covered or any(head.kind in ("mask", "opacity") for head in program.heads)
    half = program.frames > 0 or inputs & {"hx", "hy", "hz", "cos_diff"}
    disc = any(name.endswith("_disc") for name in inputs)
    marched = isinstance(depth, Heights)
    before = ["level" if program.leveled else "no_level"]
    curved, steps = program.curved, isinstance(depth, (Heights, DepthNetwork))
    before += ["bent_depth"] * curved + ["half"] * bool(half) + ["disc"] * disc
    if not curved:
        before += ["march_depth"] * marched + ["steps"] * steps
    after = ["beside_wrap" if program.wrap else "beside_clamp", "pyramid"]
    after += ["dense"] * bool(layers) + ["normal"] * any(x.gain is not None for x in layers)
    after += ["rounded"] * program.rounded + ["sigmoid"] * sigmoid
    after += ["on_disc"] * disc + ["step"] * steps + ["crossing"] * marched
    after += ["bent"] * curved
    return before, after


def _networks(program: Program, store: _Store) -> list[str]:
    """Opacity, and depth or offset, where networks of their own say them."""
    heights = program.depth
    if isinstance(heights, Heights):
        store.levels("kHeights", (heights.heights,))
        if heights.opacity is not None:
            store.levels("kOpacity", (heights.opacity,))
    found: list[str] = []
    for part in program.networks:
        name, place = ("c", "kCover") if isinstance(part, Cover) else ("d", "kDepth")
        store.levels(place, (part.texture.levels[0],))
        k, psi = part.texture.levels[0].shape[-1], f"{name}_psi"
        known = _INPUTS | {
            feature: f"{psi}[{i}]" for i, feature in enumerate(part.texture.features)
        }
        found += [f"float {psi}[{k}] = {{}};", f"lookup<{k}>({place}[0], uv[0], uv[1], 1, {psi});"]
        found += _gathered(f"{name}0", part.inputs, known)
        found += _layers(name, part.layers, store, rounded=program.rounded)
        last = f"{name}{len(part.layers)}"
        if isinstance(part, DepthNetwork):
            found.append(f"const float depth = {last}[0] * {_number(part.scale)};")
        elif isinstance(part, OffsetNetwork):
            found.append(f"const float* offset = {last};")
        else:
            seen = f"view[2] >= {last}[0] ? 1.0f : 0.0f"
            found.append(
                f"out.opacity = {seen if part.kind == 'cosine' else f'sigmoid({last}[0])'};"
            )
            found.append("if (!(out.opacity > 0)) return out;")
    return found


def _features(program: Program, store: _Store) -> list[str]:
    lines: list[str] = []
    every = [*program.textures, *([program.scaling] if program.scaling else [])]
    for t, texture in enumerate(every):
        place = store.levels(f"kTexture{t}", texture.levels)
        k, count = texture.levels[0].shape[-1], len(texture.levels)
        u, v = _moved(program, texture)
        shifted = f"level - {_number(texture.shift)}"
        lines.append(f"float t{t}[{k}];")
        lines.append(f"pyramid<{k}>({place}, {count}, {shifted}, {u}, {v}, t{t});")
    return lines


def _moved(program: Program, texture: Texture) -> tuple[str, str]:
    if program.depth is None or not (texture.view or texture.light):
        return "uv[0]", "uv[1]"
    view, light = _number(texture.view), _number(texture.light)
    if isinstance(program.depth, OffsetNetwork):
        return f"uv[0] + {view} * offset[0]", f"uv[1] + {view} * offset[1]"
    return tuple(  # type: ignore[return-value]
        f"uv[{k}] + depth * ({view} * toward[{k}] - {light} * away[{k}])" for k in range(2)
    )


def _answer(program: Program, store: _Store) -> list[str]:
    known = dict(_INPUTS)
    for t, texture in enumerate(program.textures):
        known |= {name: f"t{t}[{k}]" for k, name in enumerate(texture.features)}
    for f in range(program.frames):
        for name, vector in (("half", "half"), ("light", "light")):
            products = [f"t0[{3 * f + k}] * {vector}[{k}]" for k in range(3)]
            known[f"frame.{f}.{name}"] = " + ".join(products)
    lines = _gathered("x0", program.inputs, known)
    lines += _layers("x", program.layers, store, rounded=program.rounded)
    last, at, heads = f"x{len(program.layers)}", 0, {}
    for head in program.heads:
        heads[head.kind] = at
        at += head.count
    lines += _output(program, last, heads)  # type: ignore[arg-type]
    if "opacity" in heads:
        lines.append(f"out.opacity = sigmoid({last}[{heads['opacity']}]);")
        lines.append("if (!(out.opacity > 0)) for (float& value : out.rgb) value = 0;")
    return lines


def _output(program: Program, last: str, heads: dict[str, int]) -> list[str]:
    loop, most = "for (int c = 0; c < kChannels; ++c)", _number(MOST_LOG)
    if program.output == "cosine":
        return [f"{loop} out.rgb[c] = {last}[{heads['linear']} + c] * light[2];"]
    if program.output == "linear":
        return [f"{loop} out.rgb[c] = std::max({last}[{heads['linear']} + c], 0.0f);"]
    masked = f"(0.1f + sigmoid({last}[{heads['mask']} + c]))" if "mask" in heads else ""
    if program.output == "released":
        rows = ", ".join("{" + ", ".join(map(_number, row)) + "}" for row in YUV_TO_RGB)
        first = heads["log"]
        return [
            f"static constexpr float kRgb[3][3] = {{{rows}}};",
            f"{loop} {{",
            "  float y = 0;",
            "  for (int k = 0; k < 3; ++k)",
            f"    y += kRgb[c][k] * std::min({last}[{first} + k], {most});",
            f"  out.rgb[c] = std::max(std::expm1(std::min(y, {most})) * {masked}, 0.0f);",
            "}",
        ]
    lines = [f"{loop} {{", f"  float y = {last}[{heads['log']} + c];"]
    if program.scaling:
        t = len(program.textures)
        lines.append(f"  y = t{t}[c] + t{t}[kChannels + c] * y;")
    lines += [f"  y *= {masked};"] * bool(masked)
    return [*lines, f"  out.rgb[c] = std::expm1(std::clamp(y, 0.0f, {most}));", "}"]


def _gathered(name: str, inputs: Sequence[str], known: dict[str, str]) -> list[str]:
    return [f"float {name}[{len(inputs)}] = {{{', '.join(known[i] for i in inputs)}}};"]


def _layers(name: str, layers: Sequence[Dense], store: _Store, *, rounded: bool) -> list[str]:
    """Lines that take NAME0 to NAMEn through n layers."""
    lines: list[str] = []
    for k, layer in enumerate(layers):
        n, m = layer.weight.shape
        x, y = f"{name}{k}", f"{name}{k + 1}"
        weight = layer.weight.T
        at = store.single(weight, layer.bias)
        lines += [f"float {y}[{n}];", f"dense<{m}, {n}>({at}, {x}, {y});"]
        if layer.gain is not None and layer.centre is not None:
            lines.append(f"normalise<{n}>({store.single(layer.gain, layer.centre)}, {y});")
        value = f"{y}[k]" if layer.omega == 1 else f"{_number(layer.omega)} * {y}[k]"
        value = {
            "linear": value, "relu": f"std::max({value}, 0.0f)", "sine": f"std::sin({value})",
            "leaky": f"({value}) * (({value}) > 0 ? 1.0f : {_number(LEAK)})",
        }[layer.activation]  # fmt: skip
        value = f"rounded({value})" if rounded and k + 1 < len(layers) else value
        value = f"{x}[k] + {value}" if layer.residual else value
        if value != f"{y}[k]":
            lines.append(f"for (int k = 0; k < {n}; ++k) {y}[k] = {value};")
    return lines
