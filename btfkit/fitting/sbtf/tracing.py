"""What `sbtf` learns of a relief: queries on the plane, on convex and on concave surfaces."""

from __future__ import annotations

from btfkit.queries import QuerySet
from btfkit.relief.relief import Relief
from btfkit.relief.trace import random_queries

# Queries a texel, as NeuMIP has them, and of all at most.
_A_TEXEL, _MOST = 200, 1 << 21
# Curvature times depth of the relief that is traced, and the lowest curvature, 1 / tile width, of
# reliefs so shallow that theirs would be no curvature any more.
_BENDS, _SHARPEST = (0.02, 0.85), 32.0
# Views below meet silhouettes of nearly flat surfaces, which geometry knows already.
_LOWEST_Z = 0.03
_SAMPLES = 4


def queries_of(relief: Relief, *, seed: int, a_texel: int = 0) -> QuerySet:
    """Traced answers of a relief under its surface: views from above, lights all round.

    Args:
        a_texel: how many; 0 takes what `sbtf` is fitted to.
    """
    h, w = relief.size
    depth = float(relief.height.max() - relief.height.min())
    sharpest = min(_BENDS[1] / max(depth, 1e-9), _SHARPEST)
    return random_queries(
        relief,
        min((a_texel or _A_TEXEL) * h * w, _MOST),
        seed=seed,
        curvatures=(sharpest * _BENDS[0] / _BENDS[1], sharpest),
        lowest_z=_LOWEST_Z,
        samples=_SAMPLES,
    )
