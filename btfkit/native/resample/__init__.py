"""Pixels of a frame gathered into texels, each with its own footprint; and the numpy twin.

A texel is the weighted mean of pixels. `ewa` weighs by a Gaussian, whose ellipse may differ from
texel to texel; `area` integrates a parallelogram of the surface that the pixels' means imply.
Pixels that are NaN or outside the frame are left out, and what share of the weight they had is
told.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from btfkit import native

Array = NDArray[np.float32]
# Squared Mahalanobis distance at which Gaussians end, and what of their covariance is then left.
CUT = 14.0
KEPT = float(
    (1 - np.exp(-CUT / 2) * (1 + CUT / 2 + CUT**2 / 8)) / (1 - np.exp(-CUT / 2) * (1 + CUT / 2))
)
# Nodes of Gauss and Legendre a side of a texel, at most; more pixels than that are averaged anyway.
_MOST_NODES = 16
_NO_MOSAIC = np.full((2, 2), -1, np.int32)


class Gathered(NamedTuple):
    """Texels of a frame.

    Attributes:
        value: (t, c), NaN where no pixel was seen.
        variance: (t, c) of the values; None where the pixels' is not known.
        coverage: (t, c) share of the weight that lay on usable pixels.
    """

    value: Array
    variance: Array | None
    coverage: Array


def ewa(
    image: Array,
    place: NDArray[np.float64],
    inverse: Array,
    *,
    variance: Array | None = None,
    sites: NDArray[np.int32] | None = None,
    colours: Array | None = None,
    threads: int | None = None,
) -> Gathered:
    """Means under elliptical Gaussians, lowered to end at `CUT` without a step.

    Args:
        image: (h, w, c) values, NaN where unusable; or one mosaic (h, w, 1).
        place: (t, 2) centres, column and row in pixels.
        inverse: (t, 3) inverse covariances xx, xy, yy, 1 / pixel^2.
        variance: (h, w, c) of the values.
        sites: (2, 2) channel of the first pixels of a mosaic; it repeats.
        colours: (h, w, 3) of a mosaic of three colours, told at every pixel, NaN where unusable:
            values are the means of these. Variance and coverage stay those of the samples.
        threads: None takes the kernels' own.
    """
    kernel = native.load("resample")
    if kernel is None:
        return ewa_plain(image, place, inverse, variance=variance, sites=sites, colours=colours)
    out = _empty(image, len(place), sites)
    *frame, places, shapes = _given(image, variance, sites, place, inverse)
    full = np.empty(0, np.float32) if colours is None else np.ascontiguousarray(colours, np.float32)
    kernel.ewa(*frame, full, places, shapes, CUT, threads or native.threads(), *out)
    return Gathered(out[0], None if variance is None else out[1], out[2])


def ewa_plain(
    image: Array,
    place: NDArray[np.float64],
    inverse: Array,
    *,
    variance: Array | None = None,
    sites: NDArray[np.int32] | None = None,
    colours: Array | None = None,
) -> Gathered:
    """`ewa` in numpy: one pixel of every texel's window at a time."""
    a, b, d = inverse.astype(float).T
    with np.errstate(invalid="ignore", divide="ignore"):
        det = a * d - b * b
        good = np.isfinite(place.sum(1)) & (a > 0) & (det > 0)
        reach = np.sqrt(CUT * np.stack([d, a], -1) / det[:, None])
    centre = np.where(good[:, None], place, -1e6)
    near = np.rint(centre).astype(np.int64)
    sums = [_Sums(image, variance, sites, len(place))]
    if colours is not None:
        whole = np.isfinite(colours).all(axis=-1, keepdims=True)
        sums.append(_Sums(np.where(whole, colours, np.nan), None, None, len(place)))
    across, down = np.ceil(np.max(reach[good], axis=0, initial=0.0)).astype(int) + 1
    for y in range(-down, down + 1):
        for x in range(-across, across + 1):
            off = near - centre + np.array([x, y])
            q = a * off[:, 0] ** 2 + 2 * b * off[:, 0] * off[:, 1] + d * off[:, 1] ** 2
            weight = np.where(good & (q < CUT), np.exp(-q / 2) - np.exp(-CUT / 2), 0.0)
            for each in sums:
                each.add(near[:, 1] + y, near[:, 0] + x, weight)
    found = sums[0].gathered()
    if colours is None:
        return found
    between = sums[1].gathered().value
    return found._replace(value=np.where(np.isfinite(found.value), between, np.float32(np.nan)))


def area(
    image: Array,
    place: NDArray[np.float64],
    edges: Array,
    *,
    variance: Array | None = None,
    threads: int | None = None,
) -> Gathered:
    """Means over parallelograms of a surface that is a parabola across each pixel.

    The parabolas have the pixels' means, so that nothing is blurred by interpolation; their
    edges are of fourth order (Colella and Woodward 1984, "The Piecewise Parabolic Method").

    Args:
        image: (h, w, c) values, NaN where unusable.
        place: (t, 2) centres, column and row in pixels.
        edges: (t, 2, 2) d pixel / d texel: columns are the sides of the parallelogram.
        variance: (h, w, c) of the values.
    """
    kernel = native.load("resample")
    if kernel is None:
        return area_plain(image, place, edges, variance=variance)
    out = _empty(image, len(place), None)
    nodes, weights = _quadrature()
    given = _given(image, variance, None, place, edges)
    kernel.area(*given, nodes, weights, threads or native.threads(), *out)
    return Gathered(out[0], None if variance is None else out[1], out[2])


