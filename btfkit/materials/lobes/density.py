"""The distribution that lights are drawn from: a cosine lobe and a GGX lobe.

The GGX lobe reflects the view at the normals that it sees (visible normals), about a normal of its
own. What it sends below the horizon is mirrored up, so that the density over the hemisphere is
closed and integrates to 1. The least of the cosine lobe is always there.

Sources: Walter et al., "Microfacet Models for Refraction", 2007; Heitz, "Sampling the GGX
Distribution of Visible Normals", 2018; Dupuy and Benyoub, "Sampling Visible GGX Normals with
Spherical Caps", 2023; Duff et al., "Building an Orthonormal Basis, Revisited", 2017.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from btfkit.conventions import LEAST_FACING

Floats = NDArray[Any]
# Random numbers keep this far from 0 and 1: at the horizon a cosine lobe has no density.
_EDGE = 2.0**-24


class Lobe(NamedTuple):
    """Lobes at b places.

    Attributes:
        slope: (b, 2) dz/dx, dz/dy of the surface that the GGX lobe is about.
        alpha: (b,) its roughness.
        share, grazing: (b,) how much of the samples it gets, of a view along its normal and of
            one that grazes, between them as Schlick's Fresnel term goes.
    """

    slope: Floats
    alpha: Floats
    share: Floats
    grazing: Floats


def normal(lobe: Lobe) -> Floats:
    """(b, 3) unit vectors."""
    x, y = -lobe.slope[:, 0], -lobe.slope[:, 1]
    length = np.sqrt(1 + x * x + y * y)
    return np.stack([x, y, np.ones_like(x)], axis=1) / length[:, None]


def basis(n: Floats) -> tuple[Floats, Floats]:
    """Two unit vectors (b, 3) across n (b, 3), n.z > 0."""
    a = -1 / (1 + n[:, 2])
    b = n[:, 0] * n[:, 1] * a
    return (
        np.stack([1 + n[:, 0] ** 2 * a, b, -n[:, 0]], axis=1),
        np.stack([b, 1 + n[:, 1] ** 2 * a, -n[:, 1]], axis=1),
    )


def shares(lobe: Lobe, facing: Floats) -> Floats:
    """(b,) how much of the samples the GGX lobe gets; facing is view x normal."""
    schlick = (1 - np.clip(facing, 0, 1)) ** 5
    found = lobe.share + (lobe.grazing - lobe.share) * schlick
    return np.where(facing > LEAST_FACING, found, 0)


def draw(lobe: Lobe, view: Floats, numbers: Floats) -> Floats:
    """(b, 3) lights.

    Args:
        view: (b, 3) unit vectors above the horizon.
        numbers: (b, 3) in 0..1: which lobe, and where in it; or (b, 2), of which the first
            chooses, and what is left of it is stretched.
    """
    n = normal(lobe)
    share = shares(lobe, (view * n).sum(axis=1))
    pick, *places = np.asarray(numbers, float).T
    glossily = pick < share
    if len(places) == 1:
        rest = np.where(glossily, pick / np.maximum(share, _EDGE), (pick - share) / (1 - share))
        places = [rest, *places]
    first, second = np.clip(places, _EDGE, 1 - _EDGE)
    radius, angle = np.sqrt(first), 2 * np.pi * second
    cosine = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - first)], axis=1)
    glossy = reflected(n, lobe.alpha, view, first, angle)
    glossy[:, 2] = np.abs(glossy[:, 2])
    return np.where(glossily[:, None], glossy, cosine)


def reflected(n: Floats, alpha: Floats, view: Floats, number: Floats, angle: Floats) -> Floats:
    """(b, 3) views reflected at normals that they see of a GGX surface about n."""
    t, b = basis(n)
    x, y, z = (np.einsum("ij,ij->i", view, axis) for axis in (t, b, n))
    z = np.maximum(z, LEAST_FACING)
    x, y = alpha * x, alpha * y
    length = np.sqrt(x * x + y * y + z * z)
    x, y, z = x / length, y / length, z / length
    up = (1 - number) * (1 + z) - z
    aside = np.sqrt(np.maximum(1 - up * up, 0))
    x, y = alpha * (x + aside * np.cos(angle)), alpha * (y + aside * np.sin(angle))
    z = np.maximum(z + up, 1e-9)
    half = x[:, None] * t + y[:, None] * b + z[:, None] * n
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    return 2 * (view * half).sum(axis=1, keepdims=True) * half - view


def pdf(lobe: Lobe, light: Floats, view: Floats) -> Floats:
    """(b,) density of lights over solid angle; 0 below the horizon.

    Args:
        light, view: (b, 3) unit vectors.
    """
    n = normal(lobe)
    facing = (view * n).sum(axis=1)
    share = shares(lobe, facing)
    below = light * [1, 1, -1]
    gloss = glossy_pdf(n, lobe.alpha, light, view) + glossy_pdf(n, lobe.alpha, below, view)
    found = (1 - share) * np.maximum(light[:, 2], 0) / np.pi + share * gloss
    return np.where(light[:, 2] > 0, found, 0)


def glossy_pdf(n: Floats, alpha: Floats, light: Floats, view: Floats) -> Floats:
    """(b,) density of the GGX lobe alone, over the whole sphere."""
    half = light + view
    length = np.sqrt((half * half).sum(axis=1))
    half = half / np.maximum(length, 1e-9)[:, None]
    up = (half * n).sum(axis=1)
    # 1 - up^2 without cancellation.
    aside = np.square(np.cross(half, n)).sum(axis=1)
    facing = np.maximum((view * n).sum(axis=1), LEAST_FACING)
    square = alpha * alpha
    known = length > 1e-9
    spread = square / (np.pi * np.square(np.where(known, up * up * square + aside, 1)))
    mask = 2 * (facing + np.sqrt(square + (1 - square) * facing * facing))
    return np.where((up > 0) & known, spread / mask, 0)
