"""NeuMIP's kernels: a model's layout, its evaluation in numpy, and the compiled form of both.

A model is two flat float32 arrays. `weights` holds the networks, layer by layer: (out, in)
row-major, then the (out,) biases; the offset network first. `texels` (t, 8) holds all textures
one after the other, row-major; a texture uses the first of the eight numbers of a texel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, final

import numpy as np
from numpy.typing import NDArray

from btfkit import native

Array = NDArray[np.float32]
Activation = Literal["linear", "relu", "leaky", "sine"]
Output = Literal["log", "relu", "mask"]
Loss = Literal["square", "absolute"]

CHANNELS = 8  # numbers a texel
LEAK = 0.01
ACTIVATIONS: tuple[Activation, ...] = ("linear", "relu", "leaky", "sine")
OUTPUTS: tuple[Output, ...] = ("log", "relu", "mask")
DIRECTIONS = ("lx", "ly", "lz", "vx", "vy", "vz", "hx", "hy", "hz", "cos_diff", "level")


@final
@dataclass(frozen=True)
class Pyramid:
    """Textures of one kind, finest first, read together by level.

    Attributes:
        sizes: (h, w) of each level.
        channels: numbers used of a texel, 1 to 8.
        view, light: the lookup lies at uv + depth * (view * H(view) - light * H(light)).
        shift: level of the data, log2(2 * footprint), at which the finest texture is right.
    """

    sizes: tuple[tuple[int, int], ...]
    channels: int
    view: float = 1.0
    light: float = 0.0
    shift: float = 0.0

    @property
    def texels(self) -> int:
        return sum(h * w for h, w in self.sizes)


@final
@dataclass(frozen=True)
class Network:
    """A small dense network.

    Attributes:
        widths: inputs (features, then directions), hidden layers, outputs.
        directions: which of `DIRECTIONS` follow the features.
        activation: after every layer but the last.
    """

    widths: tuple[int, ...]
    directions: tuple[str, ...]
    activation: Activation = "relu"

    @property
    def size(self) -> int:
        return sum((a + 1) * b for a, b in zip(self.widths, self.widths[1:], strict=False))

    def layers(self, flat: NDArray[Any]) -> list[tuple[NDArray[Any], NDArray[Any]]]:
        """(out, in) matrix and (out,) bias of each layer, as views of its flat weights."""
        found, at = [], 0
        for a, b in zip(self.widths, self.widths[1:], strict=False):
            matrix = flat[at : at + a * b].reshape(b, a)
            at += (a + 1) * b
            found.append((matrix, flat[at - b : at]))
        return found


@final
@dataclass(frozen=True)
class Layout:
    """All that decides a model's shape and how it is read.

    Attributes:
        decoder: features and directions to log(1 + rgb).
        banks: pyramids whose features, one after the other, the decoder takes.
        offset: the texture and network of the ray depth; None without an offset stage.
        channels: of the answer. output: "log" as it comes, "relu" with negative numbers cut,
            "mask" with the first half times 0.1 + sigmoid(second half).
        aspect: tile width / tile height. depth_scale: tile widths a unit of the network.
        wrap: whether textures tile, or clamp at their borders.
    """

    decoder: Network
    banks: tuple[Pyramid, ...]
    offset: tuple[Pyramid, Network] | None = None
    channels: int = 3
    output: Output = "log"
    aspect: float = 1.0
    depth_scale: float = 1.0
    wrap: bool = True

    @property
    def pyramids(self) -> tuple[Pyramid, ...]:
        return ((self.offset[0],) if self.offset else ()) + self.banks

    @property
    def weights(self) -> int:
        return (self.offset[1].size if self.offset else 0) + self.decoder.size

    @property
    def texels(self) -> int:
        return sum(pyramid.texels for pyramid in self.pyramids)

    @property
    def needs_light(self) -> bool:
        return any(bank.light for bank in self.banks)

    def split(self, weights: Any) -> tuple[Any, Any]:
        """The flat weights of the offset network (empty without one) and of the decoder."""
        cut = self.offset[1].size if self.offset else 0
        return weights[:cut], weights[cut:]

    def textures(self, texels: Any) -> list[list[Any]]:
        """(h, w, 8) views of each pyramid's levels; the offset texture first."""
        found, at = [], 0
        for pyramid in self.pyramids:
            levels = []
            for h, w in pyramid.sizes:
                levels.append(texels[at : at + h * w].reshape(h, w, CHANNELS))
                at += h * w
            found.append(levels)
        return found


# ---------------------------------------------------------------- the twin


