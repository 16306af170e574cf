"""Numbers as C++ and shaders write them."""

from __future__ import annotations

from typing import Any

import numpy as np


def literal(value: Any) -> str:
    """A float32 as text, the shortest that reads as the same; without C++'s f."""
    text = str(np.float32(value))
    return text if any(c in text for c in ".en") else text + ".0"
