"""What texts say of curvature: nothing where answers do not depend on it."""

from __future__ import annotations

import numpy as np

from btfkit.conventions import (
    CURVATURE_UNIT,
    CURVED_FINER,
    LOWEST_SEEN,
    MOST_BEND,
    SLACK,
)
from btfkit.export.numbers import literal
from btfkit.native.neural import bent
from btfkit.program import Heights, Program


def words(program: Program) -> dict[str, object]:
    """What examples in Python say where they take queries.

    `columns` is how many numbers a query has: u, v, light, view, footprint, curvature.
    """
    if not program.bends:
        return {**dict.fromkeys(("word", "given", "flat", "filed"), ""), "columns": 9}
    return {
        "word": ", curvature",
        "given": ", curvature=None",
        "flat": "    curvature = np.zeros(len(uv)) if curvature is None else curvature\n",
        "filed": ', Q["curvature"] if "curvature" in Q else None',
        "columns": 10,
    }


def softened() -> str:
    """A curvature as layers take it, in shaders."""
    return f"curvature / (abs(curvature) + {literal(CURVATURE_UNIT)})"


def numbers(found: Heights) -> dict[str, object]:
    """Numbers of curved heights, as shaders have them."""
    top, bottom = max(float(found.heights.max()), 0.0), min(float(found.heights.min()), 0.0)
    low, high = bent.sharpest(found)
    return {
        "holes": "false" if found.opacity is None else "true",
        "least_bend": literal(-MOST_BEND / max(top, 1e-6)),
        "most_bend": literal(MOST_BEND / max(-bottom, 1e-6)),
        "surface": literal(top), "bottom": literal(bottom),
        "flattest": literal(max(low, -1e30)), "sharpest": literal(min(high, 1e30)),
        "finer": literal(CURVED_FINER), "more_looks": found.looks, "seen": literal(LOWEST_SEEN),
    }  # fmt: skip


def hole(found: Heights, solid: str) -> str:
    """A statement that lets a ray fall through where there is nothing.

    Args:
        solid: opacity of the heights at the place `at`.
    """
    reach = bent.hole_range(found)
    slack, span = literal(np.float32(SLACK * reach)), literal(reach)
    return f"  gap = max(gap - {slack}, (0.5 - {solid}) * {span});\n"
