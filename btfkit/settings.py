"""Settings given as text, `key=value`: of models, of writers, of samples."""

from __future__ import annotations

import inspect
import types
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from btfkit.errors import meaning

T = TypeVar("T")

_TRUE, _FALSE = ("1", "true", "on", "yes"), ("0", "false", "off", "no")
# What every writer takes beside its own settings.
_COMMON = ("force", "progress")
_KINDS = {int: "a whole number", float: "a number", bool: "true or false"}


def split(text: str) -> tuple[str, str]:
    """`key=value` as a pair.

    Raises:
        ValueError: no key, or no equals sign.
    """
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise ValueError(f"{text!r}; expected key=value")
    return key, value


def as_text(settings: Mapping[str, Any]) -> dict[str, str]:
    """Settings as `--set` would say them, from text, numbers and booleans."""
    return {name: str(value) for name, value in settings.items()}


def parsed(kind: type[T], model: str, given: Mapping[str, str]) -> T:
    """A frozen dataclass of settings from text; each value has the type of its field.

    Raises:
        ValueError: an unknown name, with those there are, or a value that does not fit.
    """
    names = [field.name for field in fields(kind)]  # type: ignore[arg-type]
    unknown = sorted(given.keys() - set(names))
    if unknown:
        known = ", ".join(names) or "none"
        meant = "".join(meaning(name, names) for name in unknown)
        raise ValueError(f"{model} has no setting {', '.join(unknown)}{meant}; it has {known}")
    return kind(**_values(get_type_hints(kind), given))


def options_of(function: Callable[..., Any], given: Mapping[str, str]) -> dict[str, Any]:
    """Keyword options of a library function from text; each value has the type of its option.

    Raises:
        ValueError: an unknown name, with those there are, or a value that does not fit.
    """
    parameters = inspect.signature(function).parameters.values()
    names = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY and p.name not in _COMMON]
    unknown = sorted(given.keys() - set(names))
    if unknown:
        meant = "".join(meaning(name, names) for name in unknown)
        raise ValueError(
            f"no setting {', '.join(unknown)}{meant}; there are {', '.join(names) or 'none'}"
        )
    return _values(get_type_hints(function), given)


def _values(hints: Mapping[str, Any], given: Mapping[str, str]) -> dict[str, Any]:
    return {name: _value(name, hints[name], text) for name, text in given.items()}


def _value(name: str, hint: Any, text: str) -> Any:
    """The text as the first of bool, int, float and str that the hint allows and it fits."""
    union = get_origin(hint) is types.UnionType
    allowed = [kind for kind in (get_args(hint) if union else (hint,)) if kind is not type(None)]
    for kind in (bool, int, float):
        if kind in allowed:
            try:
                return _truth(text) if kind is bool else kind(text)
            except ValueError:
                continue
    expected = [_KINDS[kind] for kind in allowed if kind in _KINDS]
    if len(expected) == len(allowed):
        raise ValueError(f"{name} = {text!r}; expected {' or '.join(expected)}")
    return text


def truth(name: str, text: str) -> bool:
    """True or false of a setting's text; ValueError for anything else."""
    try:
        return _truth(text)
    except ValueError:
        raise ValueError(f"{name} = {text!r}; expected {_KINDS[bool]}") from None


def _truth(text: str) -> bool:
    if text.lower() not in _TRUE + _FALSE:
        raise ValueError
    return text.lower() in _TRUE
