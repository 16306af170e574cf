"""How far a run is, for whoever watches it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit.devices.capture.drift import Drift


@final
@dataclass(frozen=True, eq=False)
class Progress:
    """What a run looks like from outside.

    Attributes:
        done, total: groups. kind: of the present one. frames: so far, in this session.
        retries: repeated groups and exposures. drift: at the last look at the reference.
        image: the last frame.
    """

    done: int
    total: int
    kind: str
    frames: int
    retries: int
    drift: Drift | None
    image: NDArray[np.uint16]


Observer = Callable[[Progress], None]
