"""Light from everywhere: a picture of the surroundings by azimuth and elevation."""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]


@final
class Environment:
    """Radiance by direction, sampled by its brightness.

    y is up: row 0 is +y, the middle column -z (behind the object), as of a camera that looks from
    the viewer into the scene; the columns run from there to +x.

    Args:
        radiance: (h, w, c) linear, not negative.

    Raises:
        ValueError: negative or not finite values, or no light at all.
    """

    def __init__(self, radiance: NDArray[np.floating]) -> None:
        values = np.asarray(radiance, float)
        if not np.isfinite(values).all() or values.min() < 0:
            raise ValueError("an environment's radiance must be finite and not negative")
        self.radiance = values
        h, w, _ = values.shape
        polar = (np.arange(h) + 0.5) / h * np.pi
        weight = values.mean(axis=2) * np.sin(polar)[:, None]
        total = weight.sum()
        if not total > 0:
            raise ValueError("the environment is black")
        self._row = np.cumsum(weight.sum(axis=1)) / total
        rows = weight.sum(axis=1, keepdims=True)
        even = np.arange(1, w + 1) / w
        self._column = np.where(
            rows > 0, np.cumsum(weight, axis=1) / np.where(rows > 0, rows, 1), even
        )
        self._chance = weight / total

    def sample(self, square: Floats, out: Floats) -> tuple[Floats, Floats]:
        """One direction (m, 3) for each pair of even numbers, and the weight (m, c) of its light.

        The mean of weight x reflectance is the light that leaves towards the eye.
        """
        h, w, _ = self.radiance.shape
        row = np.minimum(np.searchsorted(self._row, square[:, 0], side="right"), h - 1)
        before = np.where(row > 0, self._row[row - 1], 0.0)
        share = np.maximum(self._row[row] - before, 1e-300)
        within = np.clip((square[:, 0] - before) / share, 0, 1)
        column = np.minimum((self._column[row] < square[:, 1:]).sum(axis=1), w - 1)
        left = np.where(column > 0, self._column[row, column - 1], 0.0)
        width = np.maximum(self._column[row, column] - left, 1e-300)
        across = np.clip((square[:, 1] - left) / width, 0, 1)
        polar = (row + within) / h * np.pi
        azimuth = (column + across) / w * 2 * np.pi
        chance = self._chance[row, column]
        solid = np.sin(polar) * (np.pi / h) * (2 * np.pi / w)
        weight = self.radiance[row, column] * (solid / np.maximum(chance, 1e-300))[:, None] / np.pi
        sin = np.sin(polar)
        # Column 0 is behind the viewer: +z.
        light = np.stack([-sin * np.sin(azimuth), np.cos(polar), sin * np.cos(azimuth)], axis=1)
        return light, weight
