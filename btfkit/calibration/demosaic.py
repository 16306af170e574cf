"""Colours between the pixels of a mosaic, after merging: linear filters and their variance.

The best linear estimate of a colour from the samples of all three around it: pictures whose detail
fades with distance, seen through pixel and lens, in colours that are alike but not the same. Where
a sample under the filter says nothing, the mean of those neighbours that do stands in: a saturated
pixel does not spread over 7 x 7.

Source: Trussell and Hartwell, "Mathematics for demosaicking", 2002 (the linear estimate of least
square error); Cressie, "Statistics for Spatial Data", 1993, section 3.2 (the same with unknown
means: ordinary kriging).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from btfkit.calibration.merge import SATURATED, Merged

Array = NDArray[np.float32]
CFAS = ("RGGB", "BGGR", "GRBG", "GBRG")
# What is assumed of pictures: correlation of two colours; distance over which one fades to 1/e,
# blur of the lens and noise (variances of each colour are 1). On the twin's cloth of two colours
# texels differ by 0.3 dB for 0.85 to 0.95, 3 to 8 px, 0.1 to 0.5 px^2; grey gravel would have 0.99.
_ALIKE, _RANGE_PX, _BLUR_PX2, _NOISE = 0.93, 8.0, 0.25, 1e-3
_REACH = 3
_SIDE = 2 * _REACH + 1
_NEAR = np.array([[0.25, 0.5, 0.25], [0.5, 1, 0.5], [0.25, 0.5, 0.25]])


def demosaic(merged: Merged, cfa: str, *, balance: ArrayLike = (1.0, 1.0, 1.0)) -> Merged:
    """Three colours at every pixel of a merged mosaic.

    Args:
        merged: (h, w) of a Bayer mosaic.
        cfa: colours of the first 2 x 2 pixels, row by row.
        balance: (3,) counts of a white surface: the filter reads detail from the other colours,
            which must be of like size for it.

    Returns:
        (h, w, 3) in the counts of each colour; NaN, as before, where a pixel saturates. A dead
        pixel takes what its neighbours say. The variance is of each colour by itself.

    Raises:
        ValueError: no such mosaic.
    """
    colours = colours_of(merged, cfa, balance=balance)
    white = np.asarray(balance, np.float32)
    colour = sites(cfa, merged.radiance.shape)
    known = np.isfinite(merged.radiance)
    variance = np.where(known, merged.variance, 0) / white[colour] ** 2
    spread = _estimated(variance, cfa, power=2)
    holes = _beside_unknown(known)
    if holes is not None:
        for c in range(3):
            own = known & (colour == c)
            other = holes & ~own
            spread[other, c] = _neighbours(variance, own, power=2)[other]
    spread *= white**2
    lost = np.isnan(colours)
    validity = np.repeat(merged.validity[..., None], 3, axis=2)
    with np.errstate(invalid="ignore"):
        below = colours * np.abs(colours) < spread
    validity = np.where(lost, np.maximum(validity, SATURATED), below).astype(np.uint8)
    return Merged(colours, np.where(lost, np.inf, spread), validity)


def colours_of(merged: Merged, cfa: str, *, balance: ArrayLike = (1.0, 1.0, 1.0)) -> Array:
    """(h, w, 3) as `demosaic`, without variance; arguments and errors are the same."""
    if cfa not in CFAS:
        raise ValueError(f"mosaic {cfa!r}; expected one of {', '.join(CFAS)}")
    white = np.asarray(balance, np.float32)
    colour = sites(cfa, merged.radiance.shape)
    known = np.isfinite(merged.radiance)
    value = (1 / white)[colour]
    value *= merged.radiance
    value[~known] = 0
    out = _estimated(value, cfa)
    holes = _beside_unknown(known)
    if holes is not None:
        for c in range(3):
            own = known & (colour == c)
            other = holes & ~own
            out[other, c] = _neighbours(value, own)[other]
        out[(merged.validity == SATURATED) | ~np.isfinite(out).all(axis=-1)] = np.nan
    out *= white
    return out


def sites(cfa: str, shape: tuple[int, ...]) -> NDArray[np.intp]:
    """(h, w) channel that each pixel of a mosaic sees: 0 red, 1 green, 2 blue."""
    tile = np.array(["RGB".index(letter) for letter in cfa]).reshape(2, 2)
    return np.tile(tile, (shape[0] // 2 + 1, shape[1] // 2 + 1))[: shape[0], : shape[1]]


def _estimated(plane: Any, cfa: str, *, power: int = 1) -> Array:
    """(h, w, 3) by the filters' weights to a power; right where all samples under them are."""
    found = {name: _filtered(plane, kernel**power) for name, kernel in kernels().items()}
    tile = sites(cfa, (2, 2))
    out = np.empty((*plane.shape, 3), np.float32)
    for row in range(2):
        for col in range(2):
            at = (slice(row, None, 2), slice(col, None, 2))
            own = int(tile[row, col])
            out[(*at, own)] = plane[at]
            for c in {0, 1, 2} - {own}:
                name = "diagonal"
                if c == 1:
                    name = "cross"
                elif own == 1:
                    # Red and blue lie along the row of a green pixel, or along its column.
                    name = "row" if c in tile[row] else "column"
                out[(*at, c)] = found[name][at]
    return out


