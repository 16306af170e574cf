"""Values as JSON can hold them."""

from __future__ import annotations

import json
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


def by_line(value: Any, indent: str = "") -> str:
    """JSON of what `plain` gave, an entry a line; lists of numbers and words stand on one.

    json indents every number, in Python: a second for the rows that a query file holds out.
    """
    deeper = indent + " "
    if isinstance(value, dict) and value:
        entries = [f"{json.dumps(key)}: {by_line(item, deeper)}" for key, item in value.items()]
        around = "{}"
    elif isinstance(value, list) and not {dict, list}.isdisjoint(map(type, value)):
        entries, around = [by_line(item, deeper) for item in value], "[]"
    else:
        return json.dumps(value, allow_nan=False)
    lines = f",\n{deeper}".join(entries)
    return f"{around[0]}\n{deeper}{lines}\n{indent}{around[1]}"


def tuples(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a record as JSON holds them, with tuples where JSON has lists."""
    return {name: tuple(v) if isinstance(v, list) else v for name, v in fields.items()}
