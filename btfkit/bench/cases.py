"""What the benchmark measures on: materials to train on, with pictures and queries held out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import BTF
from btfkit.fitting.fit import split
from btfkit.fitting.neumip_data import blurred, gaussian
from btfkit.materials.evaluation import texel_centres
from btfkit.queries import QuerySet
from btfkit.textures import as_textures

# Held-out pictures; each also gives this many texels to every level of detail.
_PICTURES = 12
_TEXELS = 2048
# Light and view of held-out pictures stay inside the cone that the training directions fill.
_LOWEST_Z = 0.3


@final
@dataclass(frozen=True, eq=False)
class Case:
    """One material of the benchmark.

    Attributes:
        name: of the material.
        train: the BTF that models are fitted to, in memory.
        pictures: held-out pairs, whole, in memory.
        queries: texels of the pictures at every level of detail, with their footprints.
    """

    name: str
    train: BTF
    pictures: BTF
    queries: QuerySet

    def describe(self) -> dict[str, object]:
        """Sizes, as JSON types."""
        _, h, w, c = self.train.shape
        return {
            "pairs": len(self.train), "held_out_pairs": len(self.pictures),
            "size": [h, w], "channels": c, "wrap": self.train.wrap,
            "provenance": dict(self.train.provenance),
        }  # fmt: skip


def procedural(name: str, *, size: int, directions: int, seed: int) -> Case:
    """A material of the catalogue, traced under `directions` lights x `directions` views.

    Pictures have lights and views of their own, at random: between those trained on.
    """
    from btfkit.relief.procedural import make
    from btfkit.relief.synth import synth_btf
    from btfkit.relief.trace import traced_btf

    count = str(directions)
    train = synth_btf(name, size=size, lights=count, views=count, seed=seed)
    rng = np.random.default_rng([seed, 5])
    light, view = (_cap(rng, _PICTURES) for _ in range(2))
    relief = make(name, size, seed=seed)
    pictures = traced_btf(relief, light, view, samples=16, seed=seed + 1)
    return _case(name, train, pictures)


def stored(path: Path, *, holdout: float, seed: int) -> Case:
    """A store, or anything that `btfkit.open` reads: the pairs that `fit` would hold out."""
    from btfkit import io

    btf = io.open(path)
    train, test = split(len(btf), holdout, seed)
    shown = np.random.default_rng(seed).permutation(test)[:_PICTURES]
    return _case(path.name.removesuffix(".btf.zarr"), btf.subset(train), btf.subset(shown))


def _case(name: str, train: BTF, pictures: BTF) -> Case:
    train, pictures = _in_memory(train, np.float16), _in_memory(pictures, np.float32)
    return Case(name, train, pictures, _levels(pictures))


def _in_memory(btf: BTF, dtype: type[np.floating]) -> BTF:
    images: NDArray[Any] = np.empty(btf.shape, dtype)
    for index in range(len(btf)):
        image = btf.texture(index)
        if images.dtype == np.float16 and np.nanmax(np.abs(image), initial=0) > 6e4:
            images = images.astype(np.float32)
        images[index] = image
    return replace(btf, textures=as_textures(images))


def _levels(btf: BTF) -> QuerySet:
    """Texels of every picture, sharp and blurred to each level as the contract defines them."""
    _, h, w, _ = btf.shape
    rng = np.random.default_rng(3)
    centres = texel_centres(h, w).reshape(h * w, 2)
    parts: list[Sequence[NDArray[Any]]] = []
    for level in range(max(h, w).bit_length()):
        footprint = 0.5 * 2.0**level
        down, across = (
            gaussian(side, footprint**2 - 0.25, wrap=btf.wrap == "wrap") for side in (h, w)
        )
        for pair in range(len(btf)):
            texels = rng.permutation(h * w)[: max(_TEXELS >> level, 64)]
            image = blurred(btf.texture(pair), down, across).reshape(h * w, -1)
            directions = (d(pair).reshape(h * w, 3)[texels] for d in (btf.light_at, btf.view_at))
            blur = np.full(len(texels), footprint, np.float32)
            parts.append((centres[texels], *directions, blur, image[texels]))
    uv, light, view, blur, rgb = (
        np.concatenate(column).astype(np.float32) for column in zip(*parts, strict=True)
    )
    return QuerySet(uv, light, view, footprint=blur, rgb=rgb, size=(h, w), channels=btf.channels)


def _cap(rng: np.random.Generator, count: int) -> NDArray[np.float32]:
    """(count, 3) directions, uniform over the projected hemisphere above `_LOWEST_Z`."""
    radius = np.sqrt(rng.random(count) * (1 - _LOWEST_Z**2))
    angle = 2 * np.pi * rng.random(count)
    flat = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    return np.column_stack([flat, np.sqrt(1 - radius**2)]).astype(np.float32)
