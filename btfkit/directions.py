"""Directions over a flat sample, and the one place that knows rows run against y.

Surface frame: right-handed, x right (image columns), y up, z out of the sample.
`light` and `view` are unit vectors that point away from the surface.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.floating]

# theta (deg), number of azimuths, azimuth of the first (deg)
_BONN81 = ((0, 1, 0), (15, 6, 0), (30, 12, 0), (45, 18, 0), (60, 20, 0), (75, 24, 0))
_BONN151 = (
    (0, 1, 0),
    (11, 6, 15),
    (23.5, 12, 0),
    (30, 12, 15),
    (37.5, 12, 0),
    (45, 18, 0),
    (52.5, 18, 7.5),
    (60, 24, 0),
    (67.5, 24, 7.5),
    (75, 24, 0),
)


def from_angles(theta: ArrayLike, phi: ArrayLike) -> Floats:
    """Unit vectors from polar angle and azimuth.

    Args:
        theta: (...) angle from the normal, radians.
        phi: (...) angle from +x towards +y, radians.

    Returns:
        (..., 3) unit vectors, float64.
    """
    theta, phi = np.broadcast_arrays(np.asarray(theta, float), np.asarray(phi, float))
    sin_theta = np.sin(theta)
    return np.stack([sin_theta * np.cos(phi), sin_theta * np.sin(phi), np.cos(theta)], axis=-1)


def to_angles(direction: ArrayLike) -> tuple[Floats, Floats]:
    """Polar angle and azimuth of unit vectors, exact at the pole and at the horizon.

    Args:
        direction: (..., 3) vectors of any length but zero.

    Returns:
        theta: (...) angle from the normal, radians, 0 to pi.
        phi: (...) azimuth, radians, 0 to 2 pi; 0 at the pole.
    """
    x, y, z = np.moveaxis(np.asarray(direction, float), -1, 0)
    tangential = np.hypot(x, y)
    phi = np.arctan2(y, x) % (2 * np.pi)
    # The remainder of -1e-16 rounds to a whole turn.
    phi = np.where((tangential > 0) & (phi < 2 * np.pi), phi, 0.0)
    return np.arctan2(tangential, z), phi


def rings(table: Sequence[tuple[float, int, float]]) -> Floats:
    """Directions on rings of constant polar angle.

    Args:
        table: (polar angle in degrees, number of azimuths, first azimuth in degrees) a ring.

    Returns:
        (n, 3) unit vectors, ring by ring, azimuth ascending.
    """
    theta = np.concatenate([np.full(n, t, float) for t, n, _ in table])
    phi = np.concatenate([first + 360 * np.arange(n) / n for _, n, first in table])
    return from_angles(np.radians(theta), np.radians(phi))


def bonn81() -> Floats:
    """(81, 3) directions of UBO2003, ATRIUM and most UTIA samples, in their order."""
    return rings(_BONN81)


def bonn151() -> Floats:
    """(151, 3) directions of Bonn's Dome 1 (UBO2014), in their order."""
    return rings(_BONN151)


