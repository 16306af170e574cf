"""What NeuMIP is trained on: batches of queries with answers, here random texels of textures."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import BTF
from btfkit.fitting.neumip.levels import Level, coarser
from btfkit.fitting.pool import Pool
from btfkit.fitting.prior.pairs import Guesses
from btfkit.native.draw import Draw, Images, draw
from btfkit.native.neural.layout import Array

Progress = Callable[[int, int], None]
HELD_TEXELS = 2048
# Share of a batch that is sharp, and how many queries a level has of what the one before has.
# docs/neumip.md, levels of detail: a sharp texture of glints needs most of the queries.
_SHARP, _FEWER = 0.6, 0.7
HELD_PAIRS = 16


@final
@dataclass(frozen=True, eq=False)
class Batch:
    """b queries with answers; footprint None is 0.5 throughout, weight None is 1.

    curvature None is the plane. rows (b,) are those of the query file, None of textures.
    """

    uv: Array
    light: Array
    view: Array
    footprint: Array | None
    target: Array
    weight: Array | None = None
    curvature: Array | None = None
    rows: NDArray[np.intp] | None = None

    def __len__(self) -> int:
        return len(self.uv)


@final
@dataclass(frozen=True, eq=False)
class Share:
    """Rows start..stop of a batch, drawn with `seed` from images; blur None is 0.5.

    `pairs` are what the images were measured of; None where they are guessed.
    """

    images: Images
    pairs: NDArray[np.intp] | None
    blur: Array | None
    seed: int
    start: int
    stop: int


def shares_of(count: int, levels: int) -> list[int]:
    """How many queries of a batch each level of detail has, the sharp one first."""
    if levels == 1:
        return [count]
    parts = _FEWER ** np.arange(levels - 1)
    edges = (count * (1 - _SHARP) * np.cumsum(parts) / parts.sum()).astype(int)
    return [count - int(edges[-1]), *np.diff(edges, prepend=0).tolist()]


class Source(ABC):
    """Gives batches; what it gives at a step is decided by seed and step alone.

    Attributes:
        masked: texels or rows that are not measured.
    """

    masked: int = 0

    @abstractmethod
    def batch(self, step: int, count: int) -> Batch:
        """`count` training queries; arrays may be reused by the next call."""

    @abstractmethod
    def held_out(self) -> Batch:
        """A fixed part of the test set, perhaps empty."""


@final
class TexelSource(Source):
    """Texels of a BTF's training pairs, level 0 sharp, coarser levels from blurred textures.

    A share of each level is guessed, where there are guesses.
    """

    def __init__(
        self,
        btf: BTF,
        train: NDArray[np.intp],
        test: NDArray[np.intp],
        *,
        levels: int,
        seed: int,
        pool_bytes: int,
        progress: Progress | None = None,
    ) -> None:
        self._btf, self._test, self._seed = btf, test, seed
        self._pool = Pool(btf, train, seed=seed, most_bytes=pool_bytes, progress=progress)
        self.masked = self._pool.masked
        made = coarser(self._pool.images, levels, seed=seed, wrap=btf.wrap == "wrap")
        self._coarse = [self._coarser(level) for level in made]
        self._guesses: Guesses | None = None
        self._room: tuple[Draw, Array] | None = None

    def batch(self, step: int, count: int) -> Batch:
        if self._room is None or len(self._room[1]) != count:
            self._room = (Draw.empty(count, self._btf.shape[3]), np.full(count, 0.5, np.float32))
        out, footprint = self._room
        for share in self.shares(step, count):
            part = out.part(share.start, share.stop)
            draw(share.images, share.seed, part)
            factors = None if share.pairs is None else self._pool.factors(share.pairs)
            if factors is not None:
                part.target[...] *= factors[part.slots]
            blur = 0.5 if share.blur is None else share.blur[part.slots]
            footprint[share.start : share.stop] = blur
        blurred = footprint if self._coarse else None
        return Batch(out.uv, out.light, out.view, blurred, out.target)

    def guess(self, guesses: Guesses | None) -> None:
        """Let a share of every batch be guessed from now on; None lets none."""
        self._guesses = guesses

    @property
    def pairs(self) -> NDArray[np.intp]:
        """(k,) the pair of each sharp texture in memory."""
        return self._pool.pairs

    @property
    def pool(self) -> Pool:
        """The sharp textures in memory."""
        return self._pool

    def shares(self, step: int, count: int) -> list[Share]:
        """What a batch is drawn from: the sharp textures last."""
        self._pool.at_step(step)
        at, found = count, []
        seed = int(np.random.SeedSequence([self._seed, step]).generate_state(1, np.uint64)[0])
        seed >>= 1  # room for one number a query
        coarse = zip(self._coarse, shares_of(count, len(self._coarse) + 1)[1:], strict=True)
        for level, ((images, blur, pairs), share) in enumerate(coarse):
            mixed = seed ^ (level + 1) << 40
            if self._guesses:
                guess, its_blur = self._guesses.coarse[level]
                few = int(self._guesses.share * share)
                found.append(Share(guess, None, its_blur, mixed ^ 1 << 48, at - few, at))
                at, share = at - few, share - few
            found.append(Share(images, pairs, blur, mixed, at - share, at))
            at -= share
        if self._guesses:
            few = int(self._guesses.share * at)
            found.append(Share(self._guesses.sharp, None, None, seed ^ 1 << 48, at - few, at))
            at -= few
        return [*found, Share(self._images(), self._pool.pairs, None, seed, 0, at)]

    def held_out(self) -> Batch:
        rng = np.random.default_rng([self._seed, 7])
        pairs = rng.permutation(self._test)[:HELD_PAIRS]
        h, w = self._btf.shape[1:3]
        parts = []
        for pair in pairs:
            texel = rng.integers(h * w, size=min(HELD_TEXELS, h * w))
            row, col = np.divmod(texel, w)
            uv = np.stack([(col + 0.5) / w, (row + 0.5) / h], axis=1).astype(np.float32)
            light = self._btf.light_at(int(pair))[row, col]
            view = self._btf.view_at(int(pair))[row, col]
            parts.append((uv, light, view, self._btf.texture(int(pair))[row, col]))
        if not parts:
            return _nothing(self._btf.shape[3])
        uv, light, view, rgb = (
            np.ascontiguousarray(np.concatenate(column), np.float32)
            for column in zip(*parts, strict=True)
        )
        return Batch(uv, light, view, None, rgb)

    def _images(self) -> Images:
        h, w = self._btf.shape[1:3]
        phase = np.zeros((len(self._pool.pairs), 2), np.int32)
        return self._with_directions(self._pool.images, phase, 1, self._pool.pairs, (h, w))

    def _with_directions(
        self,
        values: NDArray[np.float16] | NDArray[np.float32],
        phase: NDArray[np.int32],
        stride: int,
        pairs: NDArray[np.intp],
        grid: tuple[int, int],
    ) -> Images:
        btf = self._btf
        near = [btf.light_position, btf.view_position]
        texel = btf.texel_mm or 0.0
        table = [
            far[pairs] if position is None else position[pairs].astype(np.float32)
            for far, position in zip((btf.light, btf.view), near, strict=True)
        ]
        edges = [0.0 if position is None else texel for position in near]
        return Images(values, phase, table[0], table[1], grid, stride, edges[0], edges[1])

    def _coarser(self, level: Level) -> tuple[Images, Array, NDArray[np.intp]]:
        pairs, grid = self._pool.pairs[level.slots], self._btf.shape[1:3]
        images = self._with_directions(level.values, level.phase, level.stride, pairs, grid)
        return images, level.blur, pairs


def _nothing(channels: int) -> Batch:
    arrays = [np.empty((0, size), np.float32) for size in (2, 3, 3, channels)]
    return Batch(arrays[0], arrays[1], arrays[2], None, arrays[3])
