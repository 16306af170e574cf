"""A texel of a BTF as a file of the RGL database (`*.bsdf`): what `convert --as bsdf` writes.

Mitsuba's `measured` reads it in its RGB variants. Half vectors are not warped here (their density
is written as even), the grid is fine where they are near the normal; layout: `btfkit.io.rgl`.
"""

from __future__ import annotations

import os

import numpy as np

from btfkit import directions
from btfkit.btf import BTF
from btfkit.export.brdf import Floats, Progress, TexelBRDF
from btfkit.files import refuse_existing, whole
from btfkit.io import tensorfile

# Incident directions: polar angles, and azimuths where reflectance is not isotropic.
_THETAS, _PHIS = 24, 25
_HIGHEST = np.radians(89.0)


def write(
    btf: BTF,
    out: str | os.PathLike[str],
    *,
    texel: str = "mean",
    isotropic: bool = True,
    turns: int = 8,
    size: int = 64,
    force: bool = False,
    progress: Progress | None = None,
) -> None:
    """Write one texel, or the mean of all, over half vectors.

    Args:
        btf: three channels. out: the file.
        texel: "row,col", or "mean".
        isotropic: whether directions are turned about the normal and averaged; else the azimuth of
            the light is kept, in 25 steps.
        turns: azimuths that are averaged.
        size: polar angles, and azimuths, of half vectors.
        force: whether an existing file is replaced.
        progress: called with (incident directions done, all).

    Raises:
        ValueError: other channels, no such texel, or sizes without sense.
    """
    if turns < 1 or not 4 <= size <= 512:
        raise ValueError(f"turns = {turns}, size = {size}; expected 1 or more, and 4 to 512")
    refuse_existing(out, force=force)
    brdf = TexelBRDF(btf, texel, turns if isotropic else 1)
    phi = np.zeros(1) if isotropic else np.linspace(-np.pi, np.pi, _PHIS)
    theta = np.linspace(0, _HIGHEST, _THETAS)
    values = np.zeros((len(phi), len(theta), 3, size, size), np.float32)
    luminance = np.zeros((len(phi), len(theta), size, size), np.float32)
    for p, azimuth in enumerate(phi):
        for t, polar in enumerate(theta):
            light = np.asarray(directions.from_angles(polar, azimuth), np.float64)
            half, jacobian = _half_vectors(size, azimuth if isotropic else 0.0)
            across = half @ light
            view = 2 * across[:, None] * half - light
            above = (across > 0) & (view[:, 2] > 0)
            if above.any():
                lights = np.broadcast_to(light, (int(above.sum()), 3))
                found = np.zeros((size * size, 3))
                found[above] = brdf(lights, view[above]) * view[above, 2:]
                values[p, t] = found.T.reshape(3, size, size)
                shine = found.mean(axis=1) * jacobian * 4 * np.maximum(across, 0)
                luminance[p, t] = shine.reshape(size, size)
            # What is never sampled would still have to be weighed: no density is 0.
            luminance[p, t] += max(1e-3 * float(luminance[p, t].max()), 1e-6)
            if progress:
                progress(p * len(theta) + t + 1, len(phi) * len(theta))
    even = np.ones((len(phi), len(theta), 2, 2), np.float32)
    said = f"{btf.provenance.get('source', 'a BTF')}, texel {texel}, by btfkit"
    data = tensorfile.packed(
        {
            "description": np.frombuffer(said.encode()[:200], np.uint8),
            "phi_i": phi.astype(np.float32),
            "theta_i": theta.astype(np.float32),
            "ndf": np.ones((2, 2), np.float32),
            "sigma": np.ones((2, 2), np.float32),
            "vndf": even,
            "luminance": luminance,
            "rgb": values,
            "jacobian": np.zeros(1, np.uint8),
        }
    )
    with whole(out, force=force) as partial:
        partial.write_bytes(data)


def _half_vectors(size: int, azimuth: float) -> tuple[Floats, Floats]:
    """(size^2, 3) half vectors of a grid, rows azimuth, and the solid angle's share of each."""
    u = np.linspace(0, 1, size)
    theta = u**2 * np.pi / 2
    phi = (2 * u - 1) * np.pi + azimuth
    rows, cols = np.meshgrid(phi, theta, indexing="ij")
    jacobian = np.maximum(2 * np.pi**2 * u * np.sin(theta), 1e-6)
    half = np.asarray(directions.from_angles(cols.ravel(), rows.ravel()), np.float64)
    return half, np.tile(jacobian, size)
