"""A mesh as triangles, however its file wrote it."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from btfkit.errors import FormatError

Floats = NDArray[np.floating]
COUNTS = {"v": 3, "vt": 2, "vn": 3}
MOST_BYTES, MOST_TRIANGLES = 1 << 30, 1 << 22
_MOST_VALUE = 1e30


class Triangles(NamedTuple):
    """A mesh: f triangles, corners counter-clockwise as seen from outside.

    Attributes:
        corner: (f, 3, 3) positions. uv: (f, 3, 2) u right, v up, as mesh files have them.
        normal: (f, 3, 3) unit normals; that of the face where none was given.
    """

    corner: Floats
    uv: Floats
    normal: Floats


def gathered(path: Path, tables: Mapping[str, Floats], faces: NDArray[np.intp]) -> Triangles:
    """Triangles by the indices of their corners; those without area are left out.

    Args:
        path: what errors name.
        tables: "v" (., 3), "vt" (., 2) and "vn" (., 3).
        faces: (f, 3, 3) indices of v, vt, vn of each corner; -1 for none.

    Raises:
        FormatError: corners without texture coordinates, indices of nothing, values that are no
            numbers, or no area.
    """
    if (faces[..., 1] < 0).any():
        missing = int((faces[..., 1] < 0).any(axis=1).sum())
        raise FormatError(
            path,
            f"{missing} of {len(faces)} triangles have no texture coordinates",
            remedy="unwrap the mesh and export it again",
        )
    values = {}
    for column, (name, count) in enumerate(COUNTS.items()):
        table = tables[name]
        last = int(faces[..., column].max())
        if last >= len(table):
            raise FormatError(path, f"a face names {name} {last + 1}; there are {len(table)}")
        used = table[np.unique(faces[..., column][faces[..., column] >= 0])]
        if name != "vn" and not (np.abs(used) < _MOST_VALUE).all():
            raise FormatError(path, f"{name} holds values that are not finite or beyond 1e30")
        # Without normals every index is -1, and what it picks is replaced below.
        values[name] = (table if len(table) else np.zeros((1, count)))[faces[..., column]]
    corner, normal = values["v"], values["vn"]
    flat = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = np.linalg.norm(flat, axis=1)
    whole = area > 1e-14 * np.ptp(corner.reshape(-1, 3), axis=0).max() ** 2
    if not whole.any():
        raise FormatError(path, "no triangle has an area")
    if _covered(values["vt"][whole]) == 0:
        warnings.warn(
            f"{path}: the texture coordinates of every triangle lie on a point or a line: each "
            "shows one texel; unwrap the mesh and export it again",
            stacklevel=4,
        )
    with np.errstate(over="ignore"):
        length = np.linalg.norm(normal, axis=2)
    own = (faces[..., 2] < 0) | ~((length >= 1e-12) & (length < _MOST_VALUE))
    unit = normal / np.where(own, 1.0, length)[..., None]
    unit = np.where(own[..., None], (flat / np.where(whole, area, 1.0)[:, None])[:, None], unit)
    return Triangles(corner[whole], values["vt"][whole], unit[whole])


def _covered(uv: Floats) -> float:
    """Area that triangles (f, 3, 2) cover of the texture, each for itself."""
    (u1, v1), (u2, v2) = (np.moveaxis(uv[:, k] - uv[:, 0], -1, 0) for k in (1, 2))
    return float(np.abs(u1 * v2 - u2 * v1).sum())
