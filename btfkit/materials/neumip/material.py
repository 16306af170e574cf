"""NeuMIP as it is used: rays through heights (or an offset texture), a pyramid, small networks.

Source: Kuznetsov et al., "NeuMIP: Multi-Resolution Neural Materials", ACM TOG 40(4), 2021.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from btfkit import queries
from btfkit.directions import normalize
from btfkit.materials.base import Array, Header, Material
from btfkit.materials.neumip.arrays import flatten, name_arrays, networks, stored_as, textures
from btfkit.materials.neumip.spec import NeuMIPSpec, Precision
from btfkit.native.neural import Kernel, available
from btfkit.native.neural.layout import Networks
from btfkit.native.neural.plain import depths_plain, evaluate_plain
from btfkit.queries import Query


class _NeuMIP(Material):
    """Both NeuMIPs: what differs is the name, and how they were trained."""

    spec_type: ClassVar[type] = NeuMIPSpec
    has_levels: ClassVar[bool] = True

    def __init__(self, spec: NeuMIPSpec, weights: Mapping[str, NDArray[Any]], header: Header):
        super().__init__(spec, weights, header)
        self.layout = spec.layout(header)
        self.flat, self.texels = flatten(spec, self.layout, self.weights)
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
        # One level, no logarithms: what most queries ask.
        finest = self.spec.levels == 1 or not np.any(query.footprint > 0.5)
        footprint = None if finest else np.ascontiguousarray(query.footprint)
        parts = (self.flat, self.texels, query.uv, query.light, query.view, footprint)
        released = self.spec.output == "released"
        if self._kernel is None:
            answer = evaluate_plain(self.layout, *parts, raw=released, networks=self.spec.networks)
        else:
            answer = self._kernel.evaluate(*parts, raw=released)
        answer = released_answer(answer) if released else answer
        return answer.astype(np.float32, copy=False), None

    def _answer_lights(
        self, uv: ArrayLike, light: ArrayLike, view: ArrayLike, footprint: ArrayLike
    ) -> Array | None:
        if self._kernel is None:
            return None
        every = np.asarray(light, np.float32)
        query, shape = queries.broadcast(uv, every[0], view, footprint)
        lights = every.reshape(-1, 3)
        # Masked queries are counted one by one elsewhere.
        lengths = [np.linalg.norm(d.astype(np.float64), axis=1) for d in (query.view, lights)]
        if not (np.all(query.view[:, 2] >= 0) and all(np.all(size > 1e-30) for size in lengths)):
            return None
        try:
            rgb = self.evaluate_lights(query.uv, query.view, lights, query.footprint)
        except ValueError:
            return None
        return rgb.reshape(*np.broadcast_shapes(every.shape[:-1], shape), self.spec.channels)

    def evaluate_lights(
        self, uv: ArrayLike, view: ArrayLike, lights: ArrayLike, footprint: ArrayLike = 0.5
    ) -> Array:
        """Reflectance (m, b, c) of b views under m lights that all of them share.

        The offset stage and the features are computed once a view, for all lights.

        Args:
            uv: (b, 2). view: (b, 3) above the horizon. lights: (m, 3).
            footprint: (b,) or one number, texels of the grid.

        Raises:
            ValueError: shapes that do not fit, or values that are not finite.
        """
        at = np.asarray(uv, np.float64).reshape(-1, 2)
        tile = at - np.floor(at) if self.header.wrap == "wrap" else np.clip(at, 0, 1)
        where = np.ascontiguousarray(tile, np.float32)
        seen = np.ascontiguousarray(normalize(view).reshape(-1, 3), np.float32)
        lit = np.ascontiguousarray(normalize(lights).reshape(-1, 3), np.float32)
        sigma = np.ascontiguousarray(
            np.broadcast_to(np.asarray(footprint, np.float32), len(where)), np.float32
        )
        if len(seen) != len(where):
            raise ValueError(f"{len(where)} places for {len(seen)} views; expected as many")
        if not all(np.isfinite(part).all() for part in (where, seen, lit, sigma)):
            raise ValueError("uv, view, lights and footprint must be finite here")
        if self._kernel is None or self.spec.output == "released":
            each = [self.evaluate(where, light, seen, sigma).reflectance for light in lit]
            return np.stack(each) if each else np.zeros((0, len(where), self.spec.channels), "f4")
        blur = None if self.spec.levels == 1 or not np.any(sigma > 0.5) else sigma
        rgb = self._kernel.evaluate_lights(self.flat, self.texels, where, lit, seen, blur)
        rgb[lit[:, 2] <= 0] = 0
        rgb[:, seen[:, 2] < 0] = 0
        return rgb

    def depths(self, uv: ArrayLike, view: ArrayLike) -> Array:
        """Ray depth (b,) that the offset stage finds, tile widths, positive above the plane."""
        where = np.ascontiguousarray(np.asarray(uv, np.float32).reshape(-1, 2))
        seen = np.ascontiguousarray(normalize(view).reshape(-1, 3), np.float32)
        if self._kernel is None:
            return depths_plain(
                self.layout, self.flat, self.texels, where, seen, networks=self.spec.networks
            )
        return self._kernel.depths(self.flat, self.texels, where, seen)


@final
class NeuMIP(_NeuMIP):
    """NeuMIP with what docs/neumip.md found to be better at the same cost."""

    model: ClassVar[str] = "neumip"


@final
class NeuMIPPaper(_NeuMIP):
    """NeuMIP as published."""

    model: ClassVar[str] = "neumip-paper"


def released_answer(raw: NDArray[Any]) -> NDArray[Any]:
    """Reflectance (b, 3) from the six numbers of the published program.

    Source: the program's default configuration, as neumip.md describes it.
    """
    yuv, mask = np.minimum(raw[:, :3], 20), raw[:, 3:]
    rgb = np.expm1(np.minimum(yuv @ YUV_TO_RGB.T.astype(raw.dtype), 20))
    return np.maximum(rgb * (0.1 + 1 / (1 + np.exp(-np.clip(mask, -80, 80)))), 0)


YUV_TO_RGB = np.array([[1, 0, 1.13983], [1, -0.39465, -0.5806], [1, 2.03211, 0]])  # BT.601


def in_precision(
    material: _NeuMIP, precision: Precision, networks: Networks | None = None
) -> _NeuMIP:
    """The same model with its textures stored as float32, float16 or int8.

    Args:
        networks: what evaluation multiplies, as in `NeuMIPSpec`; None leaves it. Matrices that
            were rounded stay so.
    """
    spec = replace(material.spec, precision=precision, networks=networks or material.spec.networks)
    arrays = name_arrays(spec, material.layout, material.flat, material.texels)
    return type(material)(spec, arrays, material.header)
