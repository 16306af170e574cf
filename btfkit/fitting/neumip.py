"""NeuMIP while it is fitted: ours through the kernels, and the published recipe in plain torch.

Source: Kuznetsov et al., "NeuMIP: Multi-Resolution Neural Materials", ACM TOG 40(4), 2021,
sections 3 and 4. What we changed and what it bought: docs/neumip.md.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from btfkit.btf import BTF, Wrap
from btfkit.errors import FitError
from btfkit.fitting import neumip_torch
from btfkit.fitting.loop import Generators, Trainable
from btfkit.fitting.neumip_data import Batch, RowSource, Source, TexelSource, gaussian
from btfkit.fitting.neumip_settings import INPUTS, Settings
from btfkit.fitting.settings import parsed
from btfkit.materials import neumip as evaluated
from btfkit.materials.base import Header, Material
from btfkit.materials.neumip import NeuMIPSpec, aligned, most_levels
from btfkit.native.neumip import Array, Kernel, Layout, Network, available
from btfkit.queries import QuerySet

# Direction pairs for which a decay of 1 is right; docs/neumip.md has the measurements.
_DECAY_PAIRS = 60


class _Trainable(Trainable, ABC):
    """What both recipes share: data, flat parameters, state, score."""

    material_type: ClassVar[type[Material]]

    def __init__(
        self,
        source: BTF | QuerySet,
        train: NDArray[np.intp],
        test: NDArray[np.intp],
        *,
        settings: Mapping[str, str],
        generators: Generators,
        progress: Any = None,
    ) -> None:
        self.settings = s = parsed(Settings, self.model, settings)
        self._generators = generators
        self._header = _header(source, s)
        size = _texture_size(self._header.grid, s.size)
        levels = s.levels or _levels_for(source, size)
        self.spec = self._spec(size, min(levels, most_levels(size)))
        self.layout = self.spec.layout(self._header)
        self._source: Source
        if isinstance(source, BTF):
            self._source = TexelSource(
                source, train, test, levels=self._data_levels(), seed=generators.seed,
                pool_bytes=s.pool_mb << 20, progress=progress,
            )  # fmt: skip
        else:
            self._source = RowSource(source, train, test, seed=generators.seed)
        self.masked = self._source.masked
        self._held = self._source.held_out()
        self._decay = s.decay * min(1.0, _DECAY_PAIRS / max(len(train), 1))
        self._steps, self._rate = 0, 1.0
        self._arrays = self._initial(generators.numpy)

    def _data_levels(self) -> int:
        """Levels of the data's own grid that the model's pyramid reaches to."""
        if self.spec.levels == 1:
            return 1
        finest = math.ceil(self.layout.banks[0].shift)
        return min(self.spec.levels + finest, most_levels(self._header.grid))

    @abstractmethod
    def _spec(self, size: tuple[int, int], levels: int) -> NeuMIPSpec:
        """The model's shapes for a finest texture of `size`."""

    @abstractmethod
    def _initial(self, rng: np.random.Generator) -> dict[str, Array]:
        """Weights, texels and their moments before the first step."""

    @abstractmethod
    def _current(self) -> tuple[Array, Array]:
        """Weights and texels as the model would be saved now."""

    def material(self) -> Material:
        arrays = evaluated.name_arrays(self.spec, self.layout, *self._current())
        return self.material_type(self.spec, arrays, self._header)

    def score(self) -> float:
        held = self._held
        good = np.isfinite(held.target)
        if not good.any():
            return math.nan
        material = evaluated.NeuMIP(
            self.spec,
            evaluated.name_arrays(self.spec, self.layout, *self._current()),
            self._header,
        )
        blur = 0.5 if held.footprint is None else held.footprint
        answer = material.evaluate(held.uv, held.light, held.view, blur).reflectance
        with np.errstate(invalid="ignore"):
            error = np.log1p(np.maximum(held.target, -0.1)) - np.log1p(answer)
        return float(np.square(error[good]).mean())

    def state(self) -> dict[str, Tensor]:
        found = {name: torch.from_numpy(array.copy()) for name, array in self._arrays.items()}
        numbers = [self._steps, self._rate, self.queries]
        return found | {"numbers": torch.tensor(numbers, dtype=torch.float64)}

    def restore(self, state: Mapping[str, Tensor]) -> None:
        for name, array in self._arrays.items():
            array[...] = state[name].numpy()
        steps, self._rate, queries = state["numbers"].tolist()
        self._steps, self.queries = int(steps), int(queries)

    def slow_down(self) -> None:
        self._rate *= 0.5


