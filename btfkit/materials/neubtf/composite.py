"""Several NeuBTFs on one guidance: a picture of labels says which one answers where.

All share one relief, each texel's height being that of its own material; a view ray ends on it
once, and the label where it ends decides. Coarser levels of detail mix by the area of each.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar, final

import numpy as np
from numpy.typing import NDArray

from btfkit.footprint import level_sizes, most_levels
from btfkit.jsonvalues import tuples
from btfkit.materials.base import Array, Header, Material
from btfkit.materials.neubtf.material import NeuBTF, averaged
from btfkit.materials.neumip.spec import NeuMIPSpec
from btfkit.native.neural.lookup import bilinear
from btfkit.native.neural.plain import step
from btfkit.program import Program
from btfkit.queries import Query

# As many as a byte tells apart.
MOST_PARTS = 256


@final
@dataclass(frozen=True)
class CompositeSpec:
    """What decides the shapes: `size` (h, w) of the labels, and the spec of each part."""

    size: tuple[int, int]
    parts: tuple[NeuMIPSpec, ...]

    def __post_init__(self) -> None:
        # A file holds dicts and lists.
        parts = tuple(p if isinstance(p, NeuMIPSpec) else _spec_of(p) for p in self.parts)
        object.__setattr__(self, "parts", parts)
        if not 2 <= len(parts) <= MOST_PARTS:
            raise ValueError(f"{len(parts)} materials; expected 2 to {MOST_PARTS}")
        if any(part.size != self.size for part in parts):
            sizes = ", ".join(str(part.size) for part in parts)
            raise ValueError(f"materials of {sizes} texels; expected {self.size} as the labels")


@final
class Composite(Material):
    """Materials side by side by label: each is evaluated where it shows, and only there."""

    model: ClassVar[str] = "composite"
    spec_type: ClassVar[type] = CompositeSpec
    has_levels: ClassVar[bool] = True

    def __init__(
        self, spec: CompositeSpec, weights: Mapping[str, NDArray[Any]], header: Header
    ) -> None:
        super().__init__(spec, weights, header)
        self.parts = tuple(
            NeuBTF(part, _of_part(k, self.weights), header) for k, part in enumerate(spec.parts)
        )
        labels = self.weights["labels"]
        if labels.max() >= len(spec.parts):
            raise ValueError(f"a label of {labels.max()} for {len(spec.parts)} materials")
        shares = (labels[..., None] == np.arange(len(spec.parts))).astype(np.float32)
        sizes = level_sizes(spec.size, most_levels(spec.size))
        self._shares = [averaged(shares, size) for size in sizes]

    @classmethod
    def shapes(cls, spec: CompositeSpec, header: Header) -> dict[str, tuple[int, ...]]:
        found: dict[str, tuple[int, ...]] = {"labels": spec.size}
        for k, part in enumerate(spec.parts):
            found |= {f"part.{k}.{n}": shape for n, shape in NeuBTF.shapes(part, header).items()}
        return found

    @staticmethod
    def of(parts: Sequence[NeuBTF], labels: NDArray[Any], header: Header) -> Composite:
        """Materials of one guidance where `labels` (h, w), 0 to parts - 1, say.

        Raises:
            ValueError: of different sizes, or of channels other than the header's.
        """
        for part in parts:
            if part.header.channels != header.channels:
                raise ValueError(
                    f"channels {', '.join(part.header.channels)} and "
                    f"{', '.join(header.channels)}; materials side by side share theirs"
                )
        size: tuple[int, int] = (labels.shape[0], labels.shape[1])
        spec = CompositeSpec(size, tuple(part.spec for part in parts))
        texels = np.zeros(size)
        for k, part in enumerate(parts):
            heights = part.weights["texture.heights"][..., 0].astype(float)
            texels = np.where(labels == k, heights * part.spec.depth_scale, texels)
        weights: dict[str, NDArray[Any]] = {"labels": labels.astype(np.uint8)}
        for k, part in enumerate(parts):
            weights |= {f"part.{k}.{name}": array for name, array in part.weights.items()}
            kind = part.weights["texture.heights"].dtype
            shared = (texels / part.spec.depth_scale)[..., None].astype(kind)
            weights[f"part.{k}.texture.heights"] = shared
        return Composite(spec, weights, header)

    def _answer(self, query: Query) -> tuple[Array, Array | None]:
        shares = self._shared(query)
        out = np.zeros((len(query.uv), len(self.header.channels)), np.float32)
        for k, part in enumerate(self.parts):
            rows = np.flatnonzero(shares[:, k] > 0)
            if len(rows):
                some = Query(*(np.ascontiguousarray(column[rows]) for column in query))
                out[rows] += shares[rows, k, None] * part._answer(some)[0]
        return out, None

    def _shared(self, query: Query) -> Array:
        """(b, parts) how much of each shows, where view rays end."""
        depth = self.parts[0].depths(query.uv, query.view)
        at = query.uv + depth[:, None] * step(query.view, self.header.aspect)
        level = np.log2(np.maximum(2 * query.footprint, 1))
        level = np.minimum(level, len(self._shares) - 1)
        found = np.zeros((len(at), len(self.parts)), np.float32)
        for k, shares in enumerate(self._shares):
            weight = np.maximum(0, 1 - np.abs(level - k))
            rows = np.flatnonzero(weight)
            if len(rows):
                seen = bilinear(shares, at[rows], wrap=self.header.wrap == "wrap")
                found[rows] += weight[rows, None] * seen
        return found

    def ray_depths(self, uv: Array, view: Array) -> Array:
        return self.parts[0].depths(uv, view)

    def program(self) -> Program:
        raise TypeError(
            f"composite answers by {len(self.parts)} networks and has no program of one; "
            "export the materials before they are put together"
        )


def _of_part(k: int, weights: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    prefix = f"part.{k}."
    return {n.removeprefix(prefix): a for n, a in weights.items() if n.startswith(prefix)}


def _spec_of(described: Mapping[str, Any]) -> NeuMIPSpec:
    known = {field.name for field in fields(NeuMIPSpec)}
    if unknown := described.keys() - known:
        raise ValueError(f"a material with {', '.join(sorted(unknown))}")
    return NeuMIPSpec(**tuples(described))
