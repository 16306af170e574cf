"""Face of the kernel that multiplies factors of a BTF out, and its plain numpy twin.

    value = scale * (exp(left[i] . right[j]) - 1e-5)      with log, else
    value = scale * (left[i] . right[j])

Factors are rows of k numbers of 2, 4 or 8 bytes, at any address; the product is in float32.
A value that is not finite comes as NaN.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit import native

Array = NDArray[np.float32]
Factor = NDArray[np.floating]
Index = NDArray[np.integer[Any]]

EPSILON = np.float32(1e-5)


def images(
    left: Factor,
    right: Factor,
    rows: Index,
    down: Index,
    along: Index,
    scale: Array,
    *,
    log: bool,
    out: Array,
) -> None:
    """Whole windows of several images.

    Args:
        left: (m, k) factors of images.
        right: (t, k) factors of texels.
        rows: (b, c) row of `left` for image and channel.
        down, along: (h,) and (w,): texel (y, x) has row down[y] + along[x] of `right`.
        scale: (b,) factor of each image.
        log: whether values are exponentials.
        out: (b, h, w, c) contiguous float32 to fill.
    """
    kernel = native.load("factors")
    if kernel is None:
        images_plain(left, right, rows, down, along, scale, log=log, out=out)
        return
    kernel.images(
        *_raw(left), *_raw(right), _i64(rows), _i64(down), _i64(along),
        np.ascontiguousarray(scale, np.float32), log, native.threads(), "", out,
    )  # fmt: skip


def images_plain(
    left: Factor,
    right: Factor,
    rows: Index,
    down: Index,
    along: Index,
    scale: Array,
    *,
    log: bool,
    out: Array,
) -> None:
    """The same in numpy: one matrix product and one exp."""
    b, c = rows.shape
    texels = (down[:, None] + along).reshape(-1)
    first, last = int(texels[0]), int(texels[-1])
    if last - first + 1 == len(texels) and (np.diff(texels) == 1).all():
        wanted = right[first : last + 1]
    else:
        wanted = right[texels]
    with np.errstate(over="ignore", invalid="ignore"):
        a = left[rows.reshape(-1)].astype(np.float32)
        product = a @ wanted.astype(np.float32, copy=False).T
    product = _finished(product.reshape(b, c, -1), log, scale[:, None, None])
    out[...] = product.transpose(0, 2, 1).reshape(out.shape)


def values(left: Factor, right: Factor, i: Index, j: Index, scale: Array, *, log: bool) -> Array:
    """Scattered values.

    Args:
        left, right: (m, k) and (t, k) factors.
        i, j: (b,) rows of `left` and `right`.
        scale: (b,) factors.
        log: whether values are exponentials.

    Returns:
        (b,) values, bit for bit those of `images` by the same kernel.
    """
    kernel = native.load("factors")
    if kernel is None:
        return values_plain(left, right, i, j, scale, log=log)
    out = np.empty(len(i), np.float32)
    kernel.values(
        *_raw(left), *_raw(right), _i64(i), _i64(j),
        np.ascontiguousarray(scale, np.float32), log, native.threads(), "", out,
    )  # fmt: skip
    return out


def values_plain(
    left: Factor, right: Factor, i: Index, j: Index, scale: Array, *, log: bool
) -> Array:
    """The same in numpy, some thousand rows at a time."""
    out = np.empty(len(i), np.float32)
    for start in range(0, len(i), 4096):
        part = slice(start, start + 4096)
        with np.errstate(over="ignore", invalid="ignore"):
            a, b = left[i[part]].astype(np.float32), right[j[part]].astype(np.float32)
            out[part] = np.einsum("ik,ik->i", a, b)
    return _finished(out, log, scale)


def _finished(product: Array, log: bool, scale: Array) -> Array:
    product[~np.isfinite(product)] = np.nan
    with np.errstate(over="ignore", invalid="ignore"):
        if log:
            np.exp(product, out=product)
            product -= EPSILON
        product *= scale
    product[np.isinf(product)] = np.nan
    return product


def _raw(factor: Factor) -> tuple[NDArray[np.uint8], int, int]:
    """Bytes, row length and bytes a number of a factor: the kernel reads unaligned."""
    flat = factor.reshape(-1).view(np.uint8)
    return flat, factor.shape[1], factor.dtype.itemsize


def _i64(index: Index) -> NDArray[np.int64]:
    return np.ascontiguousarray(index, np.int64)
