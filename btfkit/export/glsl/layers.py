"""Layers in GLSL: four outputs at a time, weights as literals or, of wide ones, from a texture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from btfkit.conventions import EPSILON, LEAK
from btfkit.export.numbers import literal
from btfkit.program import Dense

Array = NDArray[Any]
# Weights that may stand in a shader as literals. More of them take compilers many seconds.
MOST_LITERALS = 12000


class Source(NamedTuple):
    """A vec4 of inputs: its text, and the name of each component ("" for none)."""

    text: str
    names: tuple[str, ...]


@final
class Weights:
    """Weights of wide layers, in vec4s of a texture that layers are read from.

    Attributes:
        rows: (4,) float32 each, in order.
    """

    def __init__(self) -> None:
        self.rows: list[Array] = []

    def place(self, values: Array) -> int:
        """Where values (n, 4) begin."""
        at = len(self.rows)
        self.rows += list(np.asarray(values, np.float32).reshape(-1, 4))
        return at


def size(layers: Sequence[Dense]) -> int:
    """Weights of layers."""
    return sum(layer.weight.size + layer.bias.size for layer in layers)


def lines(
    name: str,
    layers: Sequence[Dense],
    inputs: Sequence[str],
    sources: Sequence[Source],
    *,
    rounded: bool,
    wide: Weights | None,
) -> tuple[list[str], list[str]]:
    """Statements that take inputs through layers, and the scalars of the last in order.

    Args:
        name: that variables begin with.
        inputs: of the first layer, in order. sources: that hold them.
        rounded: whether layers but the first multiply numbers rounded to bfloat16.
        wide: where weights go instead of literals; None for literals.
    """
    if not layers:
        return [], [component(input_, sources) for input_ in inputs]
    if layers[0].residual:
        raise TypeError("a first layer that adds its inputs has no form in GLSL here")
    used = [source for source in sources if any(n in inputs for n in source.names)]
    found: list[str] = []
    before = [source.text for source in used]
    matrix = arranged(layers[0].weight, inputs, used)
    for k, layer in enumerate(layers):
        cut = rounded and k + 1 < len(layers)
        if k:
            matrix = padded(layer.weight, 4 * len(before))
        own = f"{name}{k + 1}"
        if wide is None:
            some, before = _literal_layer(own, layer, matrix, before, rounded=cut)
        else:
            some, before = _wide_layer(own, layer, matrix, before, wide, rounded=cut)
        found += some
    n = layers[-1].weight.shape[0]
    return found, [f"{before[k // 4]}.{'xyzw'[k % 4]}" for k in range(n)]


def component(name: str, sources: Sequence[Source]) -> str:
    """The scalar of a name."""
    for source in sources:
        if name in source.names:
            return f"{source.text}.{'xyzw'[source.names.index(name)]}"
    raise ValueError(f"no source holds {name}")


def vec4(values: Any) -> str:
    """A vec4 of literals."""
    return f"vec4({', '.join(literal(value) for value in values)})"


def _literal_layer(
    own: str, layer: Dense, matrix: Array, before: list[str], *, rounded: bool
) -> tuple[list[str], list[str]]:
    bias, groups = grouped(layer.bias), matrix.shape[0] // 4
    names = [f"{own}_{o}" for o in range(groups)]
    found = []
    for o, name in enumerate(names):
        block = matrix[4 * o : 4 * o + 4]
        terms = [vec4(bias[o])]
        for i, x in enumerate(before):
            columns = block[:, 4 * i : 4 * i + 4].T.reshape(-1)
            if columns.any():
                terms.append(f"mat4({','.join(literal(c) for c in columns)})*{x}")
        found.append(f"vec4 {name} = {' + '.join(terms)};")
    if layer.gain is not None and layer.centre is not None:
        found += _normal_lines(own, layer, names)
    for o, name in enumerate(names):
        text = activated(layer, name, f"{before[o]} + " if layer.residual else "", rounded=rounded)
        found += [f"{name} = {text};"] * (text != name)
    return found, names


def _normal_lines(own: str, layer: Dense, names: list[str]) -> list[str]:
    n, one = len(layer.bias), "vec4(1.0)"
    assert layer.gain is not None
    assert layer.centre is not None
    masks = grouped(np.ones(n))
    total = " + ".join(f"dot({x}, {one})" for x in names)
    found = [f"float {own}_mean = ({total}) / {literal(n)};"]
    found += [f"{x} = ({x} - {own}_mean) * {vec4(m)};" for x, m in zip(names, masks, strict=True)]
    square = " + ".join(f"dot({x}, {x})" for x in names)
    scale = f"inversesqrt(({square}) / {literal(n)} + {literal(EPSILON)})"
    found.append(f"float {own}_scale = {scale};")
    for x, gain, centre in zip(names, grouped(layer.gain), grouped(layer.centre), strict=True):
        found.append(f"{x} = {x} * {own}_scale * {vec4(gain)} + {vec4(centre)};")
    return found


def _wide_layer(
    own: str, layer: Dense, matrix: Array, before: list[str], wide: Weights, *, rounded: bool
) -> tuple[list[str], list[str]]:
    """The same in loops: arrays of vec4, weights fetched."""
    groups, width = matrix.shape[0] // 4, matrix.shape[1] // 4
    # Per output group: for each input group its four columns.
    blocks = matrix.reshape(groups, 4, width, 4).transpose(0, 2, 3, 1)
    at, bias = wide.place(blocks), wide.place(grouped(layer.bias))
    x = before[0].split("[")[0]
    found = []
    if not before[0].startswith(f"{x}[0]"):
        x = f"{own}_in"
        found.append(f"vec4 {x}[{width}] = vec4[{width}]({', '.join(before)});")
    found += [
        f"vec4 {own}[{groups}];",
        f"for (int o = 0; o < {groups}; ++o) {{",
        f"  vec4 z = btfkit_weight({bias} + o);",
        f"  for (int i = 0; i < {width}; ++i) {{",
        f"    int k = {at} + (o * {width} + i) * 4;",
        f"    z += mat4(btfkit_weight(k), btfkit_weight(k + 1), btfkit_weight(k + 2), "
        f"btfkit_weight(k + 3)) * {x}[i];",
        "  }",
        f"  {own}[o] = z;",
        "}",
    ]
    names = [f"{own}[{o}]" for o in range(groups)]
    if layer.gain is not None and layer.centre is not None:
        found += _normal_lines(own, layer, names)
    text = activated(layer, f"{own}[o]", f"{x}[o] + " if layer.residual else "", rounded=rounded)
    found += [f"for (int o = 0; o < {groups}; ++o) {own}[o] = {text};"] * (text != f"{own}[o]")
    return found, names


def activated(layer: Dense, z: str, before: str, *, rounded: bool) -> str:
    """Text of what a layer makes of its sums."""
    value = z if layer.omega == 1 else f"{literal(layer.omega)} * {z}"
    value = {
        "linear": value, "relu": f"max({value}, 0.0)", "sine": f"btfkit_sine({value})",
        "leaky": f"max({value}, {literal(LEAK)} * ({value}))",
    }[layer.activation]  # fmt: skip
    return before + (f"btfkit_rounded({value})" if rounded else value)


def grouped(values: Array) -> Array:
    """(g, 4) of (n,), zeros after the last."""
    found = np.zeros(-(-len(values) // 4) * 4, np.float32)
    found[: len(values)] = values
    return found.reshape(-1, 4)


def padded(matrix: Array, columns: int) -> Array:
    """The matrix with zeros up to a number of columns, and up to whole groups of rows."""
    found = np.zeros((-(-matrix.shape[0] // 4) * 4, columns), np.float32)
    found[: matrix.shape[0], : matrix.shape[1]] = matrix
    return found


def arranged(matrix: Array, inputs: Sequence[str], sources: Sequence[Source]) -> Array:
    """The matrix with its columns where the sources have the inputs."""
    found = np.zeros((-(-matrix.shape[0] // 4) * 4, 4 * len(sources)), np.float32)
    at = {n: 4 * s + k for s, source in enumerate(sources) for k, n in enumerate(source.names) if n}
    for column, name in enumerate(inputs):
        found[: len(matrix), at[name]] += matrix[:, column]
    return found
