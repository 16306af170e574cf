"""NeuMIP as it is used: an offset texture, a pyramid of feature textures, two small networks.

Source: Kuznetsov et al., "NeuMIP: Multi-Resolution Neural Materials", ACM TOG 40(4), 2021.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from btfkit.directions import normalize
from btfkit.materials.base import Array, Header, Material
from btfkit.native.neumip import Kernel, available
from btfkit.native.neumip_layout import (
    CHANNELS,
    Activation,
    Layout,
    Network,
    Networks,
    Output,
    Pyramid,
)
from btfkit.native.neumip_plain import bfloat16, depths_plain, evaluate_plain
from btfkit.queries import Query

Precision = Literal["float32", "float16", "int8"]
# Levels that the coarse bank begins above the finest one.
_COARSE = 2


@final
@dataclass(frozen=True)
class NeuMIPSpec:
    """All that decides a NeuMIP's shapes and how its numbers are read.

    Attributes:
        size: (h, w) of the finest texture.
        levels: of the pyramid; 1 for a single scale.
        features: channels of the pyramid, 1 to 8.
        coarse: channels of a second pyramid that begins two levels up; 0 for none.
        light: channels of a texture that is read where the light comes in; 0 for none.
        offset: channels of the offset texture, 1 to 8; 0 for no offset network.
        heights: whether the ray depth is where the view ray meets a texture of heights; then
            there is no offset network, whatever `offset` says.
        frames: vectors among the pyramid's channels, three each, whose products with the half
            vector and the light the decoder takes too: 0, 1 or 2.
        hidden, offset_hidden: widths of the hidden layers.
        activation, offset_activation: of the hidden layers.
        directions: what the decoder takes beside the features.
        output: "log", "relu" or "mask" as in `Layout`; "released" for the six numbers of the
            published program: exp(YUV to RGB) - 1, times 0.1 + sigmoid.
        depth_scale: tile widths a unit of the offset network, or of the heights.
        channels: of the answer.
        precision: of the stored textures; heights take at least float16.
        networks: what evaluation multiplies after each network's first layer. "bfloat16" is
            faster where the processor multiplies pairs of them, and equal elsewhere but for
            rounding; these matrices are stored rounded, in float32.
    """

    size: tuple[int, int]
    levels: int = 1
    features: int = 7
    coarse: int = 0
    light: int = 0
    offset: int = 7
    hidden: tuple[int, ...] = (25, 25, 25)
    offset_hidden: tuple[int, ...] = (25, 25, 25)
    activation: Activation = "relu"
    offset_activation: Activation = "relu"
    directions: tuple[str, ...] = ("lx", "ly", "vx", "vy")
    output: Literal["log", "relu", "mask", "released"] = "log"
    depth_scale: float = 0.05
    channels: int = 3
    precision: Precision = "float32"
    heights: bool = False
    frames: int = 0
    networks: Networks = "float32"

    def layout(self, header: Header) -> Layout:
        """The model as its kernels see it."""
        shift = _level_of(self.size, header.grid)
        banks = [Pyramid(sizes(self.size, self.levels), self.features, shift=shift)]
        if self.coarse:
            base = sizes(self.size, _COARSE + 1)[-1]
            levels = max(self.levels - _COARSE, 1)
            start = _level_of(base, header.grid)
            banks.append(Pyramid(sizes(base, levels), self.coarse, shift=start))
        if self.light:
            banks.append(Pyramid((self.size,), self.light, light=1.0, shift=shift))
        outputs = self.channels * (2 if self.output in ("mask", "released") else 1)
        inputs = sum(bank.channels for bank in banks) + 2 * self.frames + len(self.directions)
        decoder = Network((inputs, *self.hidden, outputs), self.directions, self.activation)
        offset = None
        if self.offset and not self.heights:
            widths = (self.offset + 2, *self.offset_hidden, 1)
            network = Network(widths, ("vx", "vy"), self.offset_activation)
            offset = (Pyramid((self.size,), self.offset), network)
        # The kernels give the raw numbers of "released"; their channels are all of them.
        released = self.output == "released"
        output: Output = "log" if self.output == "released" else self.output
        return Layout(
            decoder,
            tuple(banks),
            offset,
            self.size if self.heights else None,
            self.frames,
            channels=outputs if released else self.channels,
            output=output,
            aspect=header.aspect,
            depth_scale=self.depth_scale,
            wrap=header.wrap == "wrap",
        )


def sizes(size: tuple[int, int], levels: int) -> tuple[tuple[int, int], ...]:
    """(h, w) of each level of a pyramid, halved and rounded down, never below 1."""
    return tuple((max(size[0] >> s, 1), max(size[1] >> s, 1)) for s in range(levels))


def most_levels(size: tuple[int, int]) -> int:
    """Levels of a pyramid that ends in one texel."""
    return max(size).bit_length()


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
        for name, network in _networks(layout):
            for k, (a, b) in enumerate(zip(network.widths, network.widths[1:], strict=False)):
                found[f"{name}.{k}.weight"] = (b, a)
                found[f"{name}.{k}.bias"] = (b,)
        for name, (h, w), channels in _textures(layout):
            found[name] = (h, w, channels)
            if _stored_as(spec, name) == "int8":
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


def flatten(
    spec: NeuMIPSpec, layout: Layout, weights: Mapping[str, NDArray[Any]]
) -> tuple[Array, Array]:
    """The kernels' two flat arrays from a model's named ones."""
    flat = np.concatenate(
        [
            np.asarray(weights[f"{name}.{k}.{part}"], np.float32).reshape(-1)
            for name, network in _networks(layout)
            for k in range(len(network.widths) - 1)
            for part in ("weight", "bias")
        ]
    )
    texels = aligned(layout.texels)
    for view, (name, _, channels) in zip(_views(layout, texels), _textures(layout), strict=True):
        stored = weights[name]
        if _stored_as(spec, name) == "int8":
            low, step = np.asarray(weights[f"{name}.range"], np.float32)
            stored = low + step * stored.astype(np.float32)
        view[..., :channels] = stored
    return flat, texels


def name_arrays(
    spec: NeuMIPSpec, layout: Layout, flat: Array, texels: Array
) -> dict[str, NDArray[Any]]:
    """A model's named arrays, textures in the spec's precision, from the kernels' flat ones."""
    found: dict[str, NDArray[Any]] = {}
    parts = layout.split(flat) if layout.offset else layout.split(flat)[1:]
    for (name, network), part in zip(_networks(layout), parts, strict=True):
        for k, (matrix, bias) in enumerate(network.layers(part)):
            rounded = k > 0 and spec.networks == "bfloat16"
            found[f"{name}.{k}.weight"] = bfloat16(matrix) if rounded else matrix.copy()
            found[f"{name}.{k}.bias"] = bias.copy()
    for view, (name, _, channels) in zip(_views(layout, texels), _textures(layout), strict=True):
        texture = view[..., :channels]
        kind = _stored_as(spec, name)
        if kind == "int8":
            low = texture.min(axis=(0, 1))
            # A constant channel has no range: any step but 0 keeps it exact.
            step = np.maximum((texture.max(axis=(0, 1)) - low) / 255, 1e-12).astype(np.float32)
            found[f"{name}.range"] = np.stack([low, step])
            found[name] = np.rint((texture - low) / step).clip(0, 255).astype(np.uint8)
        else:
            limit = np.finfo(kind).max
            found[name] = texture.clip(-limit, limit).astype(kind)
    return found


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


