"""NeuBTF as published: a neural texture and a small sinusoidal renderer, in numpy.

Source: Rodriguez-Pardo et al., "NeuBTF: Neural fields for BTF encoding and transfer",
Computers & Graphics 114, 2023.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, final

import numpy as np
from numpy.typing import NDArray

from btfkit.conventions import EPSILON, LOWEST_COSINE, MOST_LOG, displacement
from btfkit.materials.base import Array, Header, Material
from btfkit.native.neural.plain import on_disc
from btfkit.program import Dense, DepthNetwork, Head, Program, Texture
from btfkit.queries import Query

LATENTS, WIDTH, HIDDEN = 14, 32, 3
# Samples rendered at once: 32 channels of them stay in a core's second-level cache.
_BLOCK = 1 << 13


@final
@dataclass(frozen=True)
class NeuBTFSpec:
    """All that decides the shapes of a NeuBTF, and the constant in its sines.

    Attributes:
        size: (h, w) of the neural texture.
        channels: of the answer.
        latents: channels of the neural texture.
        width: of the renderer's three hidden layers.
        omega: factor on the normalised pre-activation, inside the sine.
        parallax: whether the first lookup moves the second along the view.
    """

    size: tuple[int, int]
    channels: int = 3
    latents: int = LATENTS
    width: int = WIDTH
    omega: float = 2.5
    parallax: bool = False


def renderer_shapes(spec: NeuBTFSpec) -> dict[str, tuple[int, ...]]:
    """Shapes of the renderer's weights: inputs are latents, light and view on the disc."""
    shapes: dict[str, tuple[int, ...]] = {}
    before = spec.latents + 4
    for layer in range(HIDDEN):
        shapes[f"renderer.{layer}.weight"] = (spec.width, before)
        shapes[f"renderer.{layer}.bias"] = (spec.width,)
        shapes[f"renderer.{layer}.norm.weight"] = (spec.width,)
        shapes[f"renderer.{layer}.norm.bias"] = (spec.width,)
        before = spec.width
    shapes["renderer.out.weight"] = (spec.channels, spec.width)
    shapes["renderer.out.bias"] = (spec.channels,)
    return shapes


def parallax_shapes(spec: NeuBTFSpec) -> dict[str, tuple[int, ...]]:
    """Shapes of the optional head that turns latents into a height along the view ray."""
    if not spec.parallax:
        return {}
    return {
        "parallax.0.weight": (16, spec.latents + 2),
        "parallax.0.bias": (16,),
        "parallax.1.weight": (1, 16),
        "parallax.1.bias": (1,),
    }


