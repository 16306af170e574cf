"""Measured textures that a model's page lays beside its own."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import BTF
from btfkit.materials.base import Material
from btfkit.view import store

# Pairs that a page carries, and texels of all of them: 1 MB as base64.
_PAIRS, _TEXELS = 16, 16 * 128 * 128


def carried(material: Material, btf: BTF) -> dict[str, Any]:
    """What the page holds of a measurement: some pairs, far apart, shrunk, in 8 bits.

    Raises:
        ValueError: other channels or other proportions than the model has.
    """
    if btf.channels != material.header.channels:
        raise ValueError(
            f"the model answers channels {', '.join(material.header.channels)}; the measurement "
            f"has {', '.join(btf.channels)}"
        )
    (h, w), (rows, columns) = material.header.grid, btf.shape[1:3]
    if abs(w / h - columns / rows) > 1e-2 * (w / h):
        raise ValueError(
            f"the model's grid is {w} x {h}, the measurement's {columns} x {rows}: their tiles "
            "have other proportions"
        )
    pairs = apart(btf.light, btf.view, _PAIRS)
    small = store.thumbnails(btf.subset(pairs), texels=_TEXELS)
    kept = pairs[small.pairs]
    codes, peak = store.coded(small)
    height, width = small.linear.shape[1:3]
    return {
        "pairs": kept, "lights": np.round(btf.light[kept], 6), "views": np.round(btf.view[kept], 6),
        "w": width, "h": height, "peak": peak, "codes": codes,
        # The model is asked as blurred as the textures are that were shrunk.
        "least": 0.5 * max(h / height, w / width, 1.0),
    }  # fmt: skip


def apart(light: NDArray[Any], view: NDArray[Any], count: int) -> NDArray[np.intp]:
    """Pairs far from each other in light and view: the one nearest above first.

    Source: Gonzalez, "Clustering to Minimize the Maximum Intercluster Distance", 1985.
    """
    both = np.concatenate([light, view], axis=1).astype(float)
    chosen = [int(np.argmax(light[:, 2] + view[:, 2]))]
    distance = np.linalg.norm(both - both[chosen[0]], axis=1)
    while len(chosen) < min(count, len(both)) and distance.max() > 0:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(both - both[chosen[-1]], axis=1))
    return np.array(chosen, np.intp)
