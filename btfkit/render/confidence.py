"""A material as what is known of it: grey where answers were measured, orange where guessed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, final

import numpy as np

from btfkit.btf import RGB
from btfkit.coverage import UNKNOWN
from btfkit.materials.base import Array, Material
from btfkit.queries import Query

_MEASURED = np.array([0.75, 0.75, 0.75], np.float32)
_GUESSED = np.array([0.95, 0.30, 0.02], np.float32)


@final
@dataclass(frozen=True)
class ConfidenceSpec:
    """Nothing decides a shape."""


@final
class Confidence(Material):
    """A diffuse surface, coloured by how far the answers of another material were measured.

    Raises:
        ValueError: the other material does not say what was measured.
    """

    model: ClassVar[str] = "confidence"
    spec_type: ClassVar[type] = ConfidenceSpec
    has_levels: ClassVar[bool] = True
    has_curvature: ClassVar[bool] = True

    def __init__(self, material: Material) -> None:
        if material.header.coverage is None and not material.computed:
            raise ValueError(
                f"{material.model}: {UNKNOWN}; fit it again, or leave out --show-confidence"
            )
        super().__init__(ConfidenceSpec(), {}, replace(material.header, channels=RGB))
        self._of = material

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self._of,)

    @classmethod
    def shapes(cls, spec: ConfidenceSpec, header: Any) -> dict[str, tuple[int, ...]]:
        return {}

    def _answer(self, query: Query) -> tuple[Array, Array | None]:
        known = self._of.confidence(query.light, query.view)[:, None]
        colour = known * _MEASURED + (1 - known) * _GUESSED
        return (colour * query.light[:, 2:]).astype(np.float32), None
