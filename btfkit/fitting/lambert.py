"""Lambert, fitted: least squares of albedo x cosine for every texel."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from btfkit.btf import BTF
from btfkit.errors import FitError
from btfkit.fitting.interpolation import images_of
from btfkit.materials.base import Header
from btfkit.materials.lambert import Lambert, LambertSpec
from btfkit.queries import QuerySet
from btfkit.settings import parsed

Sums = tuple[NDArray[np.float64], NDArray[np.float64]]
# Rows for each texel that a grid of unknown size is given, so that few texels stay empty.
_ROWS_A_TEXEL = 32


@final
@dataclass(frozen=True)
class Settings:
    """Lambert has no settings."""


def lambert(
    source: BTF | QuerySet,
    *,
    settings: Mapping[str, str],
    progress: Callable[[int, int], None] | None = None,
) -> Lambert:
    """The albedo texture that makes sum (value - albedo x cosine)^2 least.

    Values that are not measured or lit from below the horizon do not count; a texel that has
    no other takes the albedo of the nearest one that has.

    Raises:
        FitError: no value is lit from above the horizon and measured.
    """
    parsed(Settings, "lambert", settings)
    if isinstance(source, QuerySet):
        (product, square), header = _of_queries(source)
    else:
        product, square = _of_images(images_of(source, "lambert"), progress)
        header = Header.of(source)
    known = square > 0
    if not known.any():
        raise FitError("no value is measured and lit from above the horizon")
    albedo = np.divide(product, square, out=np.zeros_like(product), where=known)
    for channel in range(albedo.shape[2]):
        if known[..., channel].any() and not known[..., channel].all():
            row, col = distance_transform_edt(
                ~known[..., channel], return_distances=False, return_indices=True
            )
            albedo[..., channel] = albedo[row, col, channel]
    spec = LambertSpec(header.grid, albedo.shape[2])
    return Lambert(spec, {"texture": albedo.astype(np.float32)}, header)


def _of_images(btf: BTF, progress: Callable[[int, int], None] | None) -> Sums:
    """`sums` of all pairs that light reaches."""

    def lit() -> Iterator[tuple[NDArray[np.float32], NDArray[np.float64]]]:
        for pair in range(len(btf)):
            cosine = np.maximum(btf.light_at(pair)[..., 2:].astype(float), 0)
            if cosine.any():
                yield btf.texture(pair), cosine
            if progress:
                progress(pair + 1, len(btf))

    return sums(lit(), btf.shape[1:])


def sums(
    images: Iterable[tuple[NDArray[np.float32], float | NDArray[np.float64]]],
    shape: tuple[int, ...],
) -> Sums:
    """Sums of value x cosine and of cosine^2, each (h, w, c), over what is measured.

    Args:
        images: (h, w, c) values, NaN where not measured, and the cosine of their light.
        shape: h, w, c.
    """
    product, square = np.zeros(shape), np.zeros(shape)
    for image, cosine in images:
        measured = np.isfinite(image)
        product += np.where(measured, image, 0) * cosine
        square += measured * np.square(cosine)
    return product, square


def _of_queries(queries: QuerySet) -> tuple[Sums, Header]:
    """The same sums over the texels that queries lie in; the finest queries where levels differ."""
    rows = queries.subset(queries.valid() & (queries.light[:, 2] > 0))
    if rows.rgb is None or not len(rows):
        raise FitError("no query has an answer (rgb) and is lit from above the horizon")
    if rows.footprint is not None:
        rows = rows.subset(rows.footprint <= max(0.5, float(rows.footprint.min())))
    side = int(np.clip(np.sqrt(len(rows) / _ROWS_A_TEXEL), 1, 1024))
    h, w = queries.size or (side, side)
    uv = rows.uv.astype(float) % 1
    texel = np.minimum((uv[:, 1] * h).astype(int), h - 1) * w
    texel += np.minimum((uv[:, 0] * w).astype(int), w - 1)
    weight = np.ones(len(rows)) if rows.weight is None else rows.weight.astype(float)
    if rows.opacity is not None:
        # Reflectance is 0 by definition where nothing is there: that says nothing of albedo.
        weight = weight * (rows.opacity > 0)
    cosine = rows.light[:, 2].astype(float)
    values: NDArray[np.float32] = rows.rgb  # type: ignore[assignment]
    product = np.empty((h, w, values.shape[1]))
    for k, value in enumerate(values.T.astype(float)):
        product[..., k] = np.bincount(texel, weight * cosine * value, h * w).reshape(h, w)
    square = np.empty_like(product)
    square[:] = np.bincount(texel, weight * np.square(cosine), h * w).reshape(h, w, 1)
    return (product, square), Header(grid=(h, w), channels=queries.channels)