def aligned(texels: int) -> Array:
    """(texels, 8) zeros that begin on a cache line, so that a pair of texels is one."""
    raw = np.zeros(texels * CHANNELS + 16, np.float32)
    start = -raw.ctypes.data % 64 // 4
    return raw[start : start + texels * CHANNELS].reshape(texels, CHANNELS)


def _networks(layout: Layout) -> list[tuple[str, Network]]:
    offset = [("offset", layout.offset[1])] if layout.offset else []
    return [*offset, ("decoder", layout.decoder)]


def _textures(layout: Layout) -> list[tuple[str, tuple[int, int], int]]:
    found = []
    if layout.heights:
        found.append(("texture.heights", layout.heights, 1))
    if layout.offset:
        found.append(("texture.offset", layout.offset[0].sizes[0], layout.offset[0].channels))
    for b, bank in enumerate(layout.banks):
        found += [(f"texture.{b}.{s}", size, bank.channels) for s, size in enumerate(bank.sizes)]
    return found


def _stored_as(spec: NeuMIPSpec, name: str) -> Precision:
    """How a texture is stored. A ray that a step of 1/255 makes miss what it met ends far away."""
    rough = spec.precision == "int8" and name == "texture.heights"
    return "float16" if rough else spec.precision


def _views(layout: Layout, texels: Array) -> list[Array]:
    """A view of each texture that `_textures` lists."""
    heights = [layout.surface(texels)[..., None]] if layout.heights else []
    return heights + [texture for levels in layout.textures(texels) for texture in levels]


def _level_of(size: tuple[int, int], grid: tuple[int, int]) -> float:
    """Level of the data's grid that a texture of `size` resolves, 0 or more."""
    ratio = math.sqrt(grid[0] * grid[1] / (size[0] * size[1]))
    return max(math.log2(ratio), 0.0)
