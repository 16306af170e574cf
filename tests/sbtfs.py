"""SBTFs of heights that a test gives."""

from __future__ import annotations

from typing import Any

import numpy as np

from btfkit.materials.base import Header
from btfkit.materials.neumip.arrays import aligned, name_arrays
from btfkit.materials.neumip.spec import NeuMIPSpec
from btfkit.materials.sbtf.material import SBTF


def random_sbtf(heights: np.ndarray, **changes: Any) -> SBTF:
    """Random weights over given heights, tile widths."""
    spec = NeuMIPSpec(heights.shape, offset=0, heights=True, curved=True, **changes)
    header, rng = Header(grid=heights.shape), np.random.default_rng(2)
    case = spec.layout(header)
    weights = (0.3 * rng.standard_normal(case.weights)).astype(np.float32)
    texels = aligned(case.texels)
    texels[:] = rng.standard_normal(texels.shape)
    case.surface(texels)[:] = heights / spec.depth_scale
    return SBTF(spec, name_arrays(spec, case, weights, texels), header)
