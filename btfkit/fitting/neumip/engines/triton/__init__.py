"""NeuMIP through fused Triton kernels, as `device.Gradients` says.

Products run on matrix units with factors of 16 bits and sums of 32 where `matrix` says so; lookups,
phases of sines, losses and sums of gradients are always float32.
"""

from __future__ import annotations

import importlib.util
from typing import Any, Literal, final

import torch
from torch import Tensor

from btfkit.conventions import FLATTEST, KERNEL_INPUTS, LOOKS, STEEPEST
from btfkit.fitting.neumip.engines.gradients import Gradients, Tensors
from btfkit.native.neural.layout import Layout, Network

Matrix = Literal["fp32", "tf32", "bf16", "fp16"]
MATRICES: tuple[Matrix, ...] = ("fp32", "tf32", "bf16", "fp16")

# Widest layer, and rows of a bank and of the directions in the first one.
_WIDEST, _TILE = 32, 16
_MOST_CHANNELS = 64
# Inputs that the kernels know, in the order of their tile of directions.
KNOWN_INPUTS = KERNEL_INPUTS[: KERNEL_INPUTS.index("curvature")]
# Programs add weight gradients to this many copies, so that few meet at one address.
_COPIES = 16
# float16 holds errors from 1e-8 on with it; factors above 65504 are cut.
_HALF_SCALE = 256.0


def available() -> bool:
    """Whether Triton is installed."""
    return importlib.util.find_spec("triton") is not None


def uncovered(layout: Layout) -> str:
    """Why the kernels do not know a layout; empty where they do."""
    if layout.curved:
        return "heights on curved surfaces"
    networks = [layout.decoder] + ([layout.offset[1]] if layout.offset else [])
    for network in networks:
        hidden = network.widths[1:-1]
        if unknown := [name for name in network.directions if name not in KNOWN_INPUTS]:
            return f"an input {unknown[0]!r}; {', '.join(KNOWN_INPUTS)} are known"
        if len(hidden) != 3 or max(hidden) > _WIDEST:
            return f"hidden layers of {hidden}; three of at most {_WIDEST} are known"
    if layout.channels > _MOST_CHANNELS:
        return f"{layout.channels} channels; at most {_MOST_CHANNELS} are known"
    if len(layout.banks) > 3:
        return f"{len(layout.banks)} pyramids; at most 3 are known"
    if layout.texels >= 2**28:
        return f"{layout.texels} texels; fewer than 2^28 are known"
    return ""


