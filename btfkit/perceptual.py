"""FLIP: the difference that a viewer sees when two pictures alternate.

Source: Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", Proc. ACM
Comput. Graph. Interact. Tech. 3(2), 2020; section and table numbers below are of that paper.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve1d

Array = NDArray[np.floating]

PIXELS_PER_DEGREE = 67.0
# D65 white and linear BT.709 to XYZ, with the digits that the paper's own evaluator uses.
_TO_XYZ = np.array(
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ]
)
_WHITE = _TO_XYZ.sum(axis=1)
# Table 1: contrast sensitivity as sums of Gaussians a sqrt(pi/b) exp(-pi^2 d^2 / b).
_SENSITIVITY = {"a": ((1.0, 0.0047),), "rg": ((1.0, 0.0053),), "by": ((34.1, 0.04), (13.5, 0.025))}
_COLOUR_POWER, _COLOUR_KNEE, _COLOUR_TARGET = 0.7, 0.4, 0.95
_FEATURE_POWER, _FEATURE_DEGREES = 0.5, 0.082


def flip(answer: Array, truth: Array, *, pixels_per_degree: float = PIXELS_PER_DEGREE) -> Array:
    """(h, w) FLIP in 0..1 of two (h, w, 3) linear BT.709 pictures, clamped to 0..1 first."""
    pictures = [_opponent(np.clip(picture, 0, 1)) for picture in (answer, truth)]
    filtered = [_perceived(picture, pixels_per_degree) for picture in pictures]
    hunt = [_hunt(_to_lab(np.clip(_from_opponent(picture), 0, 1))) for picture in filtered]
    colour = _redistributed(_hyab(*hunt) ** _COLOUR_POWER)
    ours, theirs = ((picture[..., 0] + 16) / 116 for picture in pictures)
    feature = _feature_difference(ours, theirs, pixels_per_degree)
    return colour ** (1 - feature)


def _opponent(rgb: Array) -> Array:
    """YyCxCz of linear RGB (section 4.1.1)."""
    x, y, z = np.moveaxis(rgb @ _TO_XYZ.T / _WHITE, -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def _from_opponent(picture: Array) -> Array:
    y = (picture[..., 0] + 16) / 116
    xyz = np.stack([picture[..., 1] / 500 + y, y, y - picture[..., 2] / 200], axis=-1)
    return (xyz * _WHITE) @ np.linalg.inv(_TO_XYZ).T


def _to_lab(rgb: Array) -> Array:
    xyz = rgb @ _TO_XYZ.T / _WHITE
    delta = 6 / 29
    f = np.where(xyz > delta**3, np.cbrt(xyz), xyz / (3 * delta**2) + 4 / 29)
    return np.stack(
        [
            116 * f[..., 1] - 16,
            500 * (f[..., 0] - f[..., 1]),
            200 * (f[..., 1] - f[..., 2]),
        ],
        axis=-1,
    )


def _perceived(picture: Array, pixels_per_degree: float) -> Array:
    """Each opponent channel under its contrast sensitivity (section 4.1.2)."""
    widest = max(b for terms in _SENSITIVITY.values() for _, b in terms)
    radius = int(np.ceil(3 * np.sqrt(widest / (2 * np.pi**2)) * pixels_per_degree))
    degrees = np.arange(-radius, radius + 1) / pixels_per_degree
    out = np.empty_like(picture)
    for channel, terms in enumerate(_SENSITIVITY.values()):
        total = 0.0
        filtered = np.zeros(picture.shape[:2])
        for a, b in terms:
            # The paper's weights, sqrt(pi / b), though the kernel has two dimensions.
            line = np.exp(-(np.pi**2) * degrees**2 / b)
            weight = a * np.sqrt(np.pi / b)
            total += weight * line.sum() ** 2
            filtered += weight * _separable(picture[..., channel], line, line)
        out[..., channel] = filtered / total
    return out


def _separable(image: Array, down: Array, across: Array) -> Array:
    rows = convolve1d(image, down[::-1], axis=0, mode="nearest")
    return convolve1d(rows, across[::-1], axis=1, mode="nearest")


def _hunt(lab: Array) -> Array:
    """Chroma scaled by lightness: colours fade in the dark (section 4.1.3)."""
    lightness = lab[..., :1]
    return np.concatenate([lightness, 0.01 * lightness * lab[..., 1:]], axis=-1)


def _hyab(a: Array, b: Array) -> Array:
    """City-block in lightness, Euclidean in chroma (section 4.1.3)."""
    d = a - b
    return np.abs(d[..., 0]) + np.hypot(d[..., 1], d[..., 2])


def _redistributed(difference: Array) -> Array:
    """0..1 of a powered difference, larger ones compressed (section 4.1.3)."""
    extremes = np.array([[[0.0, 1.0, 0.0]], [[0.0, 0.0, 1.0]]])
    green, blue = _hunt(_to_lab(extremes))
    largest = float(_hyab(green, blue)[0]) ** _COLOUR_POWER
    knee = _COLOUR_KNEE * largest
    low = _COLOUR_TARGET / knee * difference
    high = _COLOUR_TARGET + (difference - knee) / (largest - knee) * (1 - _COLOUR_TARGET)
    return np.where(difference < knee, low, high)


def _feature_difference(a: Array, b: Array, pixels_per_degree: float) -> Array:
    """Differences of edges and points, 0..1 (section 4.2)."""
    deviation = 0.5 * _FEATURE_DEGREES * pixels_per_degree
    radius = int(np.ceil(3 * deviation))
    x = np.arange(-radius, radius + 1, dtype=float)
    bell = np.exp(-(x**2) / (2 * deviation**2))
    difference = np.zeros_like(a)
    for kernel in (-x * bell, (x**2 / deviation**2 - 1) * bell):
        positive, negative = np.maximum(kernel, 0), np.minimum(kernel, 0)
        kernel = positive / positive.sum() + negative / -negative.sum()
        flat = bell / bell.sum()
        sizes = [
            np.hypot(_separable(image, flat, kernel), _separable(image, kernel, flat))
            for image in (a, b)
        ]
        difference = np.maximum(difference, np.abs(sizes[0] - sizes[1]))
    return (difference / np.sqrt(2)) ** _FEATURE_POWER
