"""How fast a training goes at which time of its budget."""

from __future__ import annotations

import math


def pace(progress: float, *, warm_up: float, head_start: float, least: float = 0.0) -> float:
    """Factor on learning rates: a warm-up, then half a cosine from 1 to `least`.

    Args:
        progress: share of the budget that is spent, 0..1.
        warm_up: share of the budget over which rates rise, from that of `head_start` on.
        least: what the cosine ends at.
    """
    cosine = 0.5 + 0.5 * math.cos(math.pi * progress)
    return min(1.0, (progress + head_start) / warm_up) * (least + (1 - least) * cosine)
