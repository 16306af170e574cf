"""What the numbers of a picture mean, as its file declares it: curves and primaries."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit import colour

Floats = NDArray[np.floating]
Matrix = NDArray[np.float64]
Curve = Callable[[Floats], Floats]
Chromaticities = tuple[float, float, float, float, float, float, float, float]

# CIE 15:2004, 2 degrees.
D65 = (0.3127, 0.3290)
# XYZ of the white of ICC profiles, to the digit that their headers have.
_ICC_WHITE = np.array([0.9642, 1.0, 0.8249])
# Where matrices or curves are that near, they are the same, rounded by whoever wrote them.
_SAME_MATRIX, _SAME_CURVE = 2e-3, 1e-3
# Source: Lam, "Metamerism and Colour Constancy", 1985 (Bradford), as in ICC.1:2010 annex E.
_CONES = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
BT709: Chromaticities = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, *D65)
# The values are XYZ: how EXRs say so.
CIE_XYZ: Chromaticities = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3)


@final
@dataclass(frozen=True, eq=False)
class Declared:
    """What a file says that its numbers mean.

    Attributes:
        name: for records and messages.
        curves: from code values in 0..1 to linear ones, one for all channels or one each; None
            where the file does not say.
        matrix: (3, 3) from linear values to linear BT.709, D65; None where they are that.
        profile: the ICC profile, to be passed on.
        chromaticities: to be passed on where the file says it so.
    """

    name: str
    curves: tuple[Curve, ...] | None = None
    matrix: Matrix | None = None
    profile: bytes | None = None
    chromaticities: Chromaticities | None = None

    @functools.cached_property
    def srgb(self) -> bool:
        """Whether it is sRGB, however it is said."""
        x = np.linspace(0, 1, 256)
        off = [np.abs(curve(x) - colour.from_srgb(x)).max() for curve in self.curves or ()]
        return self.matrix is None and max(off, default=0) < _SAME_CURVE

    @property
    def is_xyz(self) -> bool:
        """Whether the values are CIE XYZ."""
        return self.matrix is not None and np.allclose(self.matrix, colour.XYZ_TO_RGB)

    def decoded(self, values: Floats) -> Floats:
        """(..., 3 or 1) linear BT.709 of code values in 0..1."""
        return self.converted(self._through(values, self.curves or ()))

    def converted(self, linear: Floats) -> Floats:
        """(..., 3) linear BT.709 of linear values in the file's primaries."""
        if self.matrix is None:
            return linear
        return linear @ self.matrix.T.astype(linear.dtype)

    def encoded(self, linear: Floats) -> Floats:
        """(..., 3 or 1) code values, 0..1, of linear BT.709; clipped to what they can hold."""
        inverses = tuple(_inverse(curve) for curve in self.curves or ())
        return self._through(np.clip(self.in_own_primaries(linear), 0, 1), inverses)

    def in_own_primaries(self, linear: Floats) -> Floats:
        """(..., 3 or 1) linear values in the file's primaries of linear BT.709."""
        if self.matrix is None or linear.shape[-1] != 3:
            return linear
        return linear @ np.linalg.inv(self.matrix).T.astype(linear.dtype)

    @functools.cached_property
    def is_linear(self) -> bool:
        """Whether code values are proportional to light."""
        x = np.linspace(0, 1, 256)
        return all(np.abs(curve(x) - x).max() < _SAME_CURVE for curve in self.curves or ())

    def _through(self, values: Floats, curves: tuple[Curve, ...]) -> Floats:
        if not curves:
            return values
        if len(curves) == 1:
            return curves[0](values)
        return np.stack([curve(values[..., i]) for i, curve in enumerate(curves)], axis=-1)


def _inverse(curve: Curve) -> Curve:
    """Code values of linear ones, between the steps of a table as fine as 16 bits."""
    codes = np.linspace(0, 1, 1 << 16)
    values = np.maximum.accumulate(curve(codes))
    return lambda linear: np.interp(linear, values, codes)


def gamma(exponent: float) -> Curve:
    """The curve of a power."""
    return lambda values: np.abs(values) ** exponent


def to_xyz(chromaticities: Chromaticities) -> Matrix:
    """(3, 3) from RGB to CIE XYZ, of x, y of red, green, blue and white; Y of white is 1.

    Raises:
        ValueError: primaries in one line, or no white.
    """
    xy = np.reshape(np.array(chromaticities, float), (4, 2))
    if not np.isfinite(xy).all() or abs(xy[3, 1]) < 1e-6:
        raise ValueError(f"chromaticities {chromaticities} are none")
    columns = np.column_stack([xy[:3, 0], xy[:3, 1], 1 - xy[:3].sum(axis=1)]).T
    if abs(np.linalg.det(columns)) < 1e-6:
        raise ValueError(f"chromaticities {chromaticities} lie in one line")
    return columns * np.linalg.solve(columns, _white(xy[3, 0], xy[3, 1]))


def to_d65(white: NDArray[np.float64]) -> Matrix:
    """(3, 3) from XYZ under a white (3,) to XYZ under D65 (linear Bradford)."""
    gains = (_CONES @ _white(*D65)) / (_CONES @ white)
    return np.linalg.inv(_CONES) @ (gains[:, None] * _CONES)


def from_primaries(chromaticities: Chromaticities) -> Matrix | None:
    """(3, 3) from linear RGB of these primaries to linear BT.709; None where they are that.

    White stays white: a perfect diffuser is 1, 1, 1 in both. Where the primaries are those of CIE
    XYZ itself the values are XYZ, and nothing is adapted.

    Raises:
        ValueError: no primaries.
    """
    xyz = to_xyz(chromaticities)
    if not np.allclose(chromaticities[:6], CIE_XYZ[:6], atol=1e-3):
        xyz = to_d65(_white(*chromaticities[6:])) @ xyz
    return told_apart(colour.XYZ_TO_RGB @ xyz)


def from_d50(columns: Matrix) -> Matrix | None:
    """(3, 3) to linear BT.709 from the D50 XYZ of red, green and blue, as ICC profiles hold."""
    return told_apart(colour.XYZ_TO_RGB @ to_d65(_ICC_WHITE) @ columns)


def told_apart(matrix: Matrix) -> Matrix | None:
    """`matrix`, or None where it changes nothing but the last digits."""
    return None if np.abs(matrix - np.eye(3)).max() < _SAME_MATRIX else matrix


def _white(x: float, y: float) -> NDArray[np.float64]:
    return np.array([x / y, 1.0, (1 - x - y) / y])


SRGB = Declared("sRGB", (colour.from_srgb,))
# Adobe RGB (1998) Color Image Encoding, 2005: exponent 2 + 51/256.
ADOBE_RGB = Declared(
    "Adobe RGB (EXIF)",
    (gamma(2.19921875),),
    from_primaries((0.64, 0.33, 0.21, 0.71, 0.15, 0.06, *D65)),
)
