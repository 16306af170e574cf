"""UTIA BRDFs (`*.bin`) as BTFs of one texel: 288 x 288 x 3 float64 without a header.

C order (channel, theta_light, phi_light, theta_view, phi_view); theta 0 to 75 in steps of 15,
phi 0 to 352.5 in steps of 7.5 degrees. Linear, sRGB primaries. At the pole all 48 azimuths are
one direction: their mean is taken, so that 241 x 241 pairs remain. Negative values are noise
around black: they are not measured.
Source: Filip and Vavra, "Template-Based Sampling of Anisotropic BRDFs", 2014; asztr/UTIA-brdf.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from btfkit import directions
from btfkit.btf import BTF
from btfkit.errors import FormatError
from btfkit.io import named
from btfkit.io.brdf import MOST, one_texel

_THETAS, _PHIS = 6, 48
_BYTES = 3 * (_THETAS * _PHIS) ** 2 * 8
_TABLE = ((0, 1, 0), *((15 * ring, _PHIS, 0) for ring in range(1, _THETAS)))


def detect(path: Path) -> bool:
    """Whether a file is named *.bin and has exactly the bytes of 288 x 288 x 3 float64."""
    return path.is_file() and path.suffix.lower() == ".bin" and path.stat().st_size == _BYTES


def read(path: Path, *, cosine: str | None = None, scale: float | None = None) -> BTF:
    """A UTIA BRDF at the directions it was measured for.

    Args:
        path: the file.
        cosine: "out" is assumed: values are f_r. "in" takes them as f_r cos.
        scale: what values are multiplied by to be f_r. 1 is assumed; readers in use disagree.

    Raises:
        FormatError: not the bytes that it needs, or no usable value.
    """
    values, record = named.assumptions(cosine=(cosine, "out"), scale=(scale, 1.0))
    if values["cosine"] not in ("in", "out"):
        raise ValueError(f"cosine {values['cosine']!r}; expected in or out")
    size = path.stat().st_size
    if size != _BYTES:
        raise FormatError(path, f"{size} bytes; expected {_BYTES}", remedy="copy it again")
    stored = np.fromfile(path, "<f8").reshape(3, _THETAS, _PHIS, _THETAS, _PHIS)
    brdf = _merged(np.moveaxis(stored, 0, -1))
    if np.isnan(brdf).mean() > 0.5:
        raise FormatError(
            path,
            f"{np.isnan(brdf).mean():.0%} of the values are negative, not finite or above {MOST:g}",
            remedy="values must be float64, little-endian",
        )
    table = directions.rings(_TABLE)
    light, view = np.repeat(table, len(table), axis=0), np.tile(table, (len(table), 1))
    quantity = np.pi * float(values["scale"]) * brdf.reshape(-1, 3)
    if values["cosine"] == "out":
        quantity = quantity * light[:, 2:]
    return one_texel(path, quantity, light, view, name="utia_brdf", said=record)


def _merged(brdf: NDArray[np.float64]) -> NDArray[np.float64]:
    """(241, 241, 3) of (6, 48, 6, 48, 3): the azimuths of the poles as one, invalid ones NaN."""
    usable = ((brdf >= 0) & (brdf < MOST)).all(axis=-1, keepdims=True)
    brdf = np.where(usable, brdf, np.nan)
    with warnings.catch_warnings():
        # A pole of which nothing is valid stays NaN.
        warnings.simplefilter("ignore", RuntimeWarning)
        lights = [np.nanmean(brdf[:1], axis=1), brdf[1:].reshape(-1, _THETAS, _PHIS, 3)]
        rows = np.concatenate(lights)
        views = [np.nanmean(rows[:, :1], axis=2), rows[:, 1:].reshape(len(rows), -1, 3)]
    return np.concatenate(views, axis=1)
