"""Colour models of Bonn's DFMF files: decorrelated channels to RGB or spectrum, and back.

Everything works on planes, one contiguous array a channel, so that a value does not depend on
which others are decoded with it. Nothing is clamped. Formulas: docs/formats-bonn.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from btfkit import colour

Array = NDArray[np.float32]
Planes = list[Array]

EPSILON = 1e-5
NAMES: dict[int, str] = {
    0: "RGB",
    1: "YUV",
    2: "LAB",
    3: "PCA",
    4: "YCoCg",
    5: "SPECTRAL",
    6: "SPECTRAL_LINEAR",
    9: "Ylog_UV",
    10: "Ylog_Ulog_Vlog",
    11: "Ylog_UdivY_VdivY",
    12: "log_RGB",
}
PCA, LOG_RGB = 3, 12
# CIE XYZ under the D50 of ICC profiles to linear BT.709, Bradford adapted (Lindbloom).
_D50 = (0.9642, 1.0, 0.8249)
_D50_TO_RGB = (
    (3.1338561, -1.6168667, -0.4906146),
    (-0.9787684, 1.9161415, 0.0334540),
    (0.0719453, -0.2289914, 1.4052427),
)


def code(name: str | int) -> int:
    """Code of a colour model given by code or name, in any case.

    Raises:
        ValueError: there is no such model; the message lists them.
    """
    for number, known in NAMES.items():
        if name == number or str(name).casefold() == known.casefold():
            return number
    raise ValueError(f"no colour model {name!r}; there are {', '.join(NAMES.values())}")


def decoded(
    model: int,
    planes: Sequence[Array],
    *,
    mean: Sequence[float] = (0.0, 0.0, 0.0),
    transform: Sequence[Sequence[float]] = (),
) -> Planes:
    """What decorrelated planes mean.

    Args:
        model: a code of `NAMES`.
        planes: (...) one array a channel.
        mean, transform: of PCA: row vector x transform + mean.

    Returns:
        (...) one array a channel: R, G, B or the spectrum.
    """
    planes = [np.ascontiguousarray(plane, np.float32) for plane in planes]
    if model == PCA:
        a, b, c = planes
        rows = np.asarray(transform, np.float32)
        return [
            a * rows[0, i] + b * rows[1, i] + c * rows[2, i] + np.float32(mean[i]) for i in range(3)
        ]
    with np.errstate(all="ignore"):
        return _DECODERS[model](planes)


def encoder(model: int) -> Callable[[Planes], Planes]:
    """What makes planes that `decoded` turns back.

    Raises:
        ValueError: a model that is only read; PCA needs its axes, and is not here.
    """
    if model not in _ENCODERS:
        can = ", ".join(NAMES[known] for known in _ENCODERS)
        raise ValueError(f"colour model {NAMES[model]} is only read; written are {can}, PCA")
    return _ENCODERS[model]


def _yuv(planes: Planes) -> Planes:
    y, u, v = planes
    f = np.float32
    return [y + f(1.13983) * v, y - f(0.39465) * u - f(0.5806) * v, y + f(2.03211) * u]


def _to_yuv(planes: Planes) -> Planes:
    """The exact inverse of `_yuv`."""
    matrix = np.linalg.inv([[1, 0, 1.13983], [1, -0.39465, -0.5806], [1, 2.03211, 0]])
    return _mixed(planes, matrix)


def _mixed(planes: Planes, matrix: ArrayLike) -> Planes:
    rows = np.asarray(matrix, np.float32)
    return [
        sum((w * p for w, p in zip(row[1:], planes[1:], strict=True)), row[0] * planes[0])
        for row in rows
    ]


def _lab(planes: Planes) -> Planes:
    lightness, a, b = planes
    y = (lightness + np.float32(16)) / np.float32(116)
    xyz = []
    for f, white in zip((y + a / np.float32(500), y, y - b / np.float32(200)), _D50, strict=True):
        ratio = np.where(f > 6 / 29, f * f * f, (f - np.float32(4 / 29)) * np.float32(108 / 841))
        xyz.append((ratio * np.float32(white)).astype(np.float32))
    return [colour.to_srgb(plane).astype(np.float32) for plane in _mixed(xyz, _D50_TO_RGB)]


def _ycocg(planes: Planes) -> Planes:
    y, orange, green = planes
    return [y + orange - green, y + green, y - orange - green]


def _to_ycocg(planes: Planes) -> Planes:
    return _mixed(planes, [[0.25, 0.5, 0.25], [0.5, 0, -0.5], [-0.25, 0.5, -0.25]])


def _spectral(planes: Planes) -> Planes:
    total = planes[0]
    rest = [plane * total for plane in planes[1:]]
    shares = sum(planes[1:], np.zeros_like(total))
    return [(np.float32(1) - shares) * total, *rest]


def _to_spectral(planes: Planes) -> Planes:
    total = sum(planes[1:], planes[0])
    safe = np.where(total == 0, np.float32(1), total)
    return [total, *[np.divide(plane, safe, dtype=np.float32) for plane in planes[1:]]]


def _spectral_linear(planes: Planes) -> Planes:
    count = np.float32(len(planes))
    total = planes[0] * count
    rest = sum(planes[1:], np.zeros_like(total))
    return [total - rest / count, *(total + plane * total for plane in planes[1:])]


def _log(plane: Array) -> Array:
    return np.log(np.maximum(plane, np.float32(0)) + np.float32(EPSILON))


def _exp(plane: Array) -> Array:
    return np.exp(plane) - np.float32(EPSILON)


def _log_uv(planes: Planes) -> Planes:
    return _yuv([_exp(planes[0]), *planes[1:]])


def _to_log_uv(planes: Planes) -> Planes:
    y, u, v = _to_yuv(planes)
    return [_log(y), u, v]


def _log_log(planes: Planes) -> Planes:
    least = np.float32(np.log(EPSILON))
    chroma: Planes = [np.sign(p) * np.exp(np.abs(p) + least) for p in planes[1:]]
    return _yuv([_exp(planes[0]), *chroma])


def _to_log_log(planes: Planes) -> Planes:
    y, *chroma = _to_yuv(planes)
    small = np.float32(EPSILON)
    # Chroma below epsilon has no code but 0.
    return [_log(y), *(np.sign(c) * np.log(np.maximum(np.abs(c), small) / small) for c in chroma)]


def _log_ratio(planes: Planes) -> Planes:
    raised = np.exp(planes[0])
    y = raised - np.float32(EPSILON)
    return _yuv([y, planes[1] * raised, planes[2] * raised])


def _to_log_ratio(planes: Planes) -> Planes:
    y, u, v = _to_yuv(planes)
    y = np.maximum(y, np.float32(0))
    raised = y + np.float32(EPSILON)
    return [np.log(raised), u / raised, v / raised]


def _log_rgb(planes: Planes) -> Planes:
    return [_exp(plane) for plane in planes]


def _to_log_rgb(planes: Planes) -> Planes:
    return [_log(plane) for plane in planes]


def _same(planes: Planes) -> Planes:
    return planes


_DECODERS: dict[int, Callable[[Planes], Planes]] = {
    0: _same,
    1: _yuv,
    2: _lab,
    4: _ycocg,
    5: _spectral,
    6: _spectral_linear,
    9: _log_uv,
    10: _log_log,
    11: _log_ratio,
    12: _log_rgb,
}
_ENCODERS: dict[int, Callable[[Planes], Planes]] = {
    0: _same,
    1: _to_yuv,
    4: _to_ycocg,
    5: _to_spectral,
    9: _to_log_uv,
    10: _to_log_log,
    11: _to_log_ratio,
    12: _to_log_rgb,
}
