"""NeuMIP as it is used: rays through heights (or an offset texture), a pyramid, small networks.

Source: Kuznetsov et al., "NeuMIP: Multi-Resolution Neural Materials", ACM TOG 40(4), 2021.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from btfkit.directions import normalize
from btfkit.materials.base import Array, Header, Material
from btfkit.materials.neumip.arrays import flatten, name_arrays, networks, stored_as, textures
from btfkit.materials.neumip.spec import NeuMIPSpec, Precision
from btfkit.native.neural import Kernel, available, plain
from btfkit.native.neural.layout import Networks
from btfkit.program import Program
from btfkit.queries import Query


class NeuMIPMaterial(Material):
    """What all NeuMIPs share, SBTF among them: the arrays, the kernels and the program."""

    spec_type: ClassVar[type] = NeuMIPSpec
    has_levels: ClassVar[bool] = True

    def __init__(self, spec: NeuMIPSpec, weights: Mapping[str, NDArray[Any]], header: Header):
        super().__init__(spec, weights, header)
        self.layout = spec.layout(header)
        self.flat, self.texels = flatten(spec, self.layout, self.weights)
        self._program = self.layout.program(
            self.flat,
            self.texels,
            channels=header.channels,
            grid=header.grid,
            networks=spec.networks,
            released=spec.output == "released",
            leveled=spec.levels > 1,
        )
        self._kernel = Kernel(self.layout, networks=spec.networks) if available() else None
        if self._kernel:
            self._kernel.freeze(self.texels)

    @classmethod
    def shapes(cls, spec: NeuMIPSpec, header: Header) -> dict[str, tuple[int, ...]]:
        found: dict[str, tuple[int, ...]] = {}
        layout = spec.layout(header)
        for name, network in networks(layout):
            for k, (a, b) in enumerate(zip(network.widths, network.widths[1:], strict=False)):
                found[f"{name}.{k}.weight"] = (b, a)
                found[f"{name}.{k}.bias"] = (b,)
        for name, (h, w), channels in textures(layout):
            found[name] = (h, w, channels)
            if stored_as(spec, name) == "int8":
                found[f"{name}.range"] = (2, channels)
        return found

    def _answer(self, query: Query) -> tuple[Array, Array | None]:
        footprint = self._footprint(query)
        released = self.spec.output == "released"
        if self._kernel is None:
            answer, _ = plain.answer(self._program, query.uv, query.light, query.view, footprint)
        else:
            parts = (self.flat, self.texels, query.uv, query.light, query.view, footprint)
            answer = self._kernel.evaluate(*parts, raw=released)
            answer = plain.released(answer[:, :3], answer[:, 3:]) if released else answer
        return answer.astype(np.float32, copy=False), None

    def _keeps_views(self) -> bool:
        return self._kernel is not None and self.spec.output != "released"

    def _answer_lights(
        self, query: Query, drift: Array | None = None
    ) -> tuple[Array, Array | None]:
        assert self._kernel is not None
        parts = (query.uv, query.light, query.view, self._footprint(query))
        return self._kernel.evaluate_lights(self.flat, self.texels, *parts), None

    def _footprint(self, query: Query) -> Array | None:
        # One level, no logarithms: what most queries ask.
        finest = self.spec.levels == 1 or not np.any(query.footprint > 0.5)
        return None if finest else np.ascontiguousarray(query.footprint)

    def program(self) -> Program:
        return self._program

    def depths(self, uv: ArrayLike, view: ArrayLike) -> Array:
        """Ray depth (b,) that the offset stage finds, tile widths, positive above the plane."""
        where = np.ascontiguousarray(np.asarray(uv, np.float32).reshape(-1, 2))
        seen = np.ascontiguousarray(normalize(view).reshape(-1, 3), np.float32)
        if self._kernel is None:
            return plain.depths(self._program, where, seen)
        return self._kernel.depths(self.flat, self.texels, where, seen)


@final
class NeuMIP(NeuMIPMaterial):
    """NeuMIP with what docs/neumip.md found to be better at the same cost."""

    model: ClassVar[str] = "neumip"


@final
class NeuMIPPaper(NeuMIPMaterial):
    """NeuMIP as published."""

    model: ClassVar[str] = "neumip-paper"


@final
class Student(NeuMIPMaterial):
    """A NeuMIP with two small layers, for phones and games."""

    model: ClassVar[str] = "student"


def in_precision(
    material: NeuMIPMaterial, precision: Precision, networks: Networks | None = None
) -> NeuMIPMaterial:
    """The same model with its textures stored as float32, float16 or int8.

    Args:
        networks: what evaluation multiplies, as in `NeuMIPSpec`; None leaves it. Matrices that
            were rounded stay so.
    """
    spec = replace(material.spec, precision=precision, networks=networks or material.spec.networks)
    arrays = name_arrays(spec, material.layout, material.flat, material.texels)
    return type(material)(spec, arrays, material.header)