@final
class Packing:
    """Where a layout's flat weights lie in the kernels' padded ones.

    A network: (16, 32) rows of the directions, in the order of `KNOWN_INPUTS`, then of frames; 32
    biases; (16, 32) rows of each pyramid, its 8 numbers twice, once for either level; two hidden
    layers of (32, 32) and 32 biases; the last one, (32, columns) and its biases. "mask" has a
    second last one. Matrices are (in, out). The offset network comes first.

    Attributes:
        columns: of the decoder's last layer. size: numbers of all.
        first, second: (layout.weights,) places of each weight; `size` where there is no second.
    """

    def __init__(self, layout: Layout) -> None:
        self.columns = max(_TILE, 1 << (layout.channels - 1).bit_length())
        self.size = 0
        self._first: list[Tensor] = []
        self._second: list[Tensor] = []
        if layout.offset:
            pyramid, network = layout.offset
            self._network(network, [pyramid.channels], 0, [1], _TILE)
        heads = [layout.channels] * (2 if layout.output == "mask" else 1)
        counts = [bank.channels for bank in layout.banks]
        self._network(layout.decoder, counts, layout.frames, heads, self.columns)
        self.first = torch.cat(self._first)
        second = torch.cat(self._second)
        self.second = torch.where(second < 0, self.size, second)

    def _network(
        self, network: Network, counts: list[int], frames: int, heads: list[int], columns: int
    ) -> None:
        start = self.size
        banks = start + (_TILE + 1) * _WIDEST
        width, known = network.widths[1], [len(KNOWN_INPUTS) + j for j in range(2 * frames)]
        known += [KNOWN_INPUTS.index(name) for name in network.directions]
        features = torch.tensor(
            [banks + _WIDEST * (_TILE * k + j) for k, n in enumerate(counts) for j in range(n)]
        )
        rows = torch.cat([features, start + _WIDEST * torch.tensor(known)])
        column = torch.arange(width)
        self._layer(rows, column, start + _TILE * _WIDEST + column)
        again = torch.full((width, len(rows)), -1)
        again[:, : len(features)] = features + 8 * _WIDEST + column[:, None]
        self._second[-1][: again.numel()] = again.reshape(-1)
        self.size = banks + _TILE * _WIDEST * len(counts)
        for a, b in zip(network.widths[1:-2], network.widths[2:-1], strict=True):
            place = self.size + torch.arange(b)
            self._layer(
                torch.arange(a) * _WIDEST, place, self.size + 32 * _WIDEST + torch.arange(b)
            )
            self.size += (_WIDEST + 1) * _WIDEST
        parts = [
            self.size + (_WIDEST + 1) * columns * k + torch.arange(head)
            for k, head in enumerate(heads)
        ]
        place = torch.cat(parts)
        self._layer(torch.arange(network.widths[-2]) * columns, place, place + _WIDEST * columns)
        self.size += (_WIDEST + 1) * columns * len(heads)

    def _layer(self, rows: Tensor, columns: Tensor, biases: Tensor) -> None:
        """Places of an (out, in) matrix and of its biases."""
        matrix = (columns[:, None] + rows[None, :]).reshape(-1)
        self._first.append(torch.cat([matrix, biases]))
        self._second.append(torch.full_like(self._first[-1], -1))

    def to(self, device: torch.device) -> Packing:
        """The same, its places on a device."""
        self.first, self.second = self.first.to(device), self.second.to(device)
        return self

    def packed(self, weights: Tensor) -> Tensor:
        """The kernels' weights from a layout's flat ones."""
        room = weights.new_zeros(self.size + 1)
        room[self.first] = weights
        room[self.second] = weights
        return room

    def unpacked(self, gradients: Tensor) -> Tensor:
        """(weights,) gradients of a layout from the kernels' (copies, size + 1)."""
        total = gradients.sum(0)
        return total[self.first] + total[self.second]


