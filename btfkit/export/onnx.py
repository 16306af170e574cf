"""`onnx`: the whole evaluation as one graph, textures and lookups within it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit import jsonvalues
from btfkit.conventions import (
    CURVATURE_UNIT,
    EPSILON,
    LEAK,
    LEVELS_UNIT,
    LOWEST_COSINE,
    LOWEST_SEEN,
    MOST_LOG,
)
from btfkit.export import rays
from btfkit.export.arrays import narrowed
from btfkit.export.curvature import words
from btfkit.export.graph import IR_VERSION, OPSET, Graph, Value
from btfkit.export.sections import filled, sections
from btfkit.materials.base import Material
from btfkit.native.neural.bent import sharpest
from btfkit.native.neural.plain import YUV_TO_RGB, bfloat16
from btfkit.program import (
    Cover,
    Dense,
    DepthNetwork,
    Heights,
    OffsetNetwork,
    Program,
    Texture,
)

# Names of element types of `onnx.TensorProto`.
_FLOAT, _DOUBLE, _INT64, _BFLOAT16 = 1, 11, 7, 16
Known = dict[str, Value]


def write(material: Material, program: Program, folder: Path) -> None:
    """`material.onnx`, and `evaluate.py`, which answers a query file by it.

    Raises:
        ValueError: the package onnx is missing.
    """
    try:
        import onnx
    except ImportError as error:
        raise ValueError(
            'ONNX is written by the package onnx, which is missing: pip install "btfkit[onnx]"'
        ) from error
    from btfkit.export.package import about

    said = json.dumps(jsonvalues.plain(about(material)))
    model = built(program, name=material.model, about=said)
    onnx.checker.check_model(model)
    onnx.save(model, folder / "material.onnx")
    text = sections("onnx.py.txt")["evaluate.py"]
    (folder / "evaluate.py").write_text(filled(text, model=material.model, **words(program)))


def built(program: Program, *, name: str, about: str) -> Any:
    """The model of ONNX: uv, light, view, footprint, curvature where it counts, to rgb, opacity.

    Args:
        name: of the graph. about: what the model carries as its metadata.
    """
    from onnx import TensorProto, helper, numpy_helper

    graph = Graph()
    rgb, opacity = _answered(graph, program)
    for out, value in (("rgb", rgb), ("opacity", opacity)):
        graph.nodes.append(helper.make_node("Identity", [value.name], [out]))
    info = helper.make_tensor_value_info
    shapes = {"uv": ["b", 2], "light": ["b", 3], "view": ["b", 3], "footprint": ["b"]}
    shapes |= {"curvature": ["b"]} if program.bends else {}
    outputs = {"rgb": ["b", len(program.channels)], "opacity": ["b"]}
    made = helper.make_graph(
        graph.nodes,
        name,
        [info(n, TensorProto.FLOAT, shape) for n, shape in shapes.items()],
        [info(n, TensorProto.FLOAT, shape) for n, shape in outputs.items()],
        [numpy_helper.from_array(array, n) for n, array in graph.arrays.items()],
    )
    model = helper.make_model(made, opset_imports=[helper.make_opsetid("", OPSET)])
    model.ir_version = IR_VERSION
    model.producer_name = "btfkit"
    helper.set_model_props(model, {"btfkit": about})
    return model


def _answered(graph: Graph, program: Program) -> tuple[Value, Value]:
    """rgb (b, c) and opacity (b,) of the inputs; 0 for what cannot be answered."""
    uv, footprint = graph.input("uv"), graph.input("footprint")
    columns = graph.array([1], np.int64)
    blur = graph.op("Unsqueeze", footprint, columns)
    light, lit = _unit(graph.input("light"))
    view, seen = _unit(graph.input("view"))
    bend: Value | None = None
    good = lit & seen & _finite(uv) & _finite(blur)
    if program.bends:
        bend = graph.op("Unsqueeze", graph.input("curvature"), columns)
        good = good & _finite(bend)
    good = good & (view[2:3] < 0.0).of("Not")
    up = graph.array([[0, 0, 1]])
    uv = good.where(uv, 0.0)
    uv = uv - uv.of("Floor") if program.wrap else uv.between(0.0, 1.0)
    light, view = good.where(light, up), good.where(view, up)
    bend = None if bend is None else good.where(bend, 0.0)
    made = _Evaluation(graph, program, uv, light, view, good.where(blur, 0.5), bend)
    rgb, opacity = made.answer()
    shown = good & (opacity > 0.0)
    if program.curved or not program.full_sphere:
        shown = shown & (made.light[2:3] > 0.0)
    rgb = shown.where(rgb, 0.0)
    return rgb, graph.op("Squeeze", good.where(opacity, 0.0), columns)


def _unit(way: Value) -> tuple[Value, Value]:
    """Directions of length 1, and whether they had one that is finite and above 0."""
    finite = _finite(way)
    wide = finite.where(way, 0.0).cast(_DOUBLE)
    length = (wide * wide).total().of("Sqrt")
    least = way.graph.array(1e-30, np.float64)
    unit = (wide / length.at_least(least)).cast(_FLOAT)
    return unit, finite & (length > least)


def _finite(value: Value) -> Value:
    """(b, 1) whether every column is finite: a comparison with NaN holds never."""
    small = value.of("Abs")._with("LessOrEqual", float(np.finfo(np.float32).max))
    return small.of("Not").cast(_FLOAT).most() < 0.5


class _Evaluation:
    """The evaluation of a program, node by node; shapes and order as in its plain twin."""

    def __init__(
        self,
        graph: Graph,
        program: Program,
        uv: Value,
        light: Value,
        view: Value,
        blur: Value,
        bend: Value | None,
    ) -> None:
        self.graph, self.program = graph, program
        self.uv, self.light, self.view, self.bend = uv, light, view, bend
        level = view[0:1] * 0.0
        if program.leveled:
            level = (blur.between(0.5, 1e30) * 2.0).of("Log") * (1 / np.log(2))
        self.level = level
        self.toward, self.away = self._step(view), self._step(light)
        self.opacity = level * 0.0 + 1.0
        self.depth = self._marched() if isinstance(program.depth, Heights) else None
        self.known = self._query()

    def answer(self) -> tuple[Value, Value]:
        program = self.program
        depth = self._moves()
        values = [self._moved(texture, depth) for texture in program.textures]
        for k in range(program.frames):
            axis = values[0][3 * k : 3 * k + 3]
            self.known[f"frame.{k}.half"] = (axis * self.half).total()
            self.known[f"frame.{k}.light"] = (axis * self.light).total()
        for texture, found in zip(program.textures, values, strict=True):
            self.known |= self._columns(texture.features, found)
        raw = self._run(program.layers, program.inputs)
        heads, at = {}, 0
        for head in program.heads:
            heads[head.kind] = raw[at : at + head.count]
            at += head.count
        rgb = self._reflectance(heads, depth)
        opacity = heads["opacity"].of("Sigmoid") if "opacity" in heads else self.opacity
        return rgb, opacity

    def _query(self) -> Known:
        light, view = self.light, self.view
        total = light + view
        length = (total * total).total().of("Sqrt")
        none = length < 1e-6
        up = self.graph.array([[0, 0, 1]])
        self.half = none.where(up, total / length.at_least(1e-6))
        known = self._columns(("lx", "ly", "lz"), light) | self._columns(("vx", "vy", "vz"), view)
        known |= self._columns(("hx", "hy", "hz"), self.half)
        known["cos_diff"] = none.where(0.0, length * 0.5)
        known["level"] = self.level * (1 / LEVELS_UNIT)
        known["curvature"] = self.level * 0.0
        if self.bend is not None:
            known["curvature"] = self.bend / (self.bend.of("Abs") + CURVATURE_UNIT)
        asked = self.program.every_input
        for name, way in (("l", light), ("v", view)):
            if f"{name}x_disc" in asked or f"{name}y_disc" in asked:
                known |= self._columns((f"{name}x_disc", f"{name}y_disc"), _on_disc(way))
        return known

    def _columns(self, names: Sequence[str], values: Value) -> Known:
        return {name: values[k : k + 1] for k, name in enumerate(names)}

    def _step(self, way: Value) -> Value:
        """Displacement in uv of one tile width of depth."""
        flip = self.graph.array([[1, -self.program.aspect]])
        return way[0:2] / way[2:3].at_least(LOWEST_COSINE) * flip

    def _marched(self) -> Value:
        """Ray depth through heights; where curvature bends rays, light and view are turned."""
        program, found = self.program, self.program.depth
        assert isinstance(found, Heights)
        parts = (self.graph, found, self._lookup, self.uv, self.view)
        if not program.curved or self.bend is None:
            return rays.on_plane(*parts, program.aspect)
        low, high = sharpest(found)
        self.bend = self.bend.between(max(low, -1e30), min(high, 1e30))
        met = rays.on_curved(*parts, self.bend, program.aspect)
        if found.opacity is None:
            bends = self.bend.of("Abs") > 0.0
            flat = (rays.on_plane(*parts, program.aspect), self.opacity, self.level * 0.0)
            met = rays.Met(*(bends.where(a, b) for a, b in zip(met, flat, strict=True)))
        light, view = (
            rays.turned(self.graph, way, self.view, met.turn) for way in (self.light, self.view)
        )
        still = (met.turn.of("Abs") > 0.0).of("Not")
        upright = still.where(view[2:3], view[2:3].at_least(LOWEST_SEEN))
        self.light, self.view = light, self.graph.joined([view[0:2], upright])
        self.opacity = met.opacity
        return met.depth

    def _moves(self) -> Value | None:
        """What moves lookups: a depth (b, 1), an offset (b, 2); asks the network of opacity."""
        cover, found = self.program.cover, self.program.depth
        if cover is not None:
            number = self._network(cover)[0:1]
            if cover.kind == "direct":
                self.opacity = number.of("Sigmoid")
            else:
                self.opacity = (self.view[2:3] < number).where(0.0, 1.0)
        if isinstance(found, DepthNetwork):
            return self._network(found)[0:1] * found.scale
        return self._network(found) if isinstance(found, OffsetNetwork) else self.depth

    def _network(self, part: Cover | DepthNetwork | OffsetNetwork) -> Value:
        place = self._lookup(part.texture.levels[0], self.uv)
        known = self.known | self._columns(part.texture.features, place)
        return self._run(part.layers, part.inputs, known)

    def _lookup(self, texture: NDArray[Any], uv: Value) -> Value:
        """(b, k) bilinear between texel centres."""
        h, w, k = texture.shape
        size = self.graph.array([[w, h]])
        wrap = self.program.wrap
        at = (uv - uv.of("Floor") if wrap else uv.between(0.0, 1.0)) * size - 0.5
        low = at.of("Floor")
        share = at - low
        near, far = (where.cast(_INT64) for where in (low, low + 1.0))
        edge = self.graph.array([[w, h]], np.int64)
        zero, one = (self.graph.array(n, np.int64) for n in (0, 1))
        if wrap:
            # Of -1..w: rounding may lift a share of 1 - 2^-25 to the next tile.
            near, far = (((place + edge)._with("Mod", edge)) for place in (near, far))
        else:
            near, far = (place.between(zero, edge - one) for place in (near, far))
        half = narrowed(texture.reshape(h * w, k))
        flat = self.graph.array(half, half.dtype)
        flat = flat.cast(_FLOAT) if half.dtype == np.float16 else flat
        width = self.graph.array(w, np.int64)

        def row(y: Value) -> Value:
            found = []
            for x in (near, far):
                place = self.graph.op(
                    "Squeeze", y * width + x[0:1], self.graph.array([1], np.int64)
                )
                found.append(self.graph.op("Gather", flat, place, axis=0))
            fx = share[0:1]
            return found[0] * (self.graph.array(1.0) - fx) + found[1] * fx

        fy = share[1:2]
        return row(near[1:2]) * (self.graph.array(1.0) - fy) + row(far[1:2]) * fy

    def _between(self, texture: Texture, uv: Value) -> Value:
        levels = texture.levels
        if len(levels) == 1:
            return self._lookup(levels[0], uv)
        at = (self.level - texture.shift).between(0.0, len(levels) - 1.0)
        found: Value | None = None
        for s, level in enumerate(levels):
            weight = (self.graph.array(1.0) - (at - float(s)).of("Abs")).at_least(0.0)
            part = weight * self._lookup(level, uv)
            found = part if found is None else found + part
        assert found is not None
        return found

    def _moved(self, texture: Texture, depth: Value | None) -> Value:
        uv = self.uv
        if depth is not None and isinstance(self.program.depth, OffsetNetwork):
            uv = uv + depth * texture.view if texture.view else uv
        elif depth is not None and (texture.view or texture.light):
            way = self.toward * texture.view
            if texture.light:
                way = way - self.away * texture.light
            uv = uv + depth * way
        return self._between(texture, uv)

    def _run(
        self, layers: Sequence[Dense], inputs: Sequence[str], known: Known | None = None
    ) -> Value:
        known = self.known if known is None else known
        x = self.graph.joined([known[name] for name in inputs])
        rounded = self.program.rounded
        for k, layer in enumerate(layers):
            weight = bfloat16(layer.weight) if rounded and k else layer.weight
            z = x @ self.graph.array(weight.T) + self.graph.array(layer.bias[None])
            if layer.gain is not None and layer.centre is not None:
                z = z - z.mean()
                z = z / ((z * z).mean() + EPSILON).of("Sqrt")
                z = z * self.graph.array(layer.gain[None]) + self.graph.array(layer.centre[None])
            z = z if layer.omega == 1 else z * layer.omega
            kind = layer.activation
            if kind == "leaky":
                z = z.of("LeakyRelu", alpha=LEAK)
            elif kind != "linear":
                z = z.of({"relu": "Relu", "sine": "Sin"}[kind])
            if rounded and k + 1 < len(layers):
                z = z.cast(_BFLOAT16).cast(_FLOAT)
            x = x + z if layer.residual else z
        return x

    def _reflectance(self, heads: dict[Any, Value], depth: Value | None) -> Value:
        program = self.program
        if program.output == "cosine":
            return heads["linear"] * self.light[2:3]
        if program.output == "linear":
            return heads["linear"].at_least(0.0)
        if program.output == "released":
            to_rgb = self.graph.array(YUV_TO_RGB.T)
            y = (heads["log"].at_most(MOST_LOG) @ to_rgb).at_most(MOST_LOG)
            rgb = (y.of("Exp") - 1.0) * (heads["mask"].of("Sigmoid") + 0.1)
            return rgb.at_least(0.0)
        y = heads["log"]
        if program.scaling:
            c = len(program.channels)
            scaled = self._moved(program.scaling, depth)
            y = scaled[0:c] + scaled[c : 2 * c] * y
        if "mask" in heads:
            y = y * (heads["mask"].of("Sigmoid") + 0.1)
        return y.between(0.0, MOST_LOG).of("Exp") - 1.0


def _on_disc(way: Value) -> Value:
    """(b, 2) azimuth kept, radius 2 / pi x polar angle."""
    flat, z = way[0:2], way[2:3]
    sine = (flat * flat).total().of("Sqrt")
    # Half the angle has the tangent sine / (1 + cosine); straight below that is infinite.
    angle = (sine / (z + 1.0).at_least(1e-12)).of("Atan") * 2.0
    stretch = (sine > 1e-6).where(angle / sine.at_least(1e-6), 1.0)
    return flat * stretch * (2 / np.pi)
