"""NeuMIP before its first step: networks and textures at random."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from btfkit.materials.neumip.arrays import aligned
from btfkit.native.neural.layout import Array, Layout, Network

if TYPE_CHECKING:
    from btfkit.fitting.prior.guess import Guess

# How large guessed features are beside those at random.
_NORMALS, _COLOURS = 0.5, 0.3


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


def begin_from(guess: Guess, layout: Layout, texels: Array) -> None:
    """Put what is guessed where training looks for it: heights, normals in the first frame,
    colours in the next channels. A short fit to few pairs then has only to learn the decoder.
    """
    from btfkit.fitting.prior.guess import averaged, enlarged

    if layout.heights:
        surface = layout.surface(texels)
        surface[...] = enlarged(guess.height, surface.shape) / np.float32(layout.depth_scale)
    bank = int(layout.offset is not None)
    pyramid, levels = layout.pyramids[bank], layout.textures(texels)[bank]
    if pyramid.channels < 3 or not layout.frames:
        return
    colours = np.log1p(guess.albedo)
    spread = np.maximum(colours.std(axis=(0, 1)), 1e-3)
    colours = _COLOURS * (colours - colours.mean(axis=(0, 1))) / spread
    count = min(colours.shape[2], pyramid.channels - 3)
    for texture in levels:
        size = texture.shape[:2]
        normal = guess.normal
        if size[0] < normal.shape[0] or size[1] < normal.shape[1]:
            normal = averaged(normal, size)
        texture[..., :3] = _NORMALS * enlarged(normal, size)
        if count:
            texture[..., 3 : 3 + count] = averaged(colours[..., :count], size)
