"""Light from everywhere: a picture of the surroundings by azimuth and elevation."""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit.shapes.closed import Floats


@final
class Environment:
    """Radiance by direction, constant within a pixel of the picture.

    y is up: row 0 looks along +y. The middle column looks along -z, past the object as the viewer
    at 0,0 sees it, and columns run on towards +x: what is right in the picture is at the right.

    Args:
        radiance: (h, w, c) linear, finite, not negative.
        turn: by which the surroundings are turned about y, from -z towards +x, radians.

    Raises:
        ValueError: negative or not finite values, or no light at all.
    """

    def __init__(self, radiance: NDArray[np.floating], *, turn: float = 0.0) -> None:
        self._radiance = np.asarray(radiance, float)
        if not np.isfinite(self._radiance).all() or self._radiance.min() < 0:
            raise ValueError("the radiance of an environment must be finite and not negative")
        self._turn = turn
        self._size = h, w = self._radiance.shape[:2]
        edges = np.cos(np.arange(h + 1) / h * np.pi)
        self._solid = (edges[:-1] - edges[1:]) * (2 * np.pi / w)
        power = self._radiance.mean(axis=2) * self._solid[:, None]
        if not power.sum() > 0:
            raise ValueError("the environment is black")
        self._chance = power / power.sum()
        # One running sum over all pixels; that of whole rows is a part of it.
        self._sum = np.cumsum(self._chance)
        self._rows = np.concatenate([[0.0], self._sum[w - 1 :: w]])

    def sample(self, square: Floats, normal: Floats) -> tuple[Floats, Floats]:
        """One direction (m, 3) for each pair of even numbers, and the weight (m, c) of its light.

        The mean of weight x reflectance is the light that leaves towards the eye. Half of the
        directions follow the brightness, half the cosine with the normal, and each is weighed by
        the chance that either gives it.

        Args:
            square: (m, 2) even numbers in 0..1. normal: (m, 3) unit vectors, object frame.

        Source: Veach, "Robust Monte Carlo Methods for Light Transport Simulation", 1997,
        section 9.2 (balance heuristic, one sample).
        """
        bright = square[:, 0] < 0.5
        even = np.stack([2 * square[:, 0] % 1, square[:, 1]], axis=1)
        light = np.where(bright[:, None], self._by_brightness(even), _by_cosine(even, normal))
        row, column = self._pixel(light)
        density = self._chance[row, column] / self._solid[row]
        cosine = np.maximum(np.einsum("ij,ij->i", light, normal), 0)
        # Either strategy alone gives a positive density to what it drew.
        mixed = np.maximum((density + cosine / np.pi) / 2, 1e-300)
        return light, self._radiance[row, column] / (np.pi * mixed)[:, None]

    def radiance(self, direction: Floats) -> Floats:
        """Radiance (m, c) that comes from directions (m, 3)."""
        return self._radiance[self._pixel(direction)]

    def _by_brightness(self, square: Floats) -> Floats:
        h, w = self._size
        row = np.clip(np.searchsorted(self._rows, square[:, 0], side="right") - 1, 0, h - 1)
        share = self._rows[row + 1] - self._rows[row]
        # A row without light is never drawn but at the very end of the sum.
        within = np.clip((square[:, 0] - self._rows[row]) / np.maximum(share, 1e-300), 0, 1)
        target = self._rows[row] + square[:, 1] * share
        pixel = np.searchsorted(self._sum, target, side="right")
        pixel = np.clip(pixel, row * w, row * w + w - 1)
        column, chance = pixel - row * w, self._chance.reshape(-1)[pixel]
        left = self._sum[pixel] - chance
        across = np.clip((target - left) / np.maximum(chance, 1e-300), 0, 1)
        top, bottom = np.cos(np.pi * row / h), np.cos(np.pi * (row + 1) / h)
        y = top + within * (bottom - top)
        azimuth = (column + across) / w * 2 * np.pi + self._turn
        sin = np.sqrt(np.maximum(1 - y**2, 0))
        return np.stack([-sin * np.sin(azimuth), y, sin * np.cos(azimuth)], axis=1)

    def _pixel(self, direction: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        h, w = self._size
        x, y, z = direction.T
        azimuth = np.arctan2(-x, z) - self._turn
        column = (azimuth / (2 * np.pi) % 1 * w).astype(np.intp)
        row = (np.arccos(np.clip(y, -1, 1)) / np.pi * h).astype(np.intp)
        return np.minimum(row, h - 1), np.minimum(column, w - 1)


def _by_cosine(square: Floats, normal: Floats) -> Floats:
    """Directions (m, 3) about normals, as dense as their cosine. Source: Malley's method."""
    radius, angle = np.sqrt(square[:, 0]), 2 * np.pi * square[:, 1]
    local = [radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - square[:, 0])]
    # A tangent from the axis that the normal is farthest from.
    axis = np.eye(3)[np.abs(normal).argmin(axis=1)]
    tangent = np.cross(normal, axis)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    frame = (tangent, np.cross(normal, tangent), normal)
    return sum((a[:, None] * b for a, b in zip(local, frame, strict=True)), np.zeros(3))
