"""Guidance as a NeuBTF is trained with it: varied crops of slices; and how any size is encoded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from btfkit.fitting.neubtf import augment
from btfkit.fitting.neubtf.settings import Guidance
from btfkit.fitting.neubtf.unet import STRIDE
from btfkit.fitting.neubtf.windows import Window
from btfkit.fitting.pool import Pool


@final
@dataclass(frozen=True)
class Guide:
    """One varied guidance.

    Attributes:
        image: (1, 3, h, w) standardised.
        window: the part of the tile that it shows.
        size: (h, w) that the part was resampled to.
        averaged: whether it is the mean frontal slice.
    """

    image: Tensor
    window: Window
    size: tuple[int, int]
    averaged: bool

    @property
    def scaled(self) -> bool:
        """Whether a texel of the guidance is no texel of the data."""
        return self.size != (self.window.height, self.window.width)


@final
class Guides:
    """Draws guidance from the slices of a BTF: any pair, or the mean frontal one.

    Args:
        frontal: (c, h, w) mean frontal slice.
        pool: slices under any light and view.
        wrap: whether the material tiles.
        settings: how often and how far the guidance varies.
        generator: of all randomness.
        guiding: (n,) whether each pair of the BTF may guide; None lets all.
    """

    def __init__(
        self,
        frontal: Tensor,
        pool: Pool,
        *,
        wrap: bool,
        settings: Guidance,
        generator: torch.Generator,
        guiding: NDArray[np.bool_] | None = None,
    ) -> None:
        self._frontal, self._pool, self._wrap = frontal, pool, wrap
        self._settings, self._generator, self._guiding = settings, generator, guiding
        self._size = (int(frontal.shape[1]), int(frontal.shape[2]))

    def draw(self) -> Guide:
        """A guidance crop, rescaled and varied; only the input is, never what it has to give."""
        image, slots = self._frontal, self._slots()
        averaged = self._uniform() < self._settings.frontal or not len(slots)
        if not averaged:
            slot = int(slots[self._integer(len(slots))])
            image = torch.from_numpy(self._pool.images[slot]).float().permute(2, 0, 1)
        window = self._window()
        scale = 1.0 if self._uniform() < 0.5 else self._settings.scales ** self._uniform()
        size = (multiple(window.height * scale), multiple(window.width * scale))
        guide = torch.nan_to_num(augment.three_channels(image))[None]
        guide = augment.encoded(self.windowed(guide, window))
        guide = augment.resized(guide, size, wrap=False)
        guide = augment.Variation()(guide, self._generator)
        return Guide(augment.standardised(guide), window, size, averaged)

    def windowed(self, image: Tensor, window: Window) -> Tensor:
        """The window of (b, c, h, w), around the border where it reaches over."""
        h, w = self._size
        if (window.height, window.width) == (h, w):
            moved = window.top or window.left
            return image.roll((-window.top, -window.left), (2, 3)) if moved else image
        rows = torch.arange(window.top, window.top + window.height) % h
        cols = torch.arange(window.left, window.left + window.width) % w
        return image[:, :, rows][:, :, :, cols]

    def _slots(self) -> NDArray[np.intp]:
        """Slots of the pool whose textures may guide."""
        pairs = self._pool.pairs
        if self._guiding is None:
            return np.arange(len(pairs))
        return np.flatnonzero(self._guiding[pairs])

    def _window(self) -> Window:
        height, width = (self._side(side) for side in self._size)
        # A tile may be cropped around its border, a sample without a period may not.
        top, left = (
            self._integer(side if self._wrap else max(side - crop, 0) + 1)
            for side, crop in zip(self._size, (height, width), strict=True)
        )
        return Window(top, left, height, width)

    def _side(self, side: int) -> int:
        """Side of a training crop: the whole tile where it tiles and is small, else less."""
        if self._wrap and side <= self._settings.crop:
            return side
        # Leave room to move: shifts are what makes the encoder equivariant between strides.
        return max(min(side, self._settings.crop, side - min(side // 4, 32)), 1)

    def _integer(self, size: int) -> int:
        return int(torch.randint(size, (1,), generator=self._generator))

    def _uniform(self) -> float:
        return float(torch.rand((), generator=self._generator))


def encode(encoder: Callable[[Tensor], Tensor], guidance: Tensor, *, wrap: bool) -> Tensor:
    """A(G) at the size of the guidance, whatever that is.

    Sizes that the stride does not divide are resampled to the nearest that it does, and the
    texture back; a periodic guidance gives a periodic texture.

    Args:
        encoder: what was fitted.
        guidance: (1, 3, h, w) sRGB encoded values, 0..1.
        wrap: whether the guidance is periodic.

    Returns:
        (1, latents, h, w), standardised as the encoder gives it.
    """
    h, w = guidance.shape[-2:]
    fitting = (multiple(h), multiple(w))
    resampled = augment.resized(guidance, fitting, wrap=wrap)
    return augment.resized(encoder(augment.standardised(resampled)), (h, w), wrap=wrap)


def multiple(side: float) -> int:
    """The multiple of the encoder's stride nearest to a side, at least one."""
    return max(STRIDE, int(side / STRIDE + 0.5) * STRIDE)
