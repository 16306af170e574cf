"""A BTF as a page: its pairs on two discs, its textures, the ABRDF of a texel."""

from __future__ import annotations

import base64
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from btfkit import colour, directions
from btfkit.btf import BTF
from btfkit.render.studio import visible
from btfkit.view.page import composed, in_script

# Texels that a page carries, all pairs together: 5 MB as base64.
MOST_TEXELS = 1_250_000
# Shorter sides than this show no texture: then fewer pairs are carried.
_LEAST_SIDE = 16


class Thumbnails(NamedTuple):
    """The textures that a page carries.

    Attributes:
        pairs: (m,) which pairs of the BTF.
        linear: (m, h, w, 3) means over blocks of texels, RGB; 0 where nothing was measured.
        masked: values that are not finite, of all that were read.
    """

    pairs: NDArray[np.intp]
    linear: NDArray[np.float32]
    masked: int


def page(btf: BTF, *, title: str, progress: Callable[[int, int], None] | None = None) -> str:
    """One HTML page of a BTF; textures are shrunk and coded in 8 bits, as the page says."""
    small = thumbnails(btf, progress=progress)
    codes, peak = coded(small)
    lights, light_of = directions.unique(btf.light[small.pairs])
    views, view_of = directions.unique(btf.view[small.pairs])
    m, h, w, _ = small.linear.shape
    carried = {
        "n": m, "h": h, "w": w, "peak": peak,
        "lights": np.round(lights, 5), "views": np.round(views, 5),
        "pairs": np.stack([light_of, view_of], axis=1),
        "of": small.pairs if m < btf.shape[0] else None,
        "codes": codes,
        "about": _said(btf, small, peak),
    }  # fmt: skip
    return composed("store", "store.js", title=title, store=in_script(carried))


def coded(small: Thumbnails) -> tuple[str, float]:
    """Textures in 8 bits, sRGB coded, as base64, and the brightest value, which is 255."""
    peak = max(float(small.linear.max()), 1e-6)
    codes = np.rint(255 * colour.to_srgb(np.clip(small.linear / peak, 0, 1))).astype(np.uint8)
    return base64.b64encode(codes.tobytes()).decode(), peak


def thumbnails(
    btf: BTF,
    *,
    texels: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Thumbnails:
    """As many pairs, as large, as `texels` (a page's, where None) hold; read one after the other.

    Values that are not finite count as nothing in the means.
    """
    n, h, w, _ = btf.shape
    texels = texels or MOST_TEXELS
    most = max(texels // (min(_LEAST_SIDE, h) * min(_LEAST_SIDE, w)), 1)
    pairs = np.unique(np.linspace(0, n - 1, min(n, most)).astype(np.intp))
    shrink = max(math.sqrt(len(pairs) * h * w / texels), 1.0)
    size = max(int(h / shrink), 1), max(int(w / shrink), 1)
    matrix = visible(btf.channels)
    linear = np.zeros((len(pairs), *size, 3), np.float32)
    masked = 0
    for k, pair in enumerate(pairs):
        texture = np.asarray(btf.texture(int(pair)), np.float32)
        good = np.isfinite(texture)
        masked += int(good.size - np.count_nonzero(good))
        weight = _shrunk(good.astype(np.float32), size)
        mean = _shrunk(np.where(good, texture, 0), size) / np.maximum(weight, 1e-6)
        linear[k] = np.where(weight > 0, mean, 0) @ matrix
        if progress:
            progress(k + 1, len(pairs))
    return Thumbnails(pairs, linear, masked)


def _shrunk(texture: NDArray[np.float32], size: tuple[int, int]) -> NDArray[Any]:
    import cv2

    if texture.shape[:2] == size:
        return texture
    # OpenCV takes four channels at a time and drops the last axis of one.
    parts = [
        cv2.resize(texture[..., c : c + 4], size[::-1], interpolation=cv2.INTER_AREA)
        for c in range(0, texture.shape[2], 4)
    ]
    return np.concatenate([part.reshape(*size, -1) for part in parts], axis=2)


def _said(btf: BTF, small: Thumbnails, peak: float) -> list[tuple[str, str]]:
    n, h, w, _ = btf.shape
    m, rows, columns, _ = small.linear.shape
    edge = btf.texel_mm
    said = [
        ("pairs", f"{n}" if m == n else f"{n}; here {m}, evenly chosen"),
        ("texels", f"{h} x {w}" + ("" if (rows, columns) == (h, w) else
                                   f"; here {rows} x {columns}, means")),
        ("values here", f"8 bits, sRGB coded, of 0 to {peak:.3g}"),
        ("channels", ", ".join(btf.channels[:8]) + ("" if len(btf.channels) <= 8 else ", ...")),
        ("tile", "size unknown" if edge is None else f"{w * edge:.4g} x {h * edge:.4g} mm"),
        ("licence", btf.licence or "not stated"),
    ]  # fmt: skip
    if small.masked:
        said.append(("not finite", f"{small.masked} values, left out"))
    return said
