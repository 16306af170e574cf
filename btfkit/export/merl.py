"""A texel of a BTF as a MERL BRDF (`*.binary`): what `btfkit convert --as merl` writes.

Layout and source: `btfkit.io.merl`.
"""

from __future__ import annotations

import os

import numpy as np

from btfkit import directions
from btfkit.btf import BTF
from btfkit.export.brdf import Floats, Progress, TexelBRDF
from btfkit.files import refuse_existing, whole
from btfkit.io.merl import BINS, SCALE

# What MERL's files hold where a direction is below the horizon.
_INVALID = -1.0


def write(
    btf: BTF,
    out: str | os.PathLike[str],
    *,
    texel: str = "mean",
    turns: int = 4,
    force: bool = False,
    progress: Progress | None = None,
) -> None:
    """Write one texel, or the mean of all, at the middle of every bin.

    MERL knows isotropic reflectance alone: directions are turned about the normal and averaged.

    Args:
        btf: three channels. out: the file.
        texel: "row,col", or "mean".
        turns: azimuths that are averaged.
        force: whether an existing file is replaced.
        progress: called with (bins done, bins).

    Raises:
        ValueError: other channels, or no such texel. FileExistsError: `out` is there.
    """
    if turns < 1:
        raise ValueError(f"turns = {turns}; expected 1 or more")
    refuse_existing(out, force=force)
    brdf = TexelBRDF(btf, texel, turns)
    halves, theta, phi = BINS
    planes = np.full((3, *BINS), _INVALID)
    for i in range(halves):
        light, view = pairs_of(i)
        above = (light[:, 2] > 0) & (view[:, 2] > 0)
        if above.any():
            values = np.full((theta * phi, 3), _INVALID)
            values[above] = brdf(light[above], view[above]) / SCALE
            planes[:, i] = values.T.reshape(3, theta, phi)
        if progress:
            progress((i + 1) * theta * phi, halves * theta * phi)
    with whole(out, force=force) as partial, partial.open("wb") as file:
        file.write(np.array(BINS, "<i4").tobytes())
        planes.astype("<f8").tofile(file)


def pairs_of(i: int) -> tuple[Floats, Floats]:
    """(16200, 3) lights and views in the middle of the bins of one theta_half."""
    halves, thetas, phis = BINS
    theta_half = ((i + 0.5) / halves) ** 2 * np.pi / 2
    theta, phi = np.meshgrid(
        (np.arange(thetas) + 0.5) * np.pi / 2 / thetas, (np.arange(phis) + 0.5) * np.pi / phis,
        indexing="ij",
    )  # fmt: skip
    diff = directions.from_angles(theta.ravel(), phi.ravel())
    c, s = np.cos(theta_half), np.sin(theta_half)
    light = diff @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    half = np.array([s, 0, c])
    return light, 2 * (light @ half)[:, None] * half - light