@final
class NeuMIP(_Trainable):
    """NeuMIP through the kernels, or through torch where they were not built."""

    model: ClassVar[str] = "neumip"
    material_type: ClassVar[type[Material]] = evaluated.NeuMIP

    def _spec(self, size: tuple[int, int], levels: int) -> NeuMIPSpec:
        s = self.settings
        return NeuMIPSpec(
            size,
            levels,
            features=s.features,
            coarse=s.coarse,
            light=s.light if s.offset else 0,
            offset=s.offset,
            hidden=(s.width,) * 3,
            offset_hidden=(s.offset_width,) * 3,
            activation=s.activation,  # type: ignore[arg-type]
            offset_activation=s.offset_activation,  # type: ignore[arg-type]
            directions=INPUTS[s.inputs],
            output=s.output,  # type: ignore[arg-type]
            channels=len(self._header.channels),
            precision=s.precision,  # type: ignore[arg-type]
        )

    def _initial(self, rng: np.random.Generator) -> dict[str, Array]:
        layout = self.layout
        offset, decoder = layout.split(np.zeros(layout.weights, np.float32))
        if layout.offset:
            initial_weights(layout.offset[1], offset, rng, self.settings.omega)
        initial_weights(layout.decoder, decoder, rng, self.settings.omega)
        flat = np.concatenate([offset, decoder])
        texels = initial_texels(layout, rng)
        found = {"weights": flat, "texels": texels}
        for name in ("weights", "texels"):
            for moment in ("first", "second"):
                room = aligned(layout.texels) if name == "texels" else np.zeros_like(flat)
                found[f"{name}.{moment}"] = room
        self._kernel = Kernel(layout) if available() else None
        return found

    def _current(self) -> tuple[Array, Array]:
        return self._arrays["weights"], self._arrays["texels"]

    def step(self, progress: float) -> float:
        s, arrays = self.settings, self._arrays
        batch = self._source.batch(self._steps, self._batch_size(progress))
        self._steps += 1
        self.queries += len(batch)
        gradient = self._kernel_gradient if self._kernel else self._torch_gradient
        loss = gradient(batch)
        factor = self._rate * min(1.0, (progress + 1e-3) / 0.02)
        factor *= 0.005 + 0.995 * (0.5 + 0.5 * math.cos(math.pi * progress))
        rates = (s.rate * factor, s.texture_rate * factor)
        # A batch that touches few texels leaves the others, moments and all, as they are.
        dense = 6 * len(batch) > self.layout.texels
        parameters = [
            (arrays[n], arrays[f"{n}.first"], arrays[f"{n}.second"]) for n in ("weights", "texels")
        ]
        if self._kernel:
            self._kernel.adam(
                parameters[0], parameters[1], lr=rates, step=self._steps,
                betas=(0.9, s.beta2), dense=dense,
            )  # fmt: skip
        else:
            for slots, rate, grown in zip(parameters, rates, self._gradients, strict=True):
                adam_plain(slots, grown, rate, self._steps, (0.9, s.beta2), dense=dense)
        # Few directions say little about those between: small weights bend little.
        arrays["weights"] *= np.float32(1 - rates[0] * self._decay)
        if s.smooth and self._steps % 16 == 0:
            self._smooth(s.smooth * 2 ** (-9 * progress))
        # A depth that is no number is looked up at a border, with a finite loss: look at weights.
        return loss if np.isfinite(arrays["weights"]).all() else math.nan

    def _batch_size(self, progress: float) -> int:
        if self.settings.batch:
            return self.settings.batch
        h, w = self.spec.size
        # 2^13 at 128 x 128, 2^16 at 512 x 512; larger towards the end, where noise costs most.
        size = 2**13 * (h * w / 2**14) ** 0.75
        return int(np.clip(2 ** round(math.log2(size)), 2**10, 2**17)) << int(progress > 0.7)

    def _kernel_gradient(self, batch: Batch) -> float:
        assert self._kernel is not None
        loss, _ = self._kernel.train(
            *self._current(), batch.uv, batch.light, batch.view, batch.footprint,
            batch.target, batch.weight, loss=self.settings.loss,  # type: ignore[arg-type]
        )  # fmt: skip
        return loss

    def bare_gradient(self, count: int) -> Callable[[], object]:
        """A call that takes the gradient of one and the same batch again: the kernel alone."""
        batch = self._source.batch(0, count)
        return lambda: self._kernel_gradient(batch)

    def _torch_gradient(self, batch: Batch) -> float:
        weights, texels = (torch.from_numpy(a).requires_grad_() for a in self._current())
        loss = torch_loss(self.layout, weights, texels, batch, self.settings.loss)
        found = torch.autograd.grad(loss, (weights, texels))
        self._gradients = tuple(part.numpy() for part in found)
        return float(loss.detach())

    def _smooth(self, sigma: float) -> None:
        if sigma < 0.03:
            return
        wrap = self.layout.wrap
        for levels in self.layout.textures(self._arrays["texels"]):
            for texture in levels[:1]:
                h, w, _ = texture.shape
                for axis, side in ((0, h), (1, w)):
                    share = np.float32(min(sigma**2 / 2, 0.25))
                    if side > 1:
                        texture += share * _laplacian(texture, axis, wrap=wrap)


