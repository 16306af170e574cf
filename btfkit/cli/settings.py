"""Settings given as text, matched to the keyword options of a library function."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Mapping
from typing import Any


def matched(function: Callable[..., Any], settings: Mapping[str, str]) -> dict[str, Any]:
    """Options for `function` from text: numbers, true and false become values.

    Raises:
        ValueError: a setting that `function` has no keyword for; the message lists them.
    """
    parameters = inspect.signature(function).parameters.values()
    known = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY]
    known = [name for name in known if name not in ("force", "progress")]
    unknown = sorted(settings.keys() - set(known))
    if unknown:
        raise ValueError(f"no setting {', '.join(unknown)}; there are {', '.join(known) or 'none'}")
    return {key: _value(text) for key, text in settings.items()}


def _value(text: str) -> Any:
    try:
        value = json.loads(text)
    except ValueError:
        return text
    return value if isinstance(value, (bool, int, float)) else text
