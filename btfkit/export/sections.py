"""Text files of named sections, from which sources are put together."""

from __future__ import annotations

import re
from functools import cache
from importlib import resources

# A line that begins a section, in a comment of any language.
_MARK = re.compile(r"^(?://|#)@ (\S+)\n", re.MULTILINE)


@cache
def whole_text(name: str) -> str:
    """The file `name` in btfkit/export/text."""
    return resources.files("btfkit.export").joinpath("text", name).read_text(encoding="utf-8")


@cache
def sections(name: str) -> dict[str, str]:
    """Sections by name, in order, of the file `name` in btfkit/export/text."""
    _, *parts = _MARK.split(whole_text(name))
    return dict(zip(parts[::2], parts[1::2], strict=True))


def filled(text: str, **values: object) -> str:
    """`text` with every @name@ replaced by its value; ValueError for one that has none."""

    def value(match: re.Match[str]) -> str:
        if match[1] not in values:
            raise ValueError(f"no value for @{match[1]}@")
        return str(values[match[1]])

    return re.sub(r"@(\w+)@", value, text)
