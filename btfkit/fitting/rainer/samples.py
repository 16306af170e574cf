"""The texels of a BTF as autoencoders see them: probes to encode, a pool to decode."""

from __future__ import annotations

from collections.abc import Callable
from typing import final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from btfkit.btf import BTF
from btfkit.fitting.pool import Pool
from btfkit.materials.evaluation import texel_centres
from btfkit.nearfield import directions_at, uv_places

# The darkest noise of a dark-subtracted measurement, as the losses count it.
_DARKEST = -0.1
_LEAST_DEVIATION = 1e-3


@final
class ProbedTexels:
    """One material's data.

    Args:
        btf: where the textures come from. train: (m,) its pairs that may be used.
        seed: of the choice of probes, and of the pool.
        probes: pairs whose values are encoded, at most.
        whitened: whether probes are whitened texel by texel; else probe by probe.
        most_bytes: memory for the pool, and as much again for the probes.
        progress: called with (decoded, to decode).

    Attributes:
        values: (h w, probes, c) float16 log(1 + value), whitened; where a value is not
            measured, the mean.
        mean, deviation: (h w, c) that the values of a texel were whitened by.
        texels, slots: how many there are to draw. masked: texels that are not measured.
    """

    def __init__(
        self,
        btf: BTF,
        train: NDArray[np.intp],
        *,
        seed: int,
        probes: int,
        whitened: bool,
        most_bytes: int,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        self._btf = btf
        self._pool = Pool(btf, train, seed=seed, most_bytes=most_bytes, progress=progress)
        self.masked, self.slots = self._pool.masked, len(self._pool.pairs)
        _, h, w, c = btf.shape
        self.texels = h * w
        count = min(probes, len(train), max(1, most_bytes // (2 * h * w * c)))
        chosen = np.random.default_rng([seed, 1]).permutation(train)[:count]
        self._probes = np.sort(chosen)
        values = np.empty((h * w, count, c), np.float16)
        for k, pair in enumerate(self._probes):
            image = np.maximum(btf.texture(int(pair)).reshape(h * w, c), _DARKEST)
            values[:, k] = np.log1p(np.where(np.isfinite(image), image, np.nan))
        self._whiten(values, whitened)

    def _whiten(self, values: NDArray[np.float16], by_texel: bool) -> None:
        measured = np.isfinite(values)
        axis = 1 if by_texel else 0
        number = measured.sum(axis=axis, keepdims=True)
        total = np.where(measured, values, 0).astype(np.float32)
        everywhere = total.sum() / max(measured.sum(), 1)
        mean = total.sum(axis, keepdims=True) / np.maximum(number, 1)
        mean = np.where(number > 0, mean, everywhere)
        square = np.square(np.where(measured, values - mean, 0)).sum(axis, keepdims=True)
        deviation = np.sqrt(square / np.maximum(number, 1))
        if not by_texel:
            # Probes keep their relative brightness: one scale for all of them.
            deviation = np.full_like(deviation, np.sqrt(np.square(deviation).mean()))
        deviation = np.maximum(deviation, _LEAST_DEVIATION)
        white = np.where(measured, (values - mean) / deviation, 0)
        self.values = torch.from_numpy(white.astype(np.float16))
        if by_texel:
            self.mean = torch.from_numpy(mean[:, 0].astype(np.float32))
            self.deviation = torch.from_numpy(deviation[:, 0].astype(np.float32))

    def at_step(self, step: int) -> None:
        """Bring the pool to what it holds at `step`."""
        self._pool.at_step(step)

    def pairs_of(self, slots: Tensor) -> NDArray[np.intp]:
        """(k,) pairs that lie in slots of the pool."""
        return self._pool.pairs[slots.numpy()]

    def targets(self, slots: Tensor, texels: Tensor) -> Tensor:
        """(k, t, c) measured values under the pairs in `slots`; NaN where not measured."""
        rows, cols = texels // self._btf.shape[2], texels % self._btf.shape[2]
        images = torch.from_numpy(self._pool.images)
        values = images[slots[:, None], rows[None], cols[None]].float()
        factors = self._pool.factors(self.pairs_of(slots))
        return values if factors is None else values * torch.from_numpy(factors)[:, None]

    def probed(self, texels: Tensor, probes: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Values (t, k, c) of texels under probes, and their light and view (t or 1, k, 2)."""
        values = self.values[texels]
        chosen = self._probes
        if probes is not None:
            values, chosen = values[:, probes], chosen[probes.numpy()]
        light, view = self.directions(chosen, texels)
        return values.float(), light.transpose(0, 1), view.transpose(0, 1)

    def directions(self, pairs: NDArray[np.intp], texels: Tensor) -> tuple[Tensor, Tensor]:
        """x and y (k, t or 1, 2) of light and view of pairs (k,) at texels (t,)."""
        btf = self._btf
        found = []
        for far, near in ((btf.light, btf.light_position), (btf.view, btf.view_position)):
            unit = far[pairs][:, None]
            if near is not None:
                _, h, w, _ = btf.shape
                uv = texel_centres(h, w).reshape(-1, 2)[texels.numpy()]
                x, y = uv_places(uv, (h, w), btf.texel_mm or 1.0).T
                unit = directions_at(near[pairs][:, None], x, y)
            found.append(torch.from_numpy(np.asarray(unit[..., :2], np.float32).copy()))
        return found[0], found[1]