@final
class Fused(Gradients):
    """One layout's kernels on a device.

    Args:
        layout: one that `uncovered` has nothing against.
        device: CUDA, or the CPU where Triton was told to interpret (TRITON_INTERPRET=1).
        matrix: what factors of products are rounded to; sums are float32.
        block: queries a program.
    """

    def __init__(
        self, layout: Layout, device: torch.device, *, matrix: Matrix = "bf16", block: int = 64
    ) -> None:
        reason = uncovered(layout)
        if reason:
            raise ValueError(f"no fused kernel for {reason}")
        self._layout, self._block = layout, block
        self._packing = Packing(layout).to(device)
        self._banks, self._textures = (table.to(device) for table in _tables(layout))
        self._scale = _HALF_SCALE if matrix == "fp16" else 1.0
        self._config = _config(layout, self._packing, matrix, block)

    def evaluate(
        self, weights: Tensor, texels: Tensor, batch: Tensors, *, raw: bool = False
    ) -> Tensor:
        """Reflectance (b, c) of a batch, or the decoder's raw numbers; no gradients."""
        from btfkit.fitting.neumip.engines.triton import kernels

        count = len(batch[0])
        width = self._layout.decoder.widths[-1] if raw else self._layout.channels
        out = torch.empty(count, width, device=texels.device)
        if count:
            common, config = self._common(weights, texels, batch)
            kernels.evaluate[self._grid(count)](
                *common, out, count, *self._numbers(), **config, raw=raw
            )
        return out

    def gradients(
        self,
        weights: Tensor,
        texels: Tensor,
        batch: Tensors,
        target: Tensor,
        weight: Tensor | None = None,
        *,
        loss: str = "square",
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Loss of a batch as `forward.loss_of`, its gradients by weights and by texels."""
        from btfkit.fitting.neumip.engines.triton import kernels

        count, size = len(batch[0]), self._packing.size + 1
        grown = texels.new_zeros(_COPIES, size)
        by_texels = torch.zeros_like(texels)
        (programs,) = self._grid(count)
        losses = texels.new_zeros(programs)
        common, config = self._common(weights, texels, batch)
        kernels.gradients[(programs,)](
            *common, target.contiguous(), _some(weight, target), losses, grown, by_texels,
            count, *self._numbers(), self._scale, size, **config,
            weighted=weight is not None, square=loss == "square", copies=_COPIES,
        )  # fmt: skip
        return losses.sum() / target.numel(), self._packing.unpacked(grown), by_texels

    def _grid(self, count: int) -> tuple[int]:
        return (-(-count // self._block),)

    def _numbers(self) -> tuple[int, int, float, float]:
        layout = self._layout
        return *(layout.heights or (1, 1)), float(layout.aspect), float(layout.depth_scale)

    def _common(
        self, weights: Tensor, texels: Tensor, batch: Tensors
    ) -> tuple[tuple[Tensor, ...], dict[str, Any]]:
        layout = self._layout
        span = texels
        if layout.heights:
            surface = layout.surface(texels)
            span = torch.stack([surface.amax(), surface.amin()])
        uv, light, view, footprint = batch
        parts = [part.contiguous() for part in (uv, light, view)]
        leveled = footprint is not None
        config = self._config | {"leveled": leveled}
        if not leveled:
            config["many"] = 0
        tables = (self._packing.packed(weights), texels, self._banks, self._textures, span)
        return (*tables, *parts, _some(footprint, uv)), config


def _some(part: Tensor | None, other: Tensor) -> Tensor:
    """An argument that is there, or another one in its place that is not read."""
    return other if part is None else part.contiguous()


def _tables(layout: Layout) -> tuple[Tensor, Tensor]:
    """(pyramids, 8) view, light, shift, levels, first texture; (textures, 3) h, w, first texel."""
    banks: list[list[float]] = []
    textures: list[tuple[int, int, int]] = []
    at = layout.texels - sum(pyramid.texels for pyramid in layout.pyramids)
    for pyramid in layout.pyramids:
        numbers = (pyramid.view, pyramid.light, pyramid.shift, len(pyramid.sizes), len(textures))
        banks.append([float(number) for number in numbers] + [0.0] * 3)
        for h, w in pyramid.sizes:
            textures.append((h, w, at))
            at += h * w
    return torch.tensor(banks), torch.tensor(textures, dtype=torch.int32)


def _config(layout: Layout, packing: Packing, matrix: Matrix, block: int) -> dict[str, Any]:
    import triton
    import triton.language as tl

    kinds = {"fp16": tl.float16, "bf16": tl.bfloat16}
    exact = "tf32" if matrix == "tf32" else "ieee"
    if matrix == "bf16" and triton.knobs.runtime.interpret:
        exact = "rounded"
    stage = "heights" if layout.heights else "network" if layout.offset else "none"
    return {
        "stage": stage,
        "bank_count": len(layout.banks),
        "many": sum((len(bank.sizes) > 1) << k for k, bank in enumerate(layout.banks)),
        "frames": layout.frames,
        "wrap": layout.wrap,
        "activation": layout.decoder.activation,
        "offset_activation": layout.offset[1].activation if layout.offset else "linear",
        "output": layout.output,
        "channels": layout.channels,
        "columns": packing.columns,
        "march": LOOKS,
        "steepest": STEEPEST,
        "flattest": FLATTEST,
        "kind": kinds.get(matrix, tl.float32),
        "exact": exact,
        "block": block,
    }