@final
class NeuBTFPaper(Material):
    """R(T(u, v), view, light): one texture lookup and 3011 weights for three channels."""

    model: ClassVar[str] = "neubtf-paper"
    spec_type: ClassVar[type] = NeuBTFSpec

    def __init__(
        self, spec: NeuBTFSpec, weights: Mapping[str, NDArray[np.floating]], header: Header
    ) -> None:
        super().__init__(spec, weights, header)
        h, w = spec.size
        self._texture = np.asarray(self.weights["texture"], np.float32).reshape(h * w, -1)
        self._layers = {
            name: np.ascontiguousarray(value.astype(np.float32).T)
            for name, value in self.weights.items()
            if name != "texture"
        }

    @classmethod
    def shapes(cls, spec: NeuBTFSpec, header: Header) -> dict[str, tuple[int, ...]]:
        return {
            "texture": (*spec.size, spec.latents),
            **renderer_shapes(spec),
            **parallax_shapes(spec),
        }

    def _answer(self, query: Query) -> tuple[Array, Array | None]:
        out = np.empty((len(query.uv), self.spec.channels), np.float32)
        for start in range(0, len(out), _BLOCK):
            block = Query(*(part[start : start + _BLOCK] for part in query))
            out[start : start + _BLOCK] = self._render(block)
        return out, None

    def _render(self, query: Query) -> Array:
        uv = query.uv
        if self.spec.parallax:
            uv = self._shifted(uv, query.view)
        x = np.concatenate([self._lookup(uv), on_disc(query.light), on_disc(query.view)], axis=1)
        for layer in range(HIDDEN):
            z = self._normalised(layer, self._linear(f"renderer.{layer}", x))
            activation = np.sin(np.float32(self.spec.omega) * z)
            x = activation if layer == 0 else x + activation
        logs = np.minimum(self._linear("renderer.out", x), np.float32(MOST_LOG))
        return np.maximum(np.expm1(logs), np.float32(0))

    def _shifted(self, uv: Array, view: Array) -> Array:
        """uv where the view ray meets the structure, by the predicted height along it."""
        inputs = np.concatenate([self._lookup(uv), view[:, :2]], axis=1)
        hidden = np.maximum(self._linear("parallax.0", inputs), 0)
        height = self._linear("parallax.1", hidden)
        cosine = np.maximum(view[:, 2], np.float32(LOWEST_COSINE))
        du, dv = displacement(
            height[:, 0] * view[:, 0], height[:, 0] * view[:, 1], cosine, self.header.aspect
        )
        moved = (uv + np.stack([du, dv], axis=1)).astype(np.float32, copy=False)
        if self.header.wrap == "wrap":
            return moved - np.floor(moved)
        return np.clip(moved, 0, 1)

    def program(self) -> Program:
        texture = self._layered("renderer", HIDDEN)
        codes = Texture("latents", (self._texture.reshape(*self.spec.size, -1),), view=1.0)
        depth = None
        if self.spec.parallax:
            flat = Texture("depth", codes.levels)
            first, last = (
                (self._layers[f"parallax.{k}.weight"].T, self._layers[f"parallax.{k}.bias"])
                for k in range(2)
            )
            layers = (Dense(*first, "relu"), Dense(*last, "linear"))
            depth = DepthNetwork(flat, (*flat.features, "vx", "vy"), layers, 1.0)
        return Program(
            channels=self.header.channels,
            grid=self.header.grid,
            aspect=self.header.aspect,
            wrap=self.header.wrap == "wrap",
            textures=(codes,),
            inputs=(*codes.features, "lx_disc", "ly_disc", "vx_disc", "vy_disc"),
            layers=texture,
            heads=(Head("log", self.spec.channels),),
            output="log",
            leveled=False,
            depth=depth,
        )

    def _layered(self, name: str, hidden: int) -> tuple[Dense, ...]:
        found = []
        for k in range(hidden):
            parts = [self._layers[f"{name}.{k}.{part}"] for part in ("weight", "bias")]
            found.append(
                Dense(
                    parts[0].T,
                    parts[1],
                    "sine",
                    omega=self.spec.omega,
                    gain=self._layers[f"{name}.{k}.norm.weight"],
                    centre=self._layers[f"{name}.{k}.norm.bias"],
                    residual=k > 0,
                )
            )
        last = (self._layers[f"{name}.out.weight"].T, self._layers[f"{name}.out.bias"])
        return (*found, Dense(*last, "linear"))

    def _linear(self, name: str, x: Array) -> Array:
        return x @ self._layers[f"{name}.weight"] + self._layers[f"{name}.bias"]

    def _normalised(self, layer: int, z: Array) -> Array:
        z = z - z.mean(axis=1, keepdims=True)
        z /= np.sqrt(np.square(z).mean(axis=1, keepdims=True) + np.float32(EPSILON))
        name = f"renderer.{layer}.norm"
        return z * self._layers[f"{name}.weight"] + self._layers[f"{name}.bias"]

    def _lookup(self, uv: Array) -> Array:
        """(b, latents) bilinear between texel centres, wrapped or clamped."""
        h, w = self.spec.size
        wrap = self.header.wrap == "wrap"
        (col0, col1, across), (row0, row1, down) = (
            _neighbours(uv[:, axis], size, wrap) for axis, size in ((0, w), (1, h))
        )
        top = _mix(self._texture[row0 * w + col0], self._texture[row0 * w + col1], across)
        bottom = _mix(self._texture[row1 * w + col0], self._texture[row1 * w + col1], across)
        return _mix(top, bottom, down)


def _mix(first: Array, second: Array, weight: Array) -> Array:
    return first + (second - first) * weight[:, None]


def _neighbours(
    position: Array, size: int, wrap: bool
) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """The two texels beside a position in 0..1 on one axis, and the share of the second."""
    at = position.astype(np.float64) * size - 0.5
    floor = np.floor(at)
    share = (at - floor).astype(np.float32)
    first = floor.astype(np.intp)
    second = first + 1
    if wrap:
        return first % size, second % size, share
    return np.clip(first, 0, size - 1), np.clip(second, 0, size - 1), share
