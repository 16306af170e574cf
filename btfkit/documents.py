"""JSON documents as people write them: read strictly, written whole, and their hash."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from btfkit.errors import FormatError
from btfkit.files import whole

# A document of more bytes than this was not written by a person or by this toolkit.
_MOST_BYTES = 1 << 26


def load(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The object that a JSON file holds.

    Raises:
        FileNotFoundError: there is no such file.
        FormatError: no JSON object, a key twice in one object, or NaN and Infinity.
    """
    file = Path(path)
    if file.stat().st_size > _MOST_BYTES:
        raise FormatError(file, f"is larger than {_MOST_BYTES} bytes")
    try:
        return parse(file.read_text(encoding="utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise FormatError(file, f"not a JSON document ({error})") from error


def parse(text: str) -> dict[str, Any]:
    """The object that a text holds.

    Raises:
        ValueError: as `load`'s FormatError.
    """
    found = json.loads(text, parse_constant=_refused, object_pairs_hook=_once)
    if not isinstance(found, dict):
        raise ValueError("holds no object")
    return found


def save(path: str | os.PathLike[str], document: Mapping[str, Any], *, force: bool = False) -> None:
    """Write a document whole under its name or not at all."""
    with whole(path, force=force) as partial:
        text = json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False)
        partial.write_text(text + "\n", encoding="utf-8")


def fingerprint(document: Mapping[str, Any]) -> str:
    """SHA-256 of a document's content, whatever the order of its keys and its spaces."""
    text = json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _refused(constant: str) -> float:
    raise ValueError(f"{constant} is no JSON number")


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        again = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the key {again[:60]!r} stands twice in one object")
    return found