def evaluate_plain(
    layout: Layout,
    weights: NDArray[Any],
    texels: NDArray[Any],
    uv: NDArray[Any],
    light: NDArray[Any],
    view: NDArray[Any],
    footprint: NDArray[Any] | None = None,
    *,
    raw: bool = False,
) -> NDArray[Any]:
    """Reflectance (b, c) for flat queries; `raw` gives the decoder's numbers instead.

    Args:
        layout: the model. weights: (layout.weights,). texels: (layout.texels, 8).
        uv: (b, 2). light, view: (b, 3) unit vectors.
        footprint: (b,) texels of the data's grid; None is 0.5 throughout.
    """
    known = _directions(light, view, footprint)
    depth = depths_plain(layout, weights, texels, uv, view)
    textures = layout.textures(texels)[1 if layout.offset else 0 :]
    parts = []
    for bank, levels in zip(layout.banks, textures, strict=True):
        moved = uv
        if layout.offset and (bank.view or bank.light):
            move = bank.view * step(view, layout) - bank.light * step(light, layout)
            moved = uv + depth[:, None] * move
        parts.append(_between_levels(bank, levels, moved, known["level"] * 8, wrap=layout.wrap))
    z = _run(layout.decoder, layout.split(weights)[1], parts, known)
    if raw:
        return z
    c = layout.channels
    y = z[:, :c]
    if layout.output == "mask":
        with np.errstate(over="ignore"):
            y = y * (0.1 + 1 / (1 + np.exp(-z[:, c:])))
    return np.expm1(np.clip(y, 0, 20))


def depths_plain(
    layout: Layout,
    weights: NDArray[Any],
    texels: NDArray[Any],
    uv: NDArray[Any],
    view: NDArray[Any],
) -> NDArray[Any]:
    """Ray depth (b,) of the offset stage, tile widths, positive above the plane of uv."""
    if layout.offset is None:
        return np.zeros(len(uv), texels.dtype)
    pyramid, network = layout.offset
    psi = _bilinear(layout.textures(texels)[0][0], uv, wrap=layout.wrap)[:, : pyramid.channels]
    known = _directions(view, view, None)
    return _run(network, layout.split(weights)[0], [psi], known)[:, 0] * layout.depth_scale


def step(direction: NDArray[Any], layout: Layout) -> NDArray[Any]:
    """Displacement (b, 2) in uv of one tile width of depth: H of the paper, v down the rows."""
    xy = direction[:, :2] / np.maximum(direction[:, 2:], 0.6)
    return xy * np.asarray([1.0, -layout.aspect], direction.dtype)


def _directions(
    light: NDArray[Any], view: NDArray[Any], footprint: NDArray[Any] | None
) -> dict[str, NDArray[Any]]:
    total = light + view
    length = np.linalg.norm(total, axis=1, keepdims=True)
    none = length < 1e-6
    half = np.where(none, [[0, 0, 1]], total / np.where(none, 1, length)).astype(light.dtype)
    cos_diff = np.where(none, 0, length / 2)[:, 0].astype(light.dtype)
    level = np.zeros(len(light), light.dtype)
    if footprint is not None:
        level = np.log2(2 * np.clip(footprint, 0.5, 1e30))
    columns = [*light.T, *view.T, *half.T, cos_diff, level / 8]
    return dict(zip(DIRECTIONS, columns, strict=True))


def _run(
    network: Network,
    flat: NDArray[Any],
    features: Sequence[NDArray[Any]],
    known: dict[str, NDArray[Any]],
) -> NDArray[Any]:
    x = np.concatenate([*features, *(known[d][:, None] for d in network.directions)], axis=1)
    layers = network.layers(flat)
    for matrix, bias in layers[:-1]:
        x = x @ matrix.T + bias
        if network.activation == "relu":
            x = np.maximum(x, 0)
        elif network.activation == "leaky":
            x = np.where(x > 0, x, x * np.asarray(LEAK, x.dtype))
        elif network.activation == "sine":
            x = np.sin(x)
    matrix, bias = layers[-1]
    return x @ matrix.T + bias


def _between_levels(
    bank: Pyramid, levels: list[NDArray[Any]], uv: NDArray[Any], level: NDArray[Any], *, wrap: bool
) -> NDArray[Any]:
    at = np.clip(level - bank.shift, 0, len(levels) - 1)
    found = np.zeros((len(uv), bank.channels), levels[0].dtype)
    for s, texture in enumerate(levels):
        # The paper's eq. 3 has both weights 0 at whole levels; these sum to 1.
        weight = np.maximum(0, 1 - np.abs(at - s))
        rows = np.flatnonzero(weight)
        value = _bilinear(texture, uv[rows], wrap=wrap)[:, : bank.channels]
        found[rows] += weight[rows, None] * value
    return found


