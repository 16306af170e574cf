"""A factorised BTF as it is used: textures of coefficients times a table over the pairs.

Source: Koudelka et al., "Acquisition, compression, and synthesis of bidirectional texture
functions", Texture 2003; the compressed domain is that of Müller, "Data-driven methods for
compression and editing of spatially varying appearance", 2009 (full matrix factorisation).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, final

import numpy as np
from numpy.typing import NDArray

from btfkit.materials.base import Array, Header, Material
from btfkit.materials.bilinear import lookup
from btfkit.materials.measured.blend import Blend
from btfkit.materials.measured.interpolation import GRAZING
from btfkit.nearfield import uv_places
from btfkit.queries import Query

Domain = Literal["log", "linear"]
# sinh of more has no use in float32.
_MOST_LOG = 20.0
_BLOCK = 1 << 13


@final
@dataclass(frozen=True)
class PCASpec:
    """All that decides the shapes of a factorised BTF, and the domain it is factorised in.

    Attributes:
        pairs: rows of the table. size: (h, w). channels: of the answer.
        ranks: components of each factorisation: one for all channels, or one a channel.
        domain: "log" factorises asinh(value / floor), "linear" the values.
        floor: values below it count linearly in the domain "log".
        positions: which of light_position, view_position there are.
    """

    pairs: int
    size: tuple[int, int]
    channels: int
    ranks: tuple[int, ...]
    domain: Domain = "log"
    floor: float = 1.0
    positions: tuple[str, ...] = ()


@final
class PCA(Material):
    """value(pair, texel, channel) = decode(sum_k table[pair, channel, k] x texture[texel, k]).

    Between measured pairs the rows of the table are blended as `Interpolation` blends textures;
    the cosine of the light is put right afterwards.
    """

    model: ClassVar[str] = "pca"
    spec_type: ClassVar[type] = PCASpec

    def __init__(self, spec: PCASpec, weights: Mapping[str, NDArray[Any]], header: Header) -> None:
        super().__init__(spec, weights, header)
        if spec.domain not in ("log", "linear") or not spec.floor > 0:
            raise ValueError(f"domain = {spec.domain!r}, floor = {spec.floor}; expected log, > 0")
        self._blend = Blend.of(self.weights)
        if self._blend.near and header.texel_mm is None:
            raise ValueError("positions in mm need texel_mm, which the header does not know")
        self._factors = [
            tuple(np.asarray(self.weights[f"{kind}.{k}"], np.float32) for kind in _KINDS)
            for k in range(len(spec.ranks))
        ]

    @classmethod
    def shapes(cls, spec: PCASpec, header: Header) -> dict[str, tuple[int, ...]]:
        names = ("light", "view", *spec.positions)
        found: dict[str, tuple[int, ...]] = dict.fromkeys(names, (spec.pairs, 3))
        if len(spec.ranks) not in (1, spec.channels):
            raise ValueError(f"{len(spec.ranks)} ranks for {spec.channels} channels")
        each = spec.channels if len(spec.ranks) == 1 else 1
        for k, rank in enumerate(spec.ranks):
            found[f"texture.{k}"] = (*spec.size, rank)
            found[f"table.{k}"] = (spec.pairs, each, rank)
        return found

    def _answer(self, query: Query) -> tuple[Array, Array | None]:
        out = np.empty((len(query.uv), self.spec.channels), np.float32)
        for start in range(0, len(out), _BLOCK):
            part = Query(*(values[start : start + _BLOCK] for values in query))
            out[start : start + _BLOCK] = self._blended(part)
        return out, None

    def _blended(self, query: Query) -> Array:
        at = None
        if self._blend.near:
            at = uv_places(query.uv, self.spec.size, self.header.texel_mm or 1.0)
        pair, weight = self._blend.weights(query.light, query.view, at)
        if pair.strides[0] == 0:
            # One direction for all: its row of the table is blended once.
            pair, weight = pair[:1], weight[:1]
        parts = []
        for texture, table in self._factors:
            row = np.zeros((len(pair), *table.shape[1:]), np.float32)
            for k in range(pair.shape[1]):
                row += weight[:, k, None, None] * table[pair[:, k]]
            texel = lookup(texture, query.uv, self.header.wrap)
            parts.append(texel @ row[0].T if len(row) == 1 else np.einsum("bck,bk->bc", row, texel))
        value = decoded(np.concatenate(parts, axis=1), self.spec.domain, self.spec.floor)
        blended = np.sum(weight * np.maximum(self._blend.cosines(pair, at), GRAZING), axis=1)
        falloff = np.maximum(query.light[:, 2], GRAZING) / blended
        return np.maximum(value * falloff[:, None], 0).astype(np.float32)


_KINDS = ("texture", "table")


def encoded(value: NDArray[np.floating], domain: Domain, floor: float) -> NDArray[np.floating]:
    """Reflectance (...) in the domain that is factorised; any sign, NaN stays NaN."""
    return np.arcsinh(value / floor) if domain == "log" else value


def decoded(value: NDArray[np.floating], domain: Domain, floor: float) -> NDArray[np.floating]:
    """The inverse of `encoded`."""
    if domain == "linear":
        return value
    return np.sinh(np.clip(value, -_MOST_LOG, _MOST_LOG)) * np.asarray(floor, value.dtype)
