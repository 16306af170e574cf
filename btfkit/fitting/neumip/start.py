"""NeuMIP before its first step: networks and textures at random."""

from __future__ import annotations

import math

import numpy as np

from btfkit.materials.neumip.arrays import aligned
from btfkit.native.neural.layout import Array, Layout, Network


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
