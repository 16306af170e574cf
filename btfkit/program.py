"""What a material computes, as data: textures, where they are looked up, layers, outputs.

A `Program` is read by whatever evaluates a material without its class: the plain twin
(`native.neural.plain`), the kernels, exporters, the page viewer and renderers' plugins. It holds
arrays, no code. In order, for a query (uv, light, view, footprint, curvature):

0. cover: where a network says that the view ray passes, opacity is 0 and nothing else counts.
1. depth: where the view ray meets the heights (on a curved surface `native.neural.bent` says
   where), or what the depth network says, times `displacement(view)` moves uv; textures with a
   `light` part move along the light, too. An offset network moves uv by what it says itself.
2. textures: bilinear between texel centres, between levels by log2(2 x footprint) - shift.
3. frames: three features of the first texture each, as vectors.
4. inputs: one number a name, in order; on curved heights light and view are in the frame where
   the ray meets them. 5. layers. 6. heads and output: to reflectance, opacity.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, final

import numpy as np
from numpy.typing import NDArray

from btfkit.conventions import CURVED_LOOKS, INPUTS

Floats = NDArray[Any]
Activation = Literal["linear", "relu", "leaky", "sine"]
Output = Literal["log", "relu", "released", "cosine", "linear"]
HeadKind = Literal["log", "mask", "opacity", "linear"]


@final
@dataclass(frozen=True, eq=False)
class Texture:
    """A texture, or a pyramid of them that is read by level of detail.

    Attributes:
        name: of its features: NAME.0, NAME.1, ...
        levels: (h, w, k) of each level, finest first.
        view, light: the lookup lies at uv + depth x (view x D(view) - light x D(light)), D being
            `conventions.displacement`.
        shift: level of the data, log2(2 x footprint), at which the finest texture is right.
    """

    name: str
    levels: tuple[Floats, ...]
    view: float = 0.0
    light: float = 0.0
    shift: float = 0.0

    @property
    def features(self) -> tuple[str, ...]:
        """The name of each channel."""
        return tuple(f"{self.name}.{k}" for k in range(self.levels[0].shape[-1]))


@final
@dataclass(frozen=True, eq=False)
class Dense:
    """A layer: y = activation(omega x (W x + b)), or of its normalised sum.

    Attributes:
        weight: (out, in). bias: (out,). activation: of what it gives.
        omega: factor before the activation.
        gain, centre: (out,) of a normalisation over the layer's sums (mean 0, deviation 1, with
            `conventions.EPSILON` in its root), before `omega`; None without.
        residual: whether the layer's input is added to its answer.
    """

    weight: Floats
    bias: Floats
    activation: Activation
    omega: float = 1.0
    gain: Floats | None = None
    centre: Floats | None = None
    residual: bool = False


@final
@dataclass(frozen=True, eq=False)
class Heights:
    """A ray depth from heights: where the view ray first meets them, found by a march.

    Attributes:
        heights: (h, w), units of `scale`; bilinear between texel centres.
        scale: tile widths a unit.
        curved: whether curvature bends the ray, which may then pass the heights: opacity 0.
        opacity: (h, w) 0 to 1 of curved heights, bilinear; None where nothing is seen through.
            Where it is below 1/2 there is nothing at any height. The lowest height is then the
            underside of the sheet: a ray that gets below it has passed.
        looks: at most along a ray that may pass.
    """

    heights: Floats
    scale: float
    curved: bool = False
    opacity: Floats | None = None
    looks: int = CURVED_LOOKS


@final
@dataclass(frozen=True, eq=False)
class DepthNetwork:
    """A ray depth from a texture and a network.

    Attributes:
        texture: its one level is looked up at uv.
        inputs: names of what the first layer takes. layers: to one number.
        scale: tile widths a unit of that number.
    """

    texture: Texture
    inputs: tuple[str, ...]
    layers: tuple[Dense, ...]
    scale: float


@final
@dataclass(frozen=True, eq=False)
class OffsetNetwork:
    """How far textures with a `view` part are looked up from uv: two numbers of a network.

    Attributes:
        texture: its one level is looked up at uv.
        inputs: names of what the first layer takes. layers: to (du, dv), tiles.
    """

    texture: Texture
    inputs: tuple[str, ...]
    layers: tuple[Dense, ...]


@final
@dataclass(frozen=True, eq=False)
class Cover:
    """Opacity from a texture and a network of its own.

    Attributes:
        kind: "direct" the sigmoid of its number; "cosine" 1 where the view's cosine is no lower
            than the number, and else 0.
        texture: its one level is looked up at uv.
        inputs: names of what the first layer takes. layers: to one number.
    """

    kind: Literal["direct", "cosine"]
    texture: Texture
    inputs: tuple[str, ...]
    layers: tuple[Dense, ...]


@final
@dataclass(frozen=True)
class Head:
    """Some of the last layer's numbers.

    Attributes:
        kind: "log" log(1 + value) of each channel; "mask" whose 0.1 + sigmoid multiplies it;
            "opacity" whose sigmoid is the opacity; "linear" the values themselves.
        count: how many.
    """

    kind: HeadKind
    count: int


@final
@dataclass(frozen=True, eq=False)
class Program:
    """The evaluation of a material.

    Attributes:
        channels: one name a channel of the reflectance.
        grid: (h, w) of the data's grid, in which footprints count.
        aspect: tile width / tile height.
        wrap: whether textures tile, or clamp at their borders.
        textures: whose features are inputs.
        inputs: names of what the first layer takes.
        layers: dense layers; none where the inputs are the answer.
        heads: what the last numbers are, in order.
        output: "log" exp - 1 of the log head, cut to 0..MOST_LOG first; "relu" the same, negative
            numbers being cut already in training; "released" YUV to RGB first, as the published
            program of NeuMIP has it; "cosine" the linear head times the light's cosine; "linear" it
            with negative numbers cut.
        depth: what moves lookups; None where nothing does.
        cover: what says where view rays pass; None where the march, or a head, says it.
        frames: vectors among the first texture's features.
        scaling: texture of (mean, deviation) that the log head is scaled by; None without.
        leveled: whether footprints count; where they do not, each query is one of 0.5.
        rounded: whether layers but the first multiply numbers rounded to bfloat16.
        full_sphere: whether lights below the horizon may have an answer other than 0: those above
            it where the ray meets curved heights have.

    Raises:
        ValueError: parts that do not fit each other, by name.
    """

    channels: tuple[str, ...]
    grid: tuple[int, int]
    aspect: float
    wrap: bool
    textures: tuple[Texture, ...]
    inputs: tuple[str, ...]
    layers: tuple[Dense, ...]
    heads: tuple[Head, ...]
    output: Output
    depth: Heights | DepthNetwork | OffsetNetwork | None = None
    cover: Cover | None = None
    frames: int = 0
    scaling: Texture | None = None
    leveled: bool = True
    rounded: bool = False
    full_sphere: bool = False

    def __post_init__(self) -> None:
        known = {*INPUTS, *self.features}
        if unknown := [name for name in self.inputs if name not in known]:
            raise ValueError(f"no input {unknown[0]!r}; there are {', '.join(sorted(known))}")
        width = len(self.inputs)
        for k, layer in enumerate(self.layers):
            if layer.weight.shape[1] != width or layer.bias.shape != layer.weight.shape[:1]:
                raise ValueError(
                    f"layer {k} has weights {layer.weight.shape} and biases {layer.bias.shape} "
                    f"for {width} inputs"
                )
            width = layer.weight.shape[0]
        if sum(head.count for head in self.heads) != width:
            raise ValueError(f"heads {self.heads} for {width} numbers")

    @property
    def features(self) -> tuple[str, ...]:
        """Names of all textures' features, then of the frames' products."""
        named = [name for texture in self.textures for name in texture.features]
        return (*named, *frame_products(self.frames))

    @property
    def opacity(self) -> Literal["none", "march", "head", "network"]:
        """Where opacity comes from: nowhere (it is 1), rays that miss, a layer, a network."""
        if self.cover is not None:
            return "network"
        if any(head.kind == "opacity" for head in self.heads):
            return "head"
        return "march" if self.curved else "none"

    @property
    def networks(self) -> tuple[Cover | DepthNetwork | OffsetNetwork, ...]:
        """Networks with a texture of their own, in the order in which they are asked."""
        kinds = (Cover, DepthNetwork, OffsetNetwork)
        return tuple(part for part in (self.cover, self.depth) if isinstance(part, kinds))

    @property
    def every_layer(self) -> tuple[Dense, ...]:
        """The layers, and those of all networks."""
        return (*self.layers, *(layer for part in self.networks for layer in part.layers))

    @property
    def every_input(self) -> frozenset[str]:
        """Names of what any first layer takes."""
        return frozenset((*self.inputs, *(name for part in self.networks for name in part.inputs)))

    @property
    def curved(self) -> bool:
        """Whether curvature bends rays on their way through heights."""
        return isinstance(self.depth, Heights) and self.depth.curved

    @property
    def bends(self) -> bool:
        """Whether answers depend on curvature."""
        return self.curved or "curvature" in self.every_input

    def described(self) -> dict[str, Any]:
        """The program in JSON types, arrays by their shapes."""
        return _described(self)

    def in_dtype(self, dtype: Any) -> Program:
        """The same program with arrays of another type."""
        return _converted(self, np.dtype(dtype))


def frame_products(frames: int) -> tuple[str, ...]:
    """Names of the products of each frame vector with the half vector and with the light."""
    return tuple(f"frame.{k}.{with_}" for k in range(frames) for with_ in ("half", "light"))


def _described(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return {"shape": list(value.shape), "dtype": str(value.dtype)}
    if hasattr(value, "__dataclass_fields__"):
        return {name: _described(getattr(value, name)) for name in value.__dataclass_fields__}
    if isinstance(value, (list, tuple)):
        return [_described(item) for item in value]
    return value


def _converted(value: Any, dtype: np.dtype[Any]) -> Any:
    if isinstance(value, np.ndarray):
        return value.astype(dtype)
    if isinstance(value, tuple):
        return tuple(_converted(item, dtype) for item in value)
    if hasattr(value, "__dataclass_fields__"):
        fields = {n: _converted(getattr(value, n), dtype) for n in value.__dataclass_fields__}
        return replace(value, **fields)
    return value