def _bilinear(texture: NDArray[Any], uv: NDArray[Any], *, wrap: bool) -> NDArray[Any]:
    h, w, _ = texture.shape
    size = np.asarray([w, h], uv.dtype)
    if wrap:
        uv = uv - np.floor(uv)
    at = uv * size - np.asarray(0.5, uv.dtype)
    at = np.clip(at, -1, size)
    low = np.floor(at)
    fx, fy = (at - low).T[..., None]
    x0, y0 = low.astype(np.int64).T
    if wrap:
        x0, x1, y0, y1 = x0 % w, (x0 + 1) % w, y0 % h, (y0 + 1) % h
    else:
        x1, y1 = np.clip(x0 + 1, 0, w - 1), np.clip(y0 + 1, 0, h - 1)
        x0, y0 = np.clip(x0, 0, w - 1), np.clip(y0, 0, h - 1)
    upper = texture[y0, x0] * (1 - fx) + texture[y0, x1] * fx
    lower = texture[y1, x0] * (1 - fx) + texture[y1, x1] * fx
    return upper * (1 - fy) + lower * fy


# ---------------------------------------------------------------- the kernels


@final
class Kernel:
    """The compiled form of one layout: the same answers, and training.

    Gradients of `train` add up here, a buffer a thread, until `adam` uses and zeroes them.
    Equal threads and variant give equal results.

    Raises:
        RuntimeError: the extension was not built; see `available`.
    """

    def __init__(self, layout: Layout, *, variant: str = "", threads: int | None = None) -> None:
        module = native.load("neumip")
        if module is None:
            raise RuntimeError("the NeuMIP kernel was not built; use evaluate_plain")
        self._threads = native.threads() if threads is None else threads
        self._variant = variant
        textures: list[list[int]] = []
        banks: list[list[float]] = []
        at = 0
        for pyramid in layout.pyramids:
            first = len(textures)
            for h, w in pyramid.sizes:
                textures.append([h, w, at])
                at += h * w
            count = len(pyramid.sizes)
            moves = (pyramid.view, pyramid.light, pyramid.shift)
            banks.append([float(pyramid.channels), float(first), float(count), *moves])
        offset = layout.offset[1] if layout.offset else Network((1, 1), ())
        self._model = module.Model(
            layout.wrap,
            layout.aspect,
            layout.depth_scale,
            OUTPUTS.index(layout.output),
            layout.channels,
            textures,
            banks,
            layout.offset is not None,
            *_network(offset),
            *_network(layout.decoder),
        )
        self._layout = layout

    def evaluate(
        self,
        weights: Array,
        texels: Array,
        uv: Array,
        light: Array,
        view: Array,
        footprint: Array | None = None,
        *,
        raw: bool = False,
    ) -> Array:
        """As `evaluate_plain`; every array float32 and contiguous."""
        outputs = self._layout.decoder.widths[-1] if raw else self._layout.channels
        rgb = np.empty((len(uv), outputs), np.float32)
        common = (raw, self._threads, self._variant)
        self._model.evaluate(weights, texels, uv, light, view, footprint, rgb, False, *common)
        return rgb

    def evaluate_lights(
        self,
        weights: Array,
        texels: Array,
        uv: Array,
        lights: Array,
        view: Array,
        footprint: Array | None = None,
    ) -> Array:
        """(m, b, c) reflectance of b views under m lights (m, 3) that all of them share.

        What does not depend on the light is computed once a view.
        """
        rgb = np.empty((len(lights), len(uv), self._layout.channels), np.float32)
        common = (False, self._threads, self._variant)
        self._model.evaluate(weights, texels, uv, lights, view, footprint, rgb, True, *common)
        return rgb

    def depths(self, weights: Array, texels: Array, uv: Array, view: Array) -> Array:
        """As `depths_plain`."""
        out = np.empty(len(uv), np.float32)
        self._model.depths(weights, texels, uv, view, out, self._threads, self._variant)
        return out

    def train(
        self,
        weights: Array,
        texels: Array,
        uv: Array,
        light: Array,
        view: Array,
        footprint: Array | None,
        target: Array,
        weight: Array | None = None,
        *,
        loss: Loss = "square",
    ) -> tuple[float, int]:
        """Loss of one batch against log(1 + max(target, -0.1)); its gradients are added up here.

        Args:
            target: (b, c) reflectance; values that are not finite count nothing.
            weight: (b,) of each query, None for 1.

        Returns:
            The loss, a mean over b x c, and how many values counted.
        """
        kind = 0 if loss == "square" else 1
        common = (kind, self._threads, self._variant)
        return self._model.train(
            weights, texels, uv, light, view, footprint, target, weight, *common
        )

    def gradients(self) -> tuple[Array, Array]:
        """Gradients added up so far: (weights,) and (texels, 8)."""
        weights = np.empty(self._layout.weights, np.float32)
        texels = np.empty((self._layout.texels, CHANNELS), np.float32)
        self._model.gradients(weights, texels)
        return weights, texels

    def adam(
        self,
        weights: tuple[Array, Array, Array],
        texels: tuple[Array, Array, Array],
        *,
        lr: tuple[float, float],
        step: int,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
        dense: bool = True,
    ) -> None:
        """One step of Adam in place, with the gradients added up here, which are zeroed.

        Args:
            weights, texels: parameters, first and second moments.
            lr: of the weights and of the texels.
            step: counted from 1.
            dense: False moves only texels that the batch touched; the others keep their
                moments as they are.
        """
        rest = (*lr, *betas, eps, step, dense, self._threads, self._variant)
        self._model.adam(*weights, *texels, *rest)


