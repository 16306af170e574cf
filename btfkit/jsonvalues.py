"""Values as JSON can hold them."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from typing import Any

from btfkit.remote import Remote


def plain(value: Any) -> Any:
    """`value` in JSON's own types: paths and URLs as text, arrays as lists, no number as text."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        if set(map(type, value)) == {int}:
            return list(value)
        return [plain(item) for item in value]
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, Remote):
        return value.url
    # Not by its class: the command line answers --help without numpy.
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return str(float(value))
    return value


def tuples(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a record as JSON holds them, with tuples where JSON has lists."""
    return {name: tuple(v) if isinstance(v, list) else v for name, v in fields.items()}
