"""Lamps and cameras so near that every texel sees them in a direction of its own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit import directions
from btfkit.directions import Floats
from btfkit.materials.measured.triangulation import DirectionMesh

Array = NDArray[np.float32]
# Solving for the equivalent direction converges by texel size / distance to the lamp each time.
_STEPS = 6


@final
@dataclass(frozen=True, eq=False)
class Near:
    """Lamps or cameras at finite distance: texels see them in directions of their own.

    Attributes:
        position: (n, 3) mm from the centre of the sample, a row for each pair.
        mesh: of their distinct directions from the centre.
        distance: (m,) mm from the centre.
    """

    position: Array
    mesh: DirectionMesh
    distance: Floats

    @staticmethod
    def of(position: NDArray[np.floating] | None) -> Near | None:
        """From (n, 3) positions in mm from the centre; None stays None."""
        if position is None:
            return None
        above = position[position[:, 2] >= 0]
        unit = directions.normalize(above).astype(np.float32)
        table, which = directions.unique(unit)
        _, first = np.unique(which, return_index=True)
        return Near(
            np.asarray(position, np.float32),
            DirectionMesh(table),
            np.linalg.norm(above[first].astype(float), axis=1),
        )

    def from_centre(self, direction: Array, at: NDArray[np.floating]) -> Array:
        """The direction in which the centre sees what a texel sees along `direction`.

        The lamps lie on a surface around the sample, between them at a distance blended from
        theirs; where the texel's ray meets it, the centre looks. Exact at every lamp.

        Args:
            direction: (b, 3) unit vectors from the texels. at: (b, 2) texels, mm.

        Returns:
            (b, 3) unit vectors.
        """
        along = direction.astype(float)
        foot = np.concatenate([at, np.zeros((len(at), 1))], axis=1)
        across = np.sum(foot * along, axis=1)
        seen = along
        for _ in range(_STEPS):
            row, weight = self.mesh.weights(seen)
            reach = np.sum(self.distance[row] * weight, axis=1)
            inside = np.square(across) + np.square(reach) - np.sum(np.square(foot), axis=1)
            way = np.sqrt(np.maximum(inside, 0)) - across
            seen = directions.normalize(foot + np.maximum(way, 1e-9)[:, None] * along)
            seen[:, 2] = np.maximum(seen[:, 2], 0)
        return seen.astype(np.float32)