@final
class NeuMIPPaper(_Trainable):
    """The published recipe: Adam at a constant rate, blurred textures, batches of 4 a texel."""

    model: ClassVar[str] = "neumip-paper"
    material_type: ClassVar[type[Material]] = evaluated.NeuMIPPaper

    def _spec(self, size: tuple[int, int], levels: int) -> NeuMIPSpec:
        c = len(self._header.channels)
        released = self.settings.outputs == 6
        if released and c != 3:
            raise FitError(f"the published program answers 3 channels; the data have {c}")
        return NeuMIPSpec(
            size,
            levels,
            offset=self.settings.offset,
            output="released" if released else "relu",
            channels=c,
            precision=self.settings.precision,  # type: ignore[arg-type]
        )

    def _initial(self, rng: np.random.Generator) -> dict[str, Array]:
        layout = self.layout
        parts = []
        for network in ([layout.offset[1]] if layout.offset else []) + [layout.decoder]:
            flat = np.zeros(network.size, np.float32)
            for matrix, bias in network.layers(flat):
                # The default of torch.nn.Linear, which the published program relies on.
                reach = 1 / math.sqrt(matrix.shape[1])
                matrix[:] = rng.uniform(-reach, reach, matrix.shape)
                bias[:] = rng.uniform(-reach, reach, bias.shape)
            parts.append(flat)
        # A last layer that begins below zero everywhere would never learn.
        if layout.output == "relu":
            parts[-1][-layout.channels :] = np.abs(parts[-1][-layout.channels :]) + 0.1
        found = {"weights": np.concatenate(parts), "texels": initial_texels(layout, rng)}
        for name, array in list(found.items()):
            found |= {f"{name}.first": np.zeros_like(array), f"{name}.second": np.zeros_like(array)}
        self._progress = np.zeros(1, np.float32)
        return found | {"progress": self._progress}

    def step(self, progress: float) -> float:
        h, w = self.spec.size
        batch = self._source.batch(self._steps, self.settings.batch or 4 * h * w)
        self._steps += 1
        self.queries += len(batch)
        self._progress[0] = progress
        weights, texels = (
            torch.from_numpy(self._arrays[name]).requires_grad_() for name in ("weights", "texels")
        )
        loss = self._loss(weights, self._blurred(texels), batch)
        found = torch.autograd.grad(loss, (weights, texels))
        for name, gradient in zip(("weights", "texels"), found, strict=True):
            a = self._arrays
            slots = (a[name], a[f"{name}.first"], a[f"{name}.second"])
            adam_plain(slots, gradient.numpy(), 1e-3 * self._rate, self._steps, (0.9, 0.999))
        return float(loss.detach())

    def _loss(self, weights: Tensor, texels: Tensor, batch: Batch) -> Tensor:
        if self.spec.output != "released":
            return torch_loss(self.layout, weights, texels, batch, "square")
        raw = neumip_torch.forward(self.layout, weights, texels, *_tensors(batch))
        mixed = torch.tensor(evaluated.YUV_TO_RGB, dtype=raw.dtype)
        rgb = torch.expm1((raw[:, :3] @ mixed.T).clamp(max=20))
        rgb = rgb * (0.1 + torch.sigmoid(raw[:, 3:]))
        target = torch.from_numpy(batch.target)
        log = torch.log1p(rgb.clamp(min=-0.1))
        square = neumip_torch.loss_of(self.layout, log, target, None, "square")
        good = torch.isfinite(target)
        linear = torch.where(good, (rgb - torch.where(good, target, 0.0)).abs(), 0.0).mean()
        return square + 0.1 * linear

    def _blurred(self, texels: Tensor) -> Tensor:
        """Textures blurred by 8 texels (of the finest) at first, halved nine times in a run."""
        sigma = 8 * 2 ** (-9 * float(self._progress[0]))
        if sigma < 0.1:
            return texels
        parts = []
        for levels in self.layout.textures(texels):
            for s, texture in enumerate(levels):
                h, w, _ = texture.shape
                down, across = (
                    torch.from_numpy(gaussian(side, (sigma / 2**s) ** 2, wrap=self.layout.wrap))
                    for side in (h, w)
                )
                part = (down @ texture.reshape(h, -1)).reshape(h, w, -1)
                parts.append((across @ part).reshape(h * w, -1))
        return torch.cat(parts)

    def _current(self) -> tuple[Array, Array]:
        with torch.no_grad():
            texels = self._blurred(torch.from_numpy(self._arrays["texels"]))
        return self._arrays["weights"], texels.numpy()