def normalize(vector: ArrayLike) -> Floats:
    """Vectors scaled to length one; a zero or non-finite vector stays as it is.

    Args:
        vector: (..., 3) vectors.

    Returns:
        (..., 3) float64.
    """
    vector = np.asarray(vector, float)
    # Scale first: squares of 1e-200 and 1e200 leave the range of float64.
    scale = np.max(np.abs(vector), axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        scaled = vector / scale
        unit = scaled / np.linalg.norm(scaled, axis=-1, keepdims=True)
    return np.where(np.isfinite(scale) & (scale > 0), unit, vector)


def checked(name: str, direction: ArrayLike, *, upper: bool) -> NDArray[np.float32]:
    """Directions from outside, normalised; refused where they cannot be directions.

    Args:
        name: what messages call the array.
        direction: (n, 3) vectors away from the surface, of any positive length.
        upper: whether directions below the surface are refused; rounding below is lifted to 0.

    Returns:
        (n, 3) float32 unit vectors.

    Raises:
        ValueError: wrong shape, a non-finite or zero vector, or one below the surface.
    """
    dirs = np.asarray(direction, float)
    if dirs.ndim != 2 or dirs.shape[1] != 3:
        raise ValueError(f"{name} has shape {dirs.shape}; expected (n, 3)")
    length = np.max(np.abs(dirs), axis=1, initial=0.0)
    bad = np.flatnonzero(~np.isfinite(length) | (length < 1e-30))
    if bad.size:
        raise ValueError(f"{name}[{bad[0]}] = {dirs[bad[0]].tolist()} is not a direction")
    unit = normalize(dirs)
    if upper:
        low = np.flatnonzero(unit[:, 2] < -1e-6)
        if low.size:
            at = low[0]
            raise ValueError(f"{name}[{at}] = {dirs[at].tolist()} points below the surface (z < 0)")
        unit[:, 2] = np.maximum(unit[:, 2], 0)
    return unit.astype(np.float32)


def rotation(start: Floats, end: Floats) -> Floats:
    """(m, 3, 3) rotations that take unit vectors (m, 3) to others by the shortest way.

    Towards the opposite vector there is no shortest way; what is answered there is no rotation.

    Source: Rodrigues' formula without angles.
    """
    axis = np.cross(start, end)
    cosine = np.einsum("ij,ij->i", start, end)
    cross = np.zeros((len(axis), 3, 3))
    cross[:, [2, 0, 1], [1, 2, 0]] = axis
    cross[:, [1, 2, 0], [2, 0, 1]] = -axis
    share = 1 / np.maximum(1 + cosine, 1e-6)
    return np.eye(3) + cross + share[:, None, None] * (cross @ cross)


def half_difference(light: ArrayLike, view: ArrayLike) -> tuple[Floats, Floats]:
    """Half vector and difference vector of a direction pair.

    Where light = -view there is no half vector: (0, 0, 1) is taken.

    Args:
        light: (..., 3) unit vectors towards the light, surface frame.
        view: (..., 3) unit vectors towards the viewer, surface frame.

    Returns:
        half: (..., 3) unit bisector of `light` and `view`.
        diff: (..., 3) `light` seen in the frame where `half` is +z.

    Source: Rusinkiewicz, "A New Change of Variables for Efficient BRDF
    Representation", 1998, section 3.
    """
    light, view = np.asarray(light, float), np.asarray(view, float)
    total = light + view
    opposite = np.linalg.norm(total, axis=-1, keepdims=True) < 1e-12
    half = np.where(opposite, [0.0, 0.0, 1.0], normalize(total))
    tangential = np.hypot(half[..., 0], half[..., 1])
    pole = tangential < 1e-12
    safe = np.where(pole, 1.0, tangential)
    cos_phi = np.where(pole, 1.0, half[..., 0] / safe)
    sin_phi = np.where(pole, 0.0, half[..., 1] / safe)
    # Turn about z by -phi, then about y by -theta.
    along = cos_phi * light[..., 0] + sin_phi * light[..., 1]
    across = -sin_phi * light[..., 0] + cos_phi * light[..., 1]
    cos_theta = half[..., 2]
    x = cos_theta * along - tangential * light[..., 2]
    z = tangential * along + cos_theta * light[..., 2]
    return half, np.stack([x, across, z], axis=-1)


def uv_from_surface(displacement: ArrayLike, *, aspect: float) -> Floats:
    """Step in uv for a step on the surface. v runs down the rows, y up.

    Args:
        displacement: (..., 2) step along x and y, in tile widths.
        aspect: tile width / tile height.

    Returns:
        (..., 2) step in u (tile widths) and v (tile heights).
    """
    return np.asarray(displacement) * np.asarray([1.0, -aspect], np.float32)


def surface_from_uv(step: ArrayLike, *, aspect: float) -> Floats:
    """Step on the surface for a step in uv: the inverse of `uv_from_surface`.

    Args:
        step: (..., 2) step in u (tile widths) and v (tile heights).
        aspect: tile width / tile height.

    Returns:
        (..., 2) step along x and y, in tile widths.
    """
    return np.asarray(step) * np.asarray([1.0, -1.0 / aspect], np.float32)


def unique(direction: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Distinct directions in the order of their first appearance.

    Args:
        direction: (n, 3) unit vectors; equal to 1e-5 counts as the same direction.

    Returns:
        table: (m, 3) the distinct ones.
        index: (n,) row of `table` that each direction is.
    """
    key = np.round(direction.astype(np.float64) * 1e5).astype(np.int64)
    _, first, inverse = np.unique(key, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return direction[first[order]], rank[inverse.reshape(-1)]
