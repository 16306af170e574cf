"""A fixed, small sample of the held-out pairs that scores a model while it is fitted."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from btfkit.btf import BTF


@final
class HeldOutSample:
    """Some texels of some held-out pairs, the same ones in every pair.

    Attributes:
        pairs: (k,) of the BTF, perhaps none. texels: (t,) flat numbers of texels.
    """

    def __init__(self, btf: BTF, pairs: NDArray[np.intp], *, most: int, texels: int) -> None:
        rng = np.random.default_rng(0)
        _, h, w, _ = btf.shape
        self.pairs = rng.permutation(pairs)[:most]
        texel = rng.integers(h * w, size=texels)
        self.texels = torch.from_numpy(texel)
        self.rows, self.cols = torch.from_numpy(texel // w), torch.from_numpy(texel % w)
        rows, cols = np.divmod(texel, w)
        values = [torch.from_numpy(btf.texture(int(pair))[rows, cols]) for pair in self.pairs]
        self._target = torch.stack(values) if values else torch.zeros(0, texels, btf.shape[3])

    def score(self, predict: Callable[[HeldOutSample], Tensor]) -> float:
        """Mean squared error of log(1 + rgb), given as (k, t, c); NaN without held-out pairs."""
        if not len(self.pairs):
            return math.nan
        predicted = predict(self)
        measured = torch.isfinite(self._target)
        wanted = torch.log1p(torch.where(measured, self._target, 0.0).clamp_min(-0.1))
        error = torch.where(measured, predicted - wanted, 0.0).square()
        return float(error.sum() / measured.sum().clamp_min(1))
