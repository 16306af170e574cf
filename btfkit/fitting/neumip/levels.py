"""Coarser levels of detail to train on: images of a pool, blurred and thinned out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit.footprint import blur_of, blurred_measured, gaussian, of_level
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
    blur = of_level(level - rng.integers(_BLURS, size=count) / _BLURS).astype(np.float32)
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
                matrices[side, blur] = gaussian(side, blur_of(blur), wrap=wrap)
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
            level.values[at] = blurred_measured(image, down, across, holes)
