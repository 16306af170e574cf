"""Truncated singular value decomposition of a matrix that is read in blocks of rows, pass by pass.

Subspace iteration: V <- orth(M' M V) is one pass over the rows of M, and needs no more memory
than V and one block. Source: Halko, Martinsson and Tropp, "Finding Structure with Randomness",
2011, section 4.5.
"""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]


@final
class Sketch:
    """The leading singular vectors of a matrix (rows, columns).

    Args:
        rows, columns: of the matrix.
        width: vectors that are tracked; some more than are wanted.
        rng: of the first guess.
    """

    def __init__(self, rows: int, columns: int, width: int, rng: np.random.Generator) -> None:
        self._shape, self._rng = (rows, columns), rng
        self.v = np.zeros((columns, 0), np.float32)
        self.grow(width)

    @property
    def width(self) -> int:
        return self.v.shape[1]

    @property
    def full(self) -> bool:
        """Whether there are no more singular vectors than are tracked."""
        return self.width == min(self._shape)

    @property
    def spans_all(self) -> bool:
        """Whether the vectors span every row: nothing is to be found by turning them."""
        return self.width == self._shape[1]

    def grow(self, width: int) -> None:
        """Track `width` vectors, or as many as there are."""
        rows, columns = self._shape
        more = min(width, rows, columns) - self.width
        if more > 0:
            fresh = self._rng.standard_normal((columns, more), np.float32)
            self.v = np.linalg.qr(np.concatenate([self.v, fresh], axis=1))[0]

    def begin(self) -> None:
        """Start a pass of `absorb`."""
        self._product = np.zeros_like(self.v)

    def absorb(self, block: Array) -> None:
        """Take some rows (b, columns) into account."""
        self._product += block.T @ (block @ self.v)

    def turn(self) -> None:
        """End a pass of `absorb`: the vectors turn towards the leading ones."""
        self.v = np.linalg.qr(self._product)[0]
        del self._product

    def begin_projection(self) -> None:
        """Start the pass of `project`."""
        self._rows = np.empty((self._shape[0], self.width), np.float32)
        self._filled = 0
        self._squares = 0.0

    def project(self, block: Array) -> None:
        """Take some rows, in their order, into the result."""
        rows = block @ self.v
        rest = block - rows @ self.v.T
        self._squares += float(np.einsum("ij,ij->", rest, rest, dtype=np.float64))
        self._rows[self._filled : self._filled + len(block)] = rows
        self._filled += len(block)

    def residuals(self) -> NDArray[np.float64]:
        """(width,) root mean square error of the matrix when 1, 2, ... components are kept."""
        self._u, self._s, self._w = np.linalg.svd(self._rows, full_matrices=False)
        tail = np.cumsum(self._s[::-1].astype(np.float64) ** 2)[::-1]
        rows, columns = self._shape
        return np.sqrt((self._squares + np.append(tail[1:], 0)) / (rows * columns))

    def factors(self, rank: int) -> tuple[Array, Array, Array]:
        """U (rows, rank), S (rank,) and V x S (columns, rank); after `residuals`."""
        scaled = self._w[:rank].T * self._s[:rank]
        return self._u[:, :rank], self._s[:rank], self.v @ scaled
