"""A NeuMIP's named arrays, as files hold them, and the two flat ones that its kernels read."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit.materials.base import Array
from btfkit.materials.neumip.spec import NeuMIPSpec, Precision
from btfkit.native.neural.layout import CHANNELS, Layout, Network
from btfkit.native.neural.plain import bfloat16


def flatten(
    spec: NeuMIPSpec, layout: Layout, weights: Mapping[str, NDArray[Any]]
) -> tuple[Array, Array]:
    """The kernels' two flat arrays from a model's named ones."""
    flat = np.concatenate(
        [
            np.asarray(weights[f"{name}.{k}.{part}"], np.float32).reshape(-1)
            for name, network in networks(layout)
            for k in range(len(network.widths) - 1)
            for part in ("weight", "bias")
        ]
    )
    texels = aligned(layout.texels)
    for view, (name, _, channels) in zip(_views(layout, texels), textures(layout), strict=True):
        stored = weights[name]
        if stored_as(spec, name) == "int8":
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
    for (name, network), part in zip(networks(layout), parts, strict=True):
        for k, (matrix, bias) in enumerate(network.layers(part)):
            rounded = k > 0 and spec.networks == "bfloat16"
            found[f"{name}.{k}.weight"] = bfloat16(matrix) if rounded else matrix.copy()
            found[f"{name}.{k}.bias"] = bias.copy()
    for view, (name, _, channels) in zip(_views(layout, texels), textures(layout), strict=True):
        texture = view[..., :channels]
        kind = stored_as(spec, name)
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


def aligned(texels: int) -> Array:
    """(texels, 8) zeros that begin on a cache line, so that a pair of texels is one."""
    raw = np.zeros(texels * CHANNELS + 16, np.float32)
    start = -raw.ctypes.data % 64 // 4
    return raw[start : start + texels * CHANNELS].reshape(texels, CHANNELS)


def networks(layout: Layout) -> list[tuple[str, Network]]:
    """Name and shapes of each network, as the flat weights hold them."""
    offset = [("offset", layout.offset[1])] if layout.offset else []
    return [*offset, ("decoder", layout.decoder)]


def textures(layout: Layout) -> list[tuple[str, tuple[int, int], int]]:
    """Name, size and channels of each texture, as the texels hold them."""
    found = []
    if layout.heights:
        found.append(("texture.heights", layout.heights, 1))
        found += [("texture.opacity", layout.heights, 1)] * layout.holes
    if layout.offset:
        found.append(("texture.offset", layout.offset[0].sizes[0], layout.offset[0].channels))
    for b, bank in enumerate(layout.banks):
        found += [(f"texture.{b}.{s}", size, bank.channels) for s, size in enumerate(bank.sizes)]
    return found


def stored_as(spec: NeuMIPSpec, name: str) -> Precision:
    """How a texture is stored. A ray that a step of 1/255 makes miss what it met ends far away."""
    rough = spec.precision == "int8" and name == "texture.heights"
    return "float16" if rough else spec.precision


def _views(layout: Layout, texels: Array) -> list[Array]:
    """A view of each texture that `_textures` lists."""
    heights = [layout.surface(texels)[..., None]] if layout.heights else []
    heights += [layout.cover(texels)[..., None]] if layout.holes else []
    return heights + [texture for levels in layout.textures(texels) for texture in levels]
