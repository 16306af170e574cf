"""Settings given as text, as a model's frozen dataclass."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, TypeVar

T = TypeVar("T")

_TRUE, _FALSE = ("1", "true", "on", "yes"), ("0", "false", "off", "no")


def parsed(kind: type[T], model: str, given: Mapping[str, str]) -> T:
    """A dataclass of settings from text; each value has the type of its default.

    A default of None stands for a number that is not set.

    Raises:
        ValueError: an unknown name, with those there are, or a value that does not fit.
    """
    defaults: dict[str, Any] = {f.name: f.default for f in fields(kind)}  # type: ignore[arg-type]
    unknown = sorted(given.keys() - defaults.keys())
    if unknown:
        known = ", ".join(defaults) or "none"
        raise ValueError(f"{model} has no setting {', '.join(unknown)}; it has {known}")
    return kind(**{name: _value(name, defaults[name], text) for name, text in given.items()})


def _value(name: str, default: Any, text: str) -> Any:
    if isinstance(default, str):
        return text
    if isinstance(default, bool):
        if text.lower() not in _TRUE + _FALSE:
            raise ValueError(f"{name} = {text!r}; expected true or false")
        return text.lower() in _TRUE
    number = float if default is None else type(default)
    try:
        return number(text)
    except ValueError as error:
        kind = "a whole number" if number is int else "a number"
        raise ValueError(f"{name} = {text!r}; expected {kind}") from error