def area_plain(
    image: Array, place: NDArray[np.float64], edges: Array, *, variance: Array | None = None
) -> Gathered:
    """`area` in numpy: weights of one texel at a time."""
    nodes, weights = _quadrature()
    sums = _Sums(image, variance, None, len(place))
    for at, (centre, sides) in enumerate(zip(place, edges.astype(float), strict=True)):
        reach = 0.5 * np.abs(sides).sum(1)
        if not np.isfinite(centre.sum() + reach.sum()):
            continue
        first = np.floor(centre - reach + 0.5).astype(np.int64) - 2
        size = np.floor(centre + reach + 0.5).astype(np.int64) + 3 - first
        counts = np.clip(np.ceil(1.5 * np.hypot(*sides)), 3, _MOST_NODES).astype(int)
        (pu, wu), (pv, wv) = ((nodes[n, :n], weights[n, :n]) for n in counts)
        u, v = (grid.ravel() for grid in np.meshgrid(pu, pv))
        x, y = (centre - first)[:, None] + sides @ np.stack([u, v])
        rows, columns = _parabolas(y, size[1]), _parabolas(x, size[0])
        weight = np.einsum("sy,sx,s->yx", rows, columns, np.outer(wv, wu).ravel())
        sums.add_patch(at, first, weight)
    return sums.gathered()


class _Sums:
    """Weighted sums of texels, as the kernel keeps them."""

    def __init__(
        self, image: Array, variance: Array | None, sites: NDArray[np.int32] | None, texels: int
    ) -> None:
        self._image, self._variance, self._sites = image, variance, sites
        channels = image.shape[2] if sites is None else int(sites.max()) + 1
        self._all, self._seen, self._value, self._square = np.zeros((4, texels, channels))

    def add(self, rows: NDArray[np.int64], columns: NDArray[np.int64], weight: Any) -> None:
        """One pixel for each texel: (t,) rows, columns and weights."""
        self._add(np.arange(len(rows)), rows, columns, weight)

    def add_patch(self, texel: int, first: NDArray[np.int64], weight: Any) -> None:
        """Many pixels of one texel: from the pixel `first`, column first."""
        rows, columns = np.indices(weight.shape).reshape(2, -1)
        at = np.full(weight.size, texel)
        self._add(at, rows + first[1], columns + first[0], weight.ravel())

    def gathered(self) -> Gathered:
        with np.errstate(invalid="ignore", divide="ignore"):
            some = (self._seen > 1e-6 * np.abs(self._all)) & (self._all != 0)
            value = np.where(some, self._value / self._seen, np.nan).astype(np.float32)
            square = np.where(some, self._square / self._seen**2, np.nan).astype(np.float32)
            coverage = np.where(self._all != 0, self._seen / self._all, 0).astype(np.float32)
        return Gathered(value, None if self._variance is None else square, coverage)

    def _add(self, at: Any, rows: Any, columns: Any, weight: Any) -> None:
        h, w, c = self._image.shape
        inside = (rows >= 0) & (rows < h) & (columns >= 0) & (columns < w)
        row, column = np.clip(rows, 0, h - 1), np.clip(columns, 0, w - 1)
        for k in range(c):
            channel = k if self._sites is None else self._sites[rows % 2, columns % 2]
            values = self._image[row, column, k]
            usable = inside & np.isfinite(values)
            np.add.at(self._all, (at, channel), weight)
            np.add.at(self._seen, (at, channel), weight * usable)
            np.add.at(self._value, (at, channel), weight * np.where(usable, values, 0))
            if self._variance is not None:
                spread = np.where(usable, self._variance[row, column, k], 0)
                np.add.at(self._square, (at, channel), weight**2 * spread)


def _parabolas(x: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    """(s, size) weights of pixels in the parabolas at places x (s,)."""
    cell = np.floor(x + 0.5)
    u = x + 0.5 - cell
    left, right, mean = 1 - 4 * u + 3 * u * u, u * (3 * u - 2), 6 * u * (1 - u)
    taps = [
        -left / 12,
        7 * left / 12 - right / 12,
        7 * (left + right) / 12 + mean,
        7 * right / 12 - left / 12,
        -right / 12,
    ]
    out = np.zeros((len(x), size))
    for offset, tap in enumerate(taps):
        out[np.arange(len(x)), cell.astype(int) + offset - 2] += tap
    return out


def _quadrature() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Nodes in -0.5..0.5 and weights of n points in row n."""
    nodes, weights = np.zeros((2, _MOST_NODES + 1, _MOST_NODES))
    for n in range(1, _MOST_NODES + 1):
        node, weight = np.polynomial.legendre.leggauss(n)
        nodes[n, :n], weights[n, :n] = node / 2, weight / 2
    return nodes, weights


def _empty(image: Array, texels: int, sites: NDArray[np.int32] | None) -> list[Array]:
    channels = image.shape[2] if sites is None else int(sites.max()) + 1
    return [np.empty((texels, channels), np.float32) for _ in range(3)]


def _given(
    image: Array, variance: Array | None, sites: Any, place: Any, shape: Any
) -> tuple[Any, ...]:
    none = np.empty(0, np.float32)
    return (
        np.ascontiguousarray(image, np.float32),
        none if variance is None else np.ascontiguousarray(variance, np.float32),
        np.ascontiguousarray(_NO_MOSAIC if sites is None else sites, np.int32),
        np.ascontiguousarray(place, np.float64),
        np.ascontiguousarray(shape, np.float32),
    )