@final
@dataclass(frozen=True, eq=False)
class Images:
    """Images to draw training texels from, all of one grid.

    Attributes:
        values: (k, h, w, c) float16 or float32: every `stride`-th row and column of each image,
            from its `phase` on.
        phase: (k, 2) int32 first row and column. stride: as said.
        light, view: (k, 3) unit vectors, or positions above the centre of the sample.
        grid: (rows, cols) of the whole image.
        texel_light, texel_view: edge of a texel in the unit of the positions; 0 for directions.
    """

    values: NDArray[np.float16] | NDArray[np.float32]
    phase: NDArray[np.int32]
    light: Array
    view: Array
    grid: tuple[int, int]
    stride: int = 1
    texel_light: float = 0.0
    texel_view: float = 0.0


@final
@dataclass(frozen=True, eq=False)
class Draw:
    """b drawn texels: uv (b, 2), light and view (b, 3), target (b, c), slots (b,) of the images."""

    uv: Array
    light: Array
    view: Array
    target: Array
    slots: NDArray[np.int32]

    @staticmethod
    def empty(count: int, channels: int) -> Draw:
        uv, light, view, target = (
            np.empty((count, size), np.float32) for size in (2, 3, 3, channels)
        )
        return Draw(uv, light, view, target, np.empty(count, np.int32))

    def part(self, start: int, stop: int) -> Draw:
        """Rows start..stop, as views."""
        rows = slice(start, stop)
        return Draw(
            self.uv[rows], self.light[rows], self.view[rows], self.target[rows], self.slots[rows]
        )


def draw(images: Images, seed: int, out: Draw) -> None:
    """Fill `out` with random texels of random images; `seed` (64 bits) decides them."""
    module = native.load("neumip")
    if module is None:
        draw_plain(images, seed, out)
        return
    half = images.values.dtype == np.float16
    values = images.values.view(np.uint16) if half else images.values
    (module.draw16 if half else module.draw32)(
        values, images.light, images.view, images.phase, images.stride, *images.grid,
        images.texel_light, images.texel_view, seed, out.uv, out.light, out.view, out.target,
        out.slots, native.threads(),
    )  # fmt: skip


def draw_plain(images: Images, seed: int, out: Draw) -> None:
    """The twin of `draw`: the same texels."""
    k, h, w, _ = images.values.shape
    count = np.uint64(len(out.uv))
    first = _scrambled(np.uint64(seed) + np.arange(count, dtype=np.uint64))
    upper = np.uint64(32)
    slot = (((first >> upper) * np.uint64(k)) >> upper).astype(np.int64)
    texel = (((_scrambled(first) >> upper) * np.uint64(h * w)) >> upper).astype(np.int64)
    at = np.stack([texel // w, texel % w], axis=1) * images.stride + images.phase[slot] + 0.5
    rows, cols = images.grid
    out.slots[:] = slot
    out.uv[:] = at[:, ::-1] / [cols, rows]
    out.target[:] = images.values.reshape(k, h * w, -1)[slot, texel]
    plane = np.stack([at[:, 1] - cols / 2, rows / 2 - at[:, 0], 0 * at[:, 0]], axis=1)
    for table, size, into in (
        (images.light, images.texel_light, out.light),
        (images.view, images.texel_view, out.view),
    ):
        ray = table[slot] - plane * size
        into[:] = ray if size == 0 else ray / np.linalg.norm(ray, axis=1, keepdims=True)


def _scrambled(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """splitmix64, Steele et al. 2014."""
    x = x + np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


def available() -> bool:
    """Whether the compiled kernel is there."""
    return native.load("neumip") is not None


def variants() -> list[str]:
    """Vector variants that this processor runs, best first; none without the extension."""
    module = native.load("neumip")
    return [] if module is None else module.variants()


def peak(seconds: float = 0.2, variant: str = "") -> float:
    """Measured float32 operations a CPU second of one thread: multiply-adds from registers."""
    module = native.load("neumip")
    if module is None:
        raise RuntimeError("the NeuMIP kernel was not built")
    return module.peak(seconds, variant)


def _network(network: Network) -> tuple[list[int], list[int], int]:
    directions = [DIRECTIONS.index(name) for name in network.directions]
    return list(network.widths), directions, ACTIVATIONS.index(network.activation)
