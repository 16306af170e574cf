"""How often a material goes around the balls of examples."""

from __future__ import annotations

from btfkit.program import Program

_TILES = 4.0


def tiles_around(program: Program) -> float:
    """Tiles around a ball: of a sample that does not tile one, less where poles would cut it."""
    return _TILES if program.wrap else min(1.0, 2 / program.aspect)
