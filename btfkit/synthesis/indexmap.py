"""Where each texel of a tile comes from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray


@final
@dataclass(frozen=True, eq=False)
class IndexMap:
    """A tile put together from the texels of a sample, none of them mixed.

    Attributes:
        rows, cols: (p, q) source row and column of every texel of the tile.
        source: (h, w) of the sample.

    Raises:
        ValueError: arrays that do not fit, or that point out of the sample.
    """

    rows: NDArray[np.intp]
    cols: NDArray[np.intp]
    source: tuple[int, int]

    def __post_init__(self) -> None:
        if self.rows.ndim != 2 or self.rows.shape != self.cols.shape or not self.rows.size:
            raise ValueError(f"rows {self.rows.shape} and cols {self.cols.shape}; expected (p, q)")
        for name, index, size in zip(
            ("rows", "cols"), (self.rows, self.cols), self.source, strict=True
        ):
            low, high = int(index.min()), int(index.max())
            if low < 0 or high >= size:
                raise ValueError(f"{name} run from {low} to {high}; the sample has {size}")

    @staticmethod
    def identity(h: int, w: int) -> IndexMap:
        """The map of a sample that is its own tile."""
        rows, cols = np.indices((h, w))
        return IndexMap(rows, cols, (h, w))

    @property
    def size(self) -> tuple[int, int]:
        """(p, q) of the tile."""
        return self.rows.shape[0], self.rows.shape[1]

    @property
    def is_identity(self) -> bool:
        """Whether the tile is the sample, texel by texel."""
        if self.size != self.source:
            return False
        rows, cols = np.indices(self.source)
        return bool((self.rows == rows).all() and (self.cols == cols).all())

    def of(self, image: NDArray[Any]) -> NDArray[Any]:
        """(p, q, ...) the tile of an image (h, w, ...) of the sample, of the same dtype."""
        if image.shape[:2] != self.source:
            raise ValueError(f"an image of {image.shape[:2]}; the map is of {self.source}")
        return image[self.rows, self.cols]
