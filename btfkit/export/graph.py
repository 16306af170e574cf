"""A graph of ONNX as it is written: values that know arithmetic."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

# Old enough for runtimes on phones; nothing newer is needed.
OPSET, IR_VERSION = 17, 8


@final
class Graph:
    """Nodes and arrays in the order in which they are asked for.

    Attributes:
        nodes: of the graph. arrays: its constants by name.
    """

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.arrays: dict[str, NDArray[Any]] = {}
        self._known: dict[tuple[Any, ...], Value] = {}

    def array(self, values: Any, dtype: Any = np.float32) -> Value:
        """A constant; equal ones are held once."""
        found = np.ascontiguousarray(values, dtype)
        key = (found.dtype.str, found.shape, found.tobytes())
        if key not in self._known:
            name = f"c{len(self.arrays)}"
            self.arrays[name] = found
            self._known[key] = Value(self, name)
        return self._known[key]

    def op(self, kind: str, *inputs: Value | str, **attributes: Any) -> Value:
        """What a node gives."""
        from onnx import helper

        names = [value.name if isinstance(value, Value) else value for value in inputs]
        out = f"v{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, names, [out], **attributes))
        return Value(self, out)

    def input(self, name: str) -> Value:
        """An input of the graph."""
        return Value(self, name)

    def joined(self, parts: list[Value]) -> Value:
        """Columns side by side."""
        return parts[0] if len(parts) == 1 else self.op("Concat", *parts, axis=1)


@final
@dataclass(frozen=True, eq=False)
class Value:
    """Something (b, k) that a node gives, or an array.

    Attributes:
        graph: that it belongs to. name: in it.
    """

    graph: Graph
    name: str

    def __add__(self, other: Any) -> Value:
        return self._with("Add", other)

    def __sub__(self, other: Any) -> Value:
        return self._with("Sub", other)

    def __mul__(self, other: Any) -> Value:
        return self._with("Mul", other)

    def __truediv__(self, other: Any) -> Value:
        return self._with("Div", other)

    def __gt__(self, other: Any) -> Value:
        return self._with("Greater", other)

    def __lt__(self, other: Any) -> Value:
        return self._with("Less", other)

    def __and__(self, other: Value) -> Value:
        return self._with("And", other)

    def __or__(self, other: Value) -> Value:
        return self._with("Or", other)

    def __matmul__(self, other: Value) -> Value:
        return self._with("MatMul", other)

    def __getitem__(self, columns: slice) -> Value:
        numbers = (columns.start, columns.stop, 1)
        return self.graph.op("Slice", self, *(self.graph.array([n], np.int64) for n in numbers))

    def of(self, kind: str, **attributes: Any) -> Value:
        """A node of this value alone."""
        return self.graph.op(kind, self, **attributes)

    def cast(self, to: int) -> Value:
        """In another type of `onnx.TensorProto`."""
        return self.graph.op("Cast", self, to=to)

    def between(self, low: Any, high: Any) -> Value:
        """Cut to low..high."""
        return self.at_least(low)._with("Min", high)

    def at_least(self, low: Any) -> Value:
        """The larger of both."""
        return self._with("Max", low)

    def at_most(self, high: Any) -> Value:
        """The smaller of both."""
        return self._with("Min", high)

    def where(self, yes: Any, no: Any) -> Value:
        """`yes` where this holds, else `no`."""
        return self.graph.op("Where", self, self._value(yes), self._value(no))

    def total(self) -> Value:
        """(b, 1) sums over columns."""
        axes = self.graph.array([1], np.int64)
        return self.graph.op("ReduceSum", self, axes, keepdims=1)

    def mean(self) -> Value:
        """(b, 1) means over columns."""
        return self.graph.op("ReduceMean", self, axes=[1], keepdims=1)

    def most(self) -> Value:
        """(b, 1) the largest of the columns."""
        return self.graph.op("ReduceMax", self, axes=[1], keepdims=1)

    def _with(self, kind: str, other: Any) -> Value:
        return self.graph.op(kind, self, self._value(other))

    def _value(self, other: Any) -> Value:
        return other if isinstance(other, Value) else self.graph.array(other)
