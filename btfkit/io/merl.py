"""MERL BRDFs (`*.binary`) as BTFs of one texel.

    int32 x 3                90, 90, 180: bins of theta_half, theta_diff, phi_diff
    float64 x 3 x 1458000    red, green and blue planes, phi_diff fastest

theta_half is spaced by its square root. Values are f_r / scale; negative ones are invalid.
Source: Matusik et al., "A Data-Driven Reflectance Model", 2003, and their BRDFRead.cpp.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from btfkit import directions
from btfkit.btf import BTF
from btfkit.errors import FormatError
from btfkit.io import brdf, named

BINS = (90, 90, 180)
SCALE = np.array([1.0, 1.15, 1.66]) / 1500


def detect(path: Path) -> bool:
    """Whether a file starts with MERL's numbers of bins, or is named *.binary."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        start = file.read(8)
    return start == np.array(BINS[:2], "<i4").tobytes() or path.suffix.lower() == ".binary"


def read(path: Path, *, sampling: str | None = None) -> BTF:
    """A MERL BRDF, looked up bin by bin under every light and view of a table of directions.

    Args:
        path: the file.
        sampling: "bonn81" (default: 6561 pairs up to 75 degrees) or "bonn151" (22801 pairs).

    Raises:
        FormatError: other numbers of bins, or not the bytes they need.
    """
    values, record = named.assumptions(sampling=(sampling, "bonn81"))
    light, view = brdf.pairs_of(values["sampling"])
    quantity = np.pi * lookup(_planes(path), light, view) * light[:, 2:]
    return brdf.one_texel(path, quantity, light, view, name="merl", said=record)


def lookup(
    planes: NDArray[np.float64], light: NDArray[np.floating], view: NDArray[np.floating]
) -> NDArray[np.float64]:
    """BRDF values of direction pairs: the bin they fall in, as the publisher's reader does.

    Args:
        planes: (3, 90, 90, 180) stored values.
        light, view: (n, 3) unit vectors.

    Returns:
        (n, 3) f_r; NaN where a channel is invalid.
    """
    half, diff = directions.half_difference(light, view)
    theta_half, _ = directions.to_angles(half)
    theta_diff, phi_diff = directions.to_angles(diff)
    # Rounding: an angle on the border of two bins belongs to the upper one.
    nudge = 1e-9
    i = np.sqrt(theta_half / (np.pi / 2)) * 90 + nudge
    j = theta_diff / (np.pi / 2) * 90 + nudge
    k = (phi_diff % np.pi) / np.pi * 180 + nudge
    index = tuple(
        np.clip(bins.astype(int), 0, size - 1) for bins, size in zip((i, j, k), BINS, strict=True)
    )
    found = np.moveaxis(planes[(slice(None), *index)], 0, -1) * SCALE
    invalid = ~((found >= 0) & (found < brdf.MOST)).all(axis=-1)
    found[invalid] = np.nan
    return found


def _planes(path: Path) -> NDArray[np.float64]:
    size = path.stat().st_size
    with path.open("rb") as file:
        start = file.read(12)
    bins = tuple(np.frombuffer(start, "<i4").tolist()) if len(start) == 12 else ()
    if bins != BINS:
        raise FormatError(
            path, f"bins {bins}; expected {BINS}", remedy="only the isotropic form is read"
        )
    expected = 12 + 3 * 8 * int(np.prod(BINS))
    if size != expected:
        raise FormatError(path, f"{size} bytes; expected {expected}", remedy="copy it again")
    return np.memmap(path, "<f8", "r", 12, (3, *BINS))
