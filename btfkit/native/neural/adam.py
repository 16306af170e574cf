"""Adam in numpy: the twin of the kernels' optimiser, and the one of plain recipes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit.native.neural.layout import Array


def adam_plain(
    slots: tuple[Array, Array, Array],
    gradient: Array,
    rate: float,
    step: int,
    betas: tuple[float, float],
    *,
    dense: bool = True,
) -> None:
    """The twin of the kernels' Adam, in place: parameters and both moments.

    `dense` False leaves out pairs of texels, (t, 8), without any gradient.
    """
    parameter, first, second = slots
    rows: Any = slice(None)
    if not dense and parameter.ndim == 2:
        some: NDArray[np.bool_] = np.any(gradient != 0, axis=1)
        pairs = np.zeros((len(some) + 1) // 2, bool)
        np.logical_or.at(pairs, np.flatnonzero(some) // 2, True)
        rows = np.repeat(pairs, 2)[: len(some)]
    g = gradient[rows]
    first[rows] = m = betas[0] * first[rows] + np.float32(1 - betas[0]) * g
    second[rows] = v = betas[1] * second[rows] + np.float32(1 - betas[1]) * g * g
    m, v = m / (1 - betas[0] ** step), v / (1 - betas[1] ** step)
    parameter[rows] -= rate * m / (np.sqrt(v) + 1e-8)
