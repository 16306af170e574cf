"""Numbers as C++ and shaders write them."""

from __future__ import annotations

from typing import Any

import numpy as np


def literal(value: Any) -> str:
    """A float32 as text, the shortest that reads as the same; without C++'s f.

    Not `str`: what that gives depends on how numpy was told to print, which libraries change.
    """
    number = np.float32(value)
    if number == 0 or 1e-4 <= abs(number) < 1e16:
        return np.format_float_positional(number, unique=True, trim="0")
    return np.format_float_scientific(number, unique=True, trim="0")
