"""What a verb says of a material's answers that were not measured."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from btfkit.coverage import Coverage


class Guessed(NamedTuple):
    """The end of a line for people, perhaps empty, and `coverage` for scripts."""

    line: str
    data: Mapping[str, Any]


def of_coverage(coverage: Coverage | None) -> Guessed:
    """What is to be said; of a material that does not know what was measured, nothing."""
    if coverage is None:
        return Guessed("", {})
    said = coverage.said()
    return Guessed(f"\n  {said}" if said else "", {"coverage": coverage.described()})
