"""Random texels of random images: the batches that NeuMIP is trained on, and their twin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit import native
from btfkit.native.neural.layout import Array


@final
@dataclass(frozen=True, eq=False)
class Images:
    """Images to draw training texels from, all of one grid.

    Attributes:
        values: (k, h, w, c) float16 or float32: every `stride`-th row and column of each image,
            from its `phase` on.
        phase: (k, 2) int32 first row and column. stride: as said.
        light, view: (k, 3) unit vectors, or positions above the centre of the sample.
        grid: (rows, cols) of the whole image.
        texel_light, texel_view: edge of a texel in the unit of the positions; 0 for directions.
    """

    values: NDArray[np.float16] | NDArray[np.float32]
    phase: NDArray[np.int32]
    light: Array
    view: Array
    grid: tuple[int, int]
    stride: int = 1
    texel_light: float = 0.0
    texel_view: float = 0.0


@final
@dataclass(frozen=True, eq=False)
class Draw:
    """b drawn texels: uv (b, 2), light and view (b, 3), target (b, c), slots (b,) of the images."""

    uv: Array
    light: Array
    view: Array
    target: Array
    slots: NDArray[np.int32]

    @staticmethod
    def empty(count: int, channels: int) -> Draw:
        uv, light, view, target = (
            np.empty((count, size), np.float32) for size in (2, 3, 3, channels)
        )
        return Draw(uv, light, view, target, np.empty(count, np.int32))

    def part(self, start: int, stop: int) -> Draw:
        """Rows start..stop, as views."""
        rows = slice(start, stop)
        return Draw(
            self.uv[rows], self.light[rows], self.view[rows], self.target[rows], self.slots[rows]
        )


def draw(images: Images, seed: int, out: Draw) -> None:
    """Fill `out` with random texels of random images; `seed` (64 bits) decides them."""
    module = native.load("draw")
    if module is None:
        draw_plain(images, seed, out)
        return
    half = images.values.dtype == np.float16
    values = images.values.view(np.uint16) if half else images.values
    (module.draw16 if half else module.draw32)(
        values, images.light, images.view, images.phase, images.stride, *images.grid,
        images.texel_light, images.texel_view, seed, out.uv, out.light, out.view, out.target,
        out.slots, native.threads(),
    )  # fmt: skip


def draw_plain(images: Images, seed: int, out: Draw) -> None:
    """The twin of `draw`: the same texels, their rays as `btfkit.nearfield` gives them."""
    k, h, w, _ = images.values.shape
    count = np.uint64(len(out.uv))
    first = _scrambled(np.uint64(seed) + np.arange(count, dtype=np.uint64))
    upper = np.uint64(32)
    slot = (((first >> upper) * np.uint64(k)) >> upper).astype(np.int64)
    texel = (((_scrambled(first) >> upper) * np.uint64(h * w)) >> upper).astype(np.int64)
    at = np.stack([texel // w, texel % w], axis=1) * images.stride + images.phase[slot] + 0.5
    rows, cols = images.grid
    out.slots[:] = slot
    out.uv[:] = at[:, ::-1] / [cols, rows]
    out.target[:] = images.values.reshape(k, h * w, -1)[slot, texel]
    plane = np.stack([at[:, 1] - cols / 2, rows / 2 - at[:, 0], 0 * at[:, 0]], axis=1)
    for table, size, into in (
        (images.light, images.texel_light, out.light),
        (images.view, images.texel_view, out.view),
    ):
        ray = table[slot] - plane * size
        into[:] = ray if size == 0 else ray / np.linalg.norm(ray, axis=1, keepdims=True)


def _scrambled(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """splitmix64, Steele et al. 2014."""
    x = x + np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))
