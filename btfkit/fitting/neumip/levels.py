"""Coarser levels of detail to train on: images of a pool, blurred and thinned out."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit.native.neural.layout import Array

Images = NDArray[np.float16] | NDArray[np.float32]
# Images that are blurred for a level: enough directions, bounded time and memory.
_MOST_BLURRED = 1024
# Blurs a level is trained at, spread over the octave below it, so that levels between learn too.
_BLURS = 4
# Bytes of blurring matrices that are kept at a time.
_MOST_BYTES = 1 << 28


@final
@dataclass(frozen=True, eq=False)
class Level:
    """Every `stride`-th texel of some images, each image blurred to a footprint of the octave.

    Attributes:
        slots: (k,) which images. stride: 2^level.
        phase: (k, 2) int32 first row and column.
        blur: (k,) footprints, texels of the images.
        values: (k, rows, cols, c).
    """

    slots: NDArray[np.intp]
    stride: int
    phase: NDArray[np.int32]
    blur: Array
    values: Images


def coarser(images: Images, levels: int, *, seed: int, wrap: bool) -> list[Level]:
    """Levels 1 to `levels` - 1 of images (n, h, w, c); NaN where less than half is measured."""
    found = [_level(images, level, seed) for level in range(1, levels)]
    side = max(images.shape[1:3])
    together = max(_MOST_BYTES // (2 * _BLURS * 4 * side**2), 1)
    for start in range(0, len(found), together):
        _fill(images, found[start : start + together], wrap=wrap)
    return found


def _level(images: Images, level: int, seed: int) -> Level:
    """What a level is made of, its values still empty."""
    rng = np.random.default_rng([seed, level])
    n, h, w, c = images.shape
    most = max(_MOST_BLURRED * 65536 // (h * w), 16)
    count = min(n, _MOST_BLURRED, most)
    slots = rng.permutation(n)[:count]
    stride = 2**level
    rows, cols = max(h // stride, 1), max(w // stride, 1)
    # A side that a stride no longer divides keeps one texel: its phase says which.
    phase = np.stack(
        [rng.integers(side - (kept - 1) * min(stride, side), size=count)
         for side, kept in ((h, rows), (w, cols))], axis=1,
    ).astype(np.int32)  # fmt: skip
    blur = (0.5 * 2 ** (level - rng.integers(_BLURS, size=count) / _BLURS)).astype(np.float32)
    return Level(slots, stride, phase, blur, np.empty((count, rows, cols, c), images.dtype))


def _fill(images: Images, levels: list[Level], *, wrap: bool) -> None:
    """One look at an image serves all levels: making it float32 costs what a blur costs."""
    matrices: dict[tuple[int, float], Array] = {}
    users: dict[int, list[tuple[Level, int]]] = {}
    for level in levels:
        for at, slot in enumerate(level.slots):
            users.setdefault(int(slot), []).append((level, at))
        for blur in set(level.blur.tolist()):
            for side in images.shape[1:3]:
                matrices[side, blur] = gaussian(side, blur**2 - 0.25, wrap=wrap)
    for slot, wanted in users.items():
        image = images[slot].astype(np.float32)
        finite = np.isfinite(image)
        holes = None if finite.all() else finite
        for level, at in wanted:
            down, across = (
                matrices[side, float(level.blur[at])][first :: level.stride][:kept]
                for side, first, kept in zip(
                    images.shape[1:3], level.phase[at], level.values.shape[1:3], strict=True
                )
            )
            level.values[at] = _blurred(image, down, across, holes)


@lru_cache(maxsize=8)
def gaussian(side: int, variance: float, *, wrap: bool) -> Array:
    """(side, side) matrix that blurs a column of texels; rows sum to 1, borders wrap or clamp.

    Args:
        side: texels. variance: of the Gaussian, texels squared.
    """
    if variance <= 0:
        return np.eye(side, dtype=np.float32)
    reach = math.ceil(4 * math.sqrt(variance))
    steps = np.arange(-reach, reach + 1)
    weight = np.exp(-(steps**2) / (2 * variance))
    weight /= weight.sum()
    matrix = np.zeros((side, side))
    at = np.arange(side)[:, None] + steps
    at = at % side if wrap else np.clip(at, 0, side - 1)
    np.add.at(matrix, (np.arange(side)[:, None], at), weight)
    return matrix.astype(np.float32)


def blurred(image: Array, down: Array, across: Array) -> Array:
    """down @ image @ across^T of an image (h, w, c); NaN where less than half is measured."""
    finite = np.isfinite(image)
    return _blurred(image, down, across, None if finite.all() else finite)


def _blurred(
    image: Array, down: Array, across: Array, measured: NDArray[np.bool_] | None
) -> Array:
    """As `blurred`, where it is known what is measured; None: everything."""
    if measured is None:
        return _separable(image, down, across)
    known = _separable(measured.astype(np.float32), down, across)
    total = _separable(np.where(measured, image, np.float32(0)), down, across)
    return np.where(known >= 0.5, total / np.maximum(known, 1e-6), np.float32(np.nan))


def _separable(image: Array, down: Array, across: Array) -> Array:
    h, w, c = image.shape
    part = (down @ image.reshape(h, -1)).reshape(-1, w, c)
    found: Array = np.matmul(across, part)
    return found
