"""Colour: what code values mean, and what linear RGB is made of."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]

# IEC 61966-2-1 primaries and D65 white: CIE XYZ (2 degrees, Y of white = 1) to linear BT.709.
XYZ_TO_RGB = np.array(
    [
        [3.2404541621, -1.5371385128, -0.4985314096],
        [-0.9692660305, 1.8760108454, 0.0415560175],
        [0.0556434310, -0.2040259135, 1.0572251882],
    ]
)
TRANSFERS = ("srgb", "linear", "2.2")


def from_srgb(encoded: Floats) -> Floats:
    """Linear values of sRGB encoded ones; negative and above 1 by the same formula, mirrored."""
    x = np.abs(encoded)
    linear = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
    return np.copysign(linear, encoded)


def to_srgb(linear: Floats) -> Floats:
    """sRGB encoded values of linear ones; negative and above 1 by the same formula, mirrored."""
    x = np.abs(linear)
    encoded = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-8) ** (1 / 2.4) - 0.055)
    return np.copysign(encoded, linear)


def xyz_to_rgb(xyz: Floats) -> Floats:
    """Linear BT.709 RGB (..., 3) of CIE XYZ (..., 3) under D65."""
    return xyz @ XYZ_TO_RGB.T.astype(xyz.dtype)


def rgb_to_xyz(rgb: Floats) -> Floats:
    """CIE XYZ (..., 3) of linear BT.709 RGB (..., 3)."""
    return rgb @ np.linalg.inv(XYZ_TO_RGB).T.astype(rgb.dtype)


def decode(transfer: str, values: Floats) -> Floats:
    """Linear values of encoded ones in 0..1.

    Raises:
        ValueError: no such transfer.
    """
    if transfer == "srgb":
        return from_srgb(values)
    if transfer == "linear":
        return values
    try:
        gamma = float(transfer)
    except ValueError:
        gamma = 0.0
    if not 0.1 <= gamma <= 10:
        raise ValueError(f"transfer {transfer!r}; expected srgb, linear or an exponent like 2.2")
    return np.copysign(np.abs(values) ** gamma, values)


@functools.lru_cache(maxsize=16)
def table(transfer: str, bits: int) -> NDArray[np.float32]:
    """(2^bits,) linear float32 of every code value of 8- or 16-bit pixels."""
    codes = np.arange(1 << bits) / ((1 << bits) - 1)
    values = decode(transfer, codes).astype(np.float32)
    values.flags.writeable = False
    return values
