"""A BTF as a material: its own textures, blended over light and view directions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, final

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import BTF
from btfkit.materials.base import Array, Header, Material
from btfkit.materials.bilinear import corners
from btfkit.materials.measured.blend import Blend, Nest, pair_arrays
from btfkit.nearfield import uv_places
from btfkit.queries import Query

# Below this cosine a light grazes, and a quotient by it is noise.
GRAZING = 0.05
# What a pair of weight 0 answers with where none that has weight is measured.
_LAST_RESORT = 1e-3
# Queries looked up at once: where textures are decoded, more of them corner_weight each decoding.
_BLOCK, _LAZY_BLOCK = 1 << 14, 1 << 17


@final
@dataclass(frozen=True)
class InterpolationSpec:
    """All that decides the shapes of an interpolation.

    Attributes:
        pairs: n. size: (h, w). channels: c.
        valid: images of the mask of measured texels: 0 where all are, 1, or n.
        positions: which of light_position, view_position there are.
    """

    pairs: int
    size: tuple[int, int]
    channels: int = 3
    valid: int = 0
    positions: tuple[str, ...] = ()


@final
class Interpolation(Material):
    """The measured textures: exact at measured pairs, barycentric between them.

    What is blended between lights is value / cosine of the light, so that a diffuse material is
    exact everywhere; towards the horizon the lowest measured directions go on. Texels that are
    not measured leave their weight to the others.
    """

    model: ClassVar[str] = "interpolation"
    spec_type: ClassVar[type] = InterpolationSpec

    def __init__(
        self, spec: InterpolationSpec, weights: Mapping[str, NDArray[Any]], header: Header
    ) -> None:
        super().__init__(spec, weights, header)
        texture: Any = self.weights["texture"]
        self._btf = BTF(
            texture,
            self.weights["light"],
            self.weights["view"],
            validity=self.weights.get("texture.valid"),
            channels=header.channels,
        )
        self._blend = Blend.of(self.weights)
        self._in_memory = isinstance(texture, np.ndarray)
        if self._blend.near and header.texel_mm is None:
            raise ValueError("positions in mm need texel_mm, which the header does not know")

    @staticmethod
    def of(btf: BTF) -> Interpolation:
        """A BTF of any size as a material; texels are read when queries ask for them.

        Raises:
            ValueError: no pair is lit from above the horizon.
        """
        weights: dict[str, Any] = {"texture": btf.textures, **pair_arrays(btf)}
        if btf.validity is not None:
            weights["texture.valid"] = btf.validity
        return Interpolation(spec_of(btf), weights, Header.of(btf))

    def nest(self) -> Nest:
        """Its pairs as one table; TypeError where views have lights of their own, or near ones."""
        return self._blend.nest()

    def light_cosines(self) -> Array:
        """(n,) of the lights of the pairs."""
        return np.asarray(self.weights["light"], np.float32)[:, 2]

    def texture(self, pair: int) -> Array:
        """(h, w, c) of a pair; NaN where it is not measured."""
        values = np.array(self._btf.texture(pair), np.float32)
        valid = self._btf.validity
        if valid is not None:
            values[~np.asarray(valid[pair if len(valid) > 1 else 0], bool)] = np.nan
        return values

    @classmethod
    def shapes(cls, spec: InterpolationSpec, header: Header) -> dict[str, tuple[int, ...]]:
        names = ("light", "view", *spec.positions)
        found: dict[str, tuple[int, ...]] = dict.fromkeys(names, (spec.pairs, 3))
        found["texture"] = (spec.pairs, *spec.size, spec.channels)
        if spec.valid:
            found["texture.valid"] = (spec.valid, *spec.size)
        return found

    def _answer(self, query: Query) -> tuple[Array, Array | None]:
        out = np.empty((len(query.uv), self.spec.channels), np.float32)
        block = _BLOCK if self._in_memory else _LAZY_BLOCK
        for start in range(0, len(out), block):
            part = Query(*(values[start : start + block] for values in query))
            out[start : start + block] = self._blended(part)
        return out, None

    def _blended(self, query: Query) -> Array:
        at = None
        if self._blend.near:
            at = uv_places(query.uv, self.spec.size, self.header.texel_mm or 1.0)
        pair, weight = self._blend.weights(query.light, query.view, at)
        rows, cols, corner_weight = corners(query.uv, self.spec.size, self.header.wrap)
        falloff = np.maximum(query.light[:, 2:], GRAZING) / np.maximum(
            self._blend.cosines(pair, at), GRAZING
        )
        value, found = self._gathered(pair, weight, rows, cols, corner_weight, falloff)
        lost = np.flatnonzero((found <= 0).any(axis=1))
        if lost.size:
            again, found_again = self._gathered(
                pair[lost], weight[lost] + _LAST_RESORT, rows[lost], cols[lost],
                corner_weight[lost] + _LAST_RESORT, falloff[lost],
            )  # fmt: skip
            value[lost] = np.where(found[lost] > 0, value[lost], again)
            found[lost] = np.where(found[lost] > 0, found[lost], found_again)
        return np.where(found > 0, value / np.where(found > 0, found, 1), 0).astype(np.float32)

    def _gathered(
        self, pair: Any, weight: Any, rows: Any, cols: Any, corner_weight: Any, falloff: Any
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Weighted sums (b, c) of what is measured, and of the weights that it has."""
        b, c = len(pair), self.spec.channels
        total = weight[:, :, None] * corner_weight[:, None, :]
        query, which, corner = np.nonzero(total)
        pairs = pair[query, which]
        values = self._btf.texels(pairs, rows[query, corner], cols[query, corner])
        total = total[query, which, corner].astype(np.float64)
        scale = falloff[query, which]
        measured = np.isfinite(values)
        value, found = np.empty((b, c)), np.empty((b, c))
        for channel in range(c):
            good = measured[:, channel] * total
            found[:, channel] = np.bincount(query, good, b)
            seen = np.where(measured[:, channel], values[:, channel], 0) * scale
            value[:, channel] = np.bincount(query, good * seen, b)
        return value, found


def spec_of(btf: BTF) -> InterpolationSpec:
    """The shapes of a BTF's interpolation."""
    n, h, w, c = btf.shape
    positions = tuple(name for name in pair_arrays(btf) if name.endswith("_position"))
    valid = 0 if btf.validity is None else len(btf.validity)
    return InterpolationSpec(n, (h, w), c, valid, positions)