def _beside_unknown(known: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
    """(h, w) where a filter would mix nothing into its result; None where all is known."""
    if known.all():
        return None
    seen = _filtered(known.astype(np.float32), np.ones((_SIDE, _SIDE)))
    return np.asarray(seen < _SIDE**2 - 0.5)


@lru_cache(1)
def kernels() -> dict[str, NDArray[np.float64]]:
    """(7, 7) weights of the samples around a pixel whose own colour is another one.

    "cross" gives green at red or blue, "row" and "column" red or blue at a green pixel in whose
    row or column they lie, "diagonal" red at blue. Own weights sum to 1, the others to 0.
    """
    offset = np.moveaxis(np.indices((_SIDE, _SIDE)), 0, -1).reshape(-1, 2) - _REACH
    alike = _correlation()
    between = alike[tuple(np.moveaxis(offset[:, None] - offset, -1, 0))]
    out = {}
    for name, at, wanted in (("cross", (0, 0), 1), ("diagonal", (0, 0), 2), ("row", (0, 1), 0)):
        row, col = ((offset + at) % 2).T
        colour = sites("RGGB", (2, 2))[row, col]
        same = colour[:, None] == np.arange(3)
        known = between * np.where(colour[:, None] == colour, 1, _ALIKE)
        known += _NOISE * np.eye(len(known))
        towards = alike[tuple(offset.T)] * np.where(colour == wanted, 1, _ALIKE)
        # The means of the colours are not known: constants of each come out as they are.
        system = np.block([[known, same], [same.T, np.zeros((3, 3))]])
        solved = np.linalg.solve(system, np.append(towards, np.arange(3) == wanted))
        out[name] = solved[: len(known)].reshape(_SIDE, _SIDE)
    return {**out, "column": out["row"].T}


def _correlation() -> NDArray[np.float64]:
    """(64, 64) correlation of pixels by their distance in rows and columns, around 0."""
    frequency = np.fft.fftfreq(64)
    power = np.zeros((64, 64))
    # Beyond a pixel's own frequencies detail folds back.
    for down in (-1, 0, 1):
        for across in (-1, 0, 1):
            y, x = np.meshgrid(frequency + down, frequency + across, indexing="ij")
            square = (2 * np.pi) ** 2 * (x**2 + y**2)
            seen = np.exp(-_BLUR_PX2 * square) * (np.sinc(x) * np.sinc(y)) ** 2
            power += seen / (1 + _RANGE_PX**2 * square) ** 1.5
    found: NDArray[np.float64] = np.fft.ifft2(power).real
    return found / found[0, 0]


def _neighbours(plane: Any, known: NDArray[np.bool_], *, power: int = 1) -> Array:
    """The mean of the known among the eight neighbours, or its variance (power 2); NaN without."""
    weight = _filtered(known.astype(np.float32), _NEAR)
    with np.errstate(divide="ignore", invalid="ignore"):
        found: Array = _filtered(np.where(known, plane, 0), _NEAR**power) / weight**power
    return found


def _filtered(plane: Any, kernel: NDArray[Any]) -> Array:
    import cv2

    # Mirrored about the outermost pixel, a mosaic goes on as a mosaic.
    filtered: Array = cv2.filter2D(
        np.ascontiguousarray(plane, np.float32), cv2.CV_32F, kernel.astype(np.float32),
        borderType=cv2.BORDER_REFLECT_101,
    )  # fmt: skip
    return filtered