def torch_loss(layout: Layout, weights: Tensor, texels: Tensor, batch: Batch, kind: str) -> Tensor:
    """The loss of a batch in plain torch, differentiable."""
    raw = neumip_torch.forward(layout, weights, texels, *_tensors(batch))
    answer = neumip_torch.log_answer(layout, raw)
    weight = None if batch.weight is None else torch.from_numpy(batch.weight)
    return neumip_torch.loss_of(layout, answer, torch.from_numpy(batch.target), weight, kind)


def adam_plain(
    slots: tuple[Array, Array, Array],
    gradient: Array,
    rate: float,
    step: int,
    betas: tuple[float, float],
    *,
    dense: bool = True,
) -> None:
    """The twin of the kernels' Adam, in place: parameters and both moments.

    `dense` False leaves out pairs of texels, (t, 8), without any gradient.
    """
    parameter, first, second = slots
    rows: Any = slice(None)
    if not dense and parameter.ndim == 2:
        some: NDArray[np.bool_] = np.any(gradient != 0, axis=1)
        pairs = np.zeros((len(some) + 1) // 2, bool)
        np.logical_or.at(pairs, np.flatnonzero(some) // 2, True)
        rows = np.repeat(pairs, 2)[: len(some)]
    g = gradient[rows]
    first[rows] = m = betas[0] * first[rows] + np.float32(1 - betas[0]) * g
    second[rows] = v = betas[1] * second[rows] + np.float32(1 - betas[1]) * g * g
    m, v = m / (1 - betas[0] ** step), v / (1 - betas[1] ** step)
    parameter[rows] -= rate * m / (np.sqrt(v) + 1e-8)


def initial_weights(network: Network, flat: Array, rng: np.random.Generator, omega: float) -> None:
    """Fill a network's flat weights: variance kept through the layers, a quiet last one."""
    layers = network.layers(flat)
    for k, (matrix, bias) in enumerate(layers):
        reach = math.sqrt(6 / matrix.shape[1])
        if k == len(layers) - 1:
            reach /= 4
        elif k == 0 and network.activation == "sine":
            reach *= omega
        matrix[:] = rng.uniform(-reach, reach, matrix.shape)
        if network.activation == "sine" and k < len(layers) - 1:
            bias[:] = rng.uniform(-math.pi / 2, math.pi / 2, bias.shape)


def initial_texels(layout: Layout, rng: np.random.Generator) -> Array:
    """Features at random, 0.1 wide; offsets 0. Numbers beyond a pyramid's channels stay 0."""
    texels = aligned(layout.texels)
    textures = layout.textures(texels)
    for pyramid, levels in zip(layout.pyramids, textures, strict=True):
        if layout.offset and pyramid is layout.offset[0]:
            continue
        for texture in levels:
            shape = (*texture.shape[:2], pyramid.channels)
            texture[..., : pyramid.channels] = 0.1 * rng.standard_normal(shape)
    return texels


def _tensors(batch: Batch) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    blur = None if batch.footprint is None else torch.from_numpy(batch.footprint)
    uv, light, view = (torch.from_numpy(a) for a in (batch.uv, batch.light, batch.view))
    return uv, light, view, blur


def _laplacian(texture: Array, axis: int, *, wrap: bool) -> Array:
    if wrap:
        return np.roll(texture, 1, axis) + np.roll(texture, -1, axis) - 2 * texture
    step = np.diff(texture, axis=axis)
    still = np.zeros_like(texture.take([0], axis))
    return np.concatenate([step, still], axis) - np.concatenate([still, step], axis)


def _header(source: BTF | QuerySet, settings: Settings) -> Header:
    if isinstance(source, BTF):
        return Header(
            grid=source.shape[1:3],
            channels=source.channels,
            wrap=source.wrap,
            texel_mm=source.texel_mm,
            licence=source.licence,
        )
    if source.size is None:
        if source.footprint is not None:
            raise FitError(
                "these queries have footprints but no size of the grid that they count in",
                remedy="store size = (h, w) in the query file",
            )
        if not settings.size:
            raise FitError(
                "these queries do not say the size of the data's grid",
                remedy="store size = (h, w) in the query file, or --set size=N",
            )
    wrap: Wrap = "wrap" if settings.wrap == "wrap" else "clamp"
    grid = source.size or (settings.size, settings.size)
    return Header(grid=grid, channels=source.channels, wrap=wrap)


def _texture_size(grid: tuple[int, int], rows: int) -> tuple[int, int]:
    if not rows:
        return grid
    return rows, max(round(rows * grid[1] / grid[0]), 1)


def _levels_for(source: BTF | QuerySet, size: tuple[int, int]) -> int:
    if isinstance(source, BTF):
        return most_levels(size)
    if source.footprint is None:
        return 1
    widest = float(np.nanmax(np.where(np.isfinite(source.footprint), source.footprint, 0.5)))
    return 1 + max(math.ceil(math.log2(max(2 * widest, 1))), 0)
