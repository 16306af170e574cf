"""NeuBTF with heights: textures that an encoder gave, answered as NeuMIP answers.

Sources: Rodriguez-Pardo et al., "NeuBTF: Neural fields for BTF encoding and transfer", Computers &
Graphics 114, 2023, whose future work names a parallax module; Kuznetsov et al., "NeuMIP:
Multi-Resolution Neural Materials", ACM TOG 40(4), 2021.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar, final

import numpy as np
from numpy.typing import NDArray

from btfkit.footprint import level_sizes, most_levels
from btfkit.materials.base import Header
from btfkit.materials.neubtf.paper import NeuBTFPaper
from btfkit.materials.neumip.material import NeuMIPMaterial
from btfkit.materials.neumip.spec import NeuMIPSpec


@final
class NeuBTF(NeuMIPMaterial):
    """Heights and features of one guidance, and the decoder that they were fitted with."""

    model: ClassVar[str] = "neubtf"

    @staticmethod
    def of_finest(spec: NeuMIPSpec, weights: Mapping[str, NDArray[Any]], header: Header) -> NeuBTF:
        """A material whose coarser levels are means of its finest features.

        Args:
            spec: of a single level, or of any number: there will be a whole pyramid.
            weights: decoder, heights, and features `texture.0.0`; of other levels none counts.
        """
        levels = most_levels(spec.size)
        kept = {n: a for n, a in weights.items() if not n.startswith("texture.0.")}
        finest = weights["texture.0.0"]
        mean = finest.astype(np.float32)
        kept["texture.0.0"] = finest
        for level, size in enumerate(level_sizes(spec.size, levels)[1:], start=1):
            mean = averaged(mean, size)
            kept[f"texture.0.{level}"] = mean.astype(finest.dtype)
        return NeuBTF(replace(spec, levels=levels), kept, header)


AnyNeuBTF = NeuBTF | NeuBTFPaper


def averaged(x: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    """(*size, k) means of an image (h, w, k) over equal parts."""
    return _averaged(_averaged(x, size[0], axis=0), size[1], axis=1)


def _averaged(x: NDArray[np.float32], count: int, *, axis: int) -> NDArray[np.float32]:
    """Means over `count` equal parts of an axis; a texel that lies in two counts in both."""
    x = np.moveaxis(x, axis, 0)
    sums = np.concatenate([np.zeros_like(x[:1]), np.cumsum(x, axis=0, dtype=np.float64)])
    at = np.arange(count + 1) * (len(x) / count)
    low = np.minimum(at.astype(int), len(x) - 1)
    share = (at - low).reshape(-1, *[1] * (x.ndim - 1))
    upto = sums[low] + share * x[low]
    means = np.diff(upto, axis=0) * (count / len(x))
    return np.moveaxis(means, 0, axis).astype(np.float32)
