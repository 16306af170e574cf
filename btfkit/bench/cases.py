"""What the benchmark measures on: materials to train on, with pictures and queries held out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit import io, sources
from btfkit.bench import strata
from btfkit.btf import BTF
from btfkit.footprint import blur_of, blurred, gaussian, most_levels, of_level
from btfkit.heldout import split
from btfkit.io import queryfile
from btfkit.materials.evaluation import texel_centres
from btfkit.queries import QuerySet
from btfkit.textures import HALF_RANGE, as_textures

# Held-out pictures; each also gives this many texels to every level of detail.
_PICTURES = 12
_TEXELS = 2048
# Light and view of held-out pictures stay inside the cone that the training directions fill.
_LOWEST_Z = 0.3


@final
@dataclass(frozen=True, eq=False)
class Coarse:
    """The held-out pictures at one level of detail, as small as that level is.

    Attributes:
        level: 1 for the first beyond the sharp one. footprint: its blur, texels of the data.
        uv: (r, s, 2) places. light, view: (p, r, s, 3) there. images: (p, r, s, c).
    """

    level: int
    footprint: float
    uv: NDArray[np.float64]
    light: NDArray[np.float32]
    view: NDArray[np.float32]
    images: NDArray[np.float32]


@final
@dataclass(frozen=True, eq=False)
class Case:
    """One material of the benchmark.

    Attributes:
        name: of the material.
        train: the BTF or the queries that models are fitted to, in memory.
        queries: held out: rows of a query file, or texels of the pictures at every level of detail.
        pictures: held-out pairs, whole, in memory; None where the data are queries.
        coarse: the pictures at every level but the sharp one.
        angle: (p,) of each picture, degrees to the nearest pair trained on, where pairs are held
            out by that.
    """

    name: str
    train: BTF | QuerySet
    queries: QuerySet
    pictures: BTF | None = None
    coarse: tuple[Coarse, ...] = ()
    angle: NDArray[np.float64] | None = None

    @property
    def samples(self) -> int:
        """Values that there are to train on, of all channels together."""
        train = self.train
        return len(train) if isinstance(train, QuerySet) else int(np.prod(train.shape[:3]))

    def describe(self) -> dict[str, object]:
        """Sizes, as JSON types."""
        train = self.train
        provenance = dict(train.provenance)
        if isinstance(train, QuerySet):
            return {
                "rows": len(train), "held_out_rows": len(self.queries),
                "size": None if train.size is None else list(train.size),
                "channels": len(train.channels), "provenance": provenance,
            }  # fmt: skip
        _, h, w, c = train.shape
        return {
            "pairs": len(train),
            "held_out_pairs": 0 if self.pictures is None else len(self.pictures),
            "size": [h, w], "channels": c, "wrap": train.wrap, "provenance": provenance,
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
    btf = io.open(path)
    train, test = split(len(btf), holdout, seed)
    shown = np.random.default_rng(seed).permutation(test)[:_PICTURES]
    return _case(name_of(path), btf.subset(train), btf.subset(shown))


def stratified(path: Path, *, holdout: float, seed: int) -> Case:
    """A measured BTF with pairs held out at every distance from those trained on."""
    btf = io.open(path)
    train, test = strata.split(btf.light, btf.view, holdout=holdout, seed=seed)
    angle = strata.angles(btf.light[test], btf.view[test], btf.light[train], btf.view[train])
    shown = strata.shown(angle, each=_PICTURES, seed=seed)
    case = _case(name_of(path), btf.subset(train), btf.subset(test[shown]))
    # Levels of detail are for traced materials, of which each level is known.
    return replace(case, angle=angle[shown], coarse=())


def asked(path: Path, *, holdout: float, seed: int) -> Case:
    """A query file: the rows that `fit` would hold out.

    Raises:
        ValueError: the file has no answers, or no held-out row can be compared with.
    """
    queries = queryfile.read(path)
    if queries.rgb is None:
        raise ValueError(f"{path} has no answers (rgb): there is nothing to fit")
    train, test = split(len(queries), holdout, seed)
    held = queries.subset(test)
    if not held.valid().any():
        raise ValueError(f"none of the {len(test)} held-out rows of {path} can be compared with")
    return Case(name_of(path), queries.subset(train), held)


def name_of(source: str | Path) -> str:
    """What a material is called in tables and file names."""
    return source if isinstance(source, str) else source.name.removesuffix(".btf.zarr")


def rows_of(path: Path) -> int | None:
    """Rows of the grid of a store or query file; None where queries do not say."""
    if not has_queries(path):
        return io.open(path).shape[1]
    size = queryfile.read(path).size
    return None if size is None else size[0]


def has_queries(path: Path) -> bool:
    """Whether a source is a query file."""
    return sources.kind_of(path) == "queries"


def _case(name: str, train: BTF, pictures: BTF) -> Case:
    train, pictures = _in_memory(train, np.float16), _in_memory(pictures, np.float32)
    queries, coarse = _levels(pictures)
    return Case(name, train, queries, pictures, coarse)


def _in_memory(btf: BTF, dtype: type[np.floating]) -> BTF:
    images: NDArray[Any] = np.empty(btf.shape, dtype)
    for index in range(len(btf)):
        image = btf.texture(index)
        if images.dtype == np.float16 and np.nanmax(np.abs(image), initial=0) > HALF_RANGE:
            images = images.astype(np.float32)
        images[index] = image
    return replace(btf, textures=as_textures(images))


def _levels(btf: BTF) -> tuple[QuerySet, tuple[Coarse, ...]]:
    """Every picture sharp and blurred to each level as the contract defines them.

    Returns:
        Texels at random of all of them, and the blurred ones as small pictures.
    """
    _, h, w, _ = btf.shape
    rng = np.random.default_rng(3)
    centres = texel_centres(h, w).reshape(h * w, 2)
    parts: list[Sequence[NDArray[Any]]] = []
    coarse = []
    for level in range(most_levels((h, w))):
        footprint = float(of_level(level))
        down, across = (
            gaussian(side, blur_of(footprint), wrap=btf.wrap == "wrap") for side in (h, w)
        )
        images = [blurred(btf.texture(pair), down, across) for pair in range(len(btf))]
        for pair, image in enumerate(images):
            texels = rng.permutation(h * w)[: max(_TEXELS >> level, 64)]
            directions = (d(pair).reshape(h * w, 3)[texels] for d in (btf.light_at, btf.view_at))
            blur = np.full(len(texels), footprint, np.float32)
            parts.append((centres[texels], *directions, blur, image.reshape(h * w, -1)[texels]))
        if level:
            coarse.append(_coarse(btf, level, footprint, images))
    uv, light, view, blur, rgb = (
        np.concatenate(column).astype(np.float32) for column in zip(*parts, strict=True)
    )
    queries = QuerySet(uv, light, view, footprint=blur, rgb=rgb, size=(h, w), channels=btf.channels)
    return queries, tuple(coarse)


def _coarse(btf: BTF, level: int, footprint: float, images: list[NDArray[Any]]) -> Coarse:
    """Every 2^level-th texel of blurred pictures; of a shorter side the middle one."""
    _, h, w, _ = btf.shape
    rows, cols = (
        np.arange(min(2**level, side) // 2, side, 2**level, dtype=np.intp) for side in (h, w)
    )
    at = np.ix_(rows, cols)
    light, view = (
        np.stack([d(pair)[at] for pair in range(len(btf))]) for d in (btf.light_at, btf.view_at)
    )
    small = np.stack([image[at] for image in images]).astype(np.float32)
    return Coarse(level, footprint, texel_centres(h, w)[at], light, view, small)


def _cap(rng: np.random.Generator, count: int) -> NDArray[np.float32]:
    """(count, 3) directions, uniform over the projected hemisphere above `_LOWEST_Z`."""
    radius = np.sqrt(rng.random(count) * (1 - _LOWEST_Z**2))
    angle = 2 * np.pi * rng.random(count)
    flat = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    return np.column_stack([flat, np.sqrt(1 - radius**2)]).astype(np.float32)
