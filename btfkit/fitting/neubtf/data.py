"""What a NeuBTF is fitted to: directions, held-out texels, the frontal slice, first latents."""

from __future__ import annotations

from typing import Any, final

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from btfkit.btf import BTF
from btfkit.errors import FitError
from btfkit.nearfield import texel_places

# Textures that the first latents are made of: their Gram matrix has three times as many rows.
_COMPONENT_PAIRS = 160


def frontal_slice(btf: BTF, pairs: NDArray[np.intp]) -> Tensor:
    """(c, h, w) mean of the most frontal view under up to 24 lights within 60 degrees.

    Raises:
        FitError: none of its texels is measured.
    """
    steepness = btf.view[pairs, 2]
    frontal = pairs[steepness >= steepness.max() - 1e-4]
    lit = frontal[btf.light[frontal, 2] >= min(0.5, float(btf.light[frontal, 2].max()))]
    chosen = lit[np.linspace(0, len(lit) - 1, min(24, len(lit))).astype(int)]
    total = np.zeros(btf.shape[1:], np.float64)
    count = np.zeros(btf.shape[1:], np.int64)
    for pair in chosen:
        image = btf.texture(int(pair))
        measured = np.isfinite(image)
        total += np.where(measured, image, 0)
        count += measured
    if not count.any():
        raise FitError("no texel of the frontal view is measured (all are NaN)")
    mean = total / np.maximum(count, 1)
    # Where nothing was measured, the mean of what was.
    mean = np.where(count > 0, mean, total.sum() / count.sum())
    return torch.from_numpy(mean.astype(np.float32)).permute(2, 0, 1)


def first_latents(images: NDArray[Any], count: int, *, deviation: float, seed: int) -> Tensor:
    """Latents to begin with: principal components of log(1 + rgb) over some textures.

    Args:
        images: (k, h, w, c) textures, NaN where not measured.
        count: of latents; those beyond the components that there are stay near 0.
        deviation: of every component. seed: of which textures, and of the rest.

    Returns:
        (h * w, count).
    """
    rng = np.random.default_rng(seed)
    chosen = np.sort(rng.permutation(len(images))[:_COMPONENT_PAIRS])
    columns = []
    for slot in chosen:
        image = np.asarray(images[slot], np.float32)
        image = np.log1p(np.maximum(image, -0.1)).reshape(-1, image.shape[-1])
        measured = np.isfinite(image)
        mean = np.where(measured, image, 0).sum(axis=0) / np.maximum(measured.sum(axis=0), 1)
        # A texel that was not measured is taken as the mean: it leans nowhere.
        columns.append(np.where(measured, image - mean, 0))
    table = np.concatenate(columns, axis=1)
    _, vectors = np.linalg.eigh((table.T @ table).astype(np.float64))
    scores = table @ vectors[:, ::-1][:, :count].astype(np.float32)
    spread = scores.std(axis=0)
    # A component of rounding alone is none.
    kept = spread > 1e-4 * max(float(spread.max()), 1e-12)
    latents = rng.normal(0, 0.01, (len(table), count)).astype(np.float32)
    latents[:, : len(spread)][:, kept] = scores[:, kept] / spread[kept] * deviation
    return torch.from_numpy(latents)


@final
class PairDirections:
    """Light and view of pairs at texels: shared by all texels far away, per texel near."""

    def __init__(self, btf: BTF) -> None:
        self._far = [torch.from_numpy(d.copy()) for d in (btf.light, btf.view)]
        self._near = [
            None if p is None else torch.from_numpy(np.asarray(p, np.float32).copy())
            for p in (btf.light_position, btf.view_position)
        ]
        self._texel, (_, self._h, self._w, _) = btf.texel_mm or 1.0, btf.shape

    def at(self, index: NDArray[np.intp], rows: Tensor, cols: Tensor) -> tuple[Tensor, Tensor]:
        """(k, m or 1, 3) light and view of pairs (k,) at texels (m,)."""
        pairs = torch.from_numpy(index)
        x, y = texel_places(rows, cols, (self._h, self._w), self._texel)
        plane = torch.stack([x, y, torch.zeros_like(x)], dim=-1)
        found = [
            far[pairs][:, None] if near is None
            else F.normalize(near[pairs][:, None] - plane[None], dim=-1)
            for far, near in zip(self._far, self._near, strict=True)
        ]  # fmt: skip
        return found[0], found[1]
