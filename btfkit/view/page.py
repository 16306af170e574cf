"""The parts of a page: templates, and values that may stand within them."""

from __future__ import annotations

import html
import json
import re
from functools import cache
from importlib import resources
from typing import Any

from btfkit import jsonvalues
from btfkit.export.sections import filled

_MARK = re.compile(r"^//@ (\S+)\n", re.MULTILINE)


def composed(body: str, script: str, *, title: str, **values: str) -> str:
    """A whole page of a body and its script."""
    text = section("page.html.txt", "head") + section("page.html.txt", body)
    return filled(
        text, title=html.escape(title), style=_text("page.css"), script=_text(script), **values
    )


def styled(body: str, *, title: str) -> str:
    """A whole page without a script."""
    return filled(
        section("page.html.txt", "head") + body, title=html.escape(title), style=_text("page.css")
    )


def in_script(value: Any) -> str:
    """A value as JSON that may stand in a script, whatever text it holds."""
    text = json.dumps(jsonvalues.plain(value), allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def section(name: str, part: str) -> str:
    """A section of a file in btfkit/view/text."""
    _, *parts = _MARK.split(_text(name))
    return dict(zip(parts[::2], parts[1::2], strict=True))[part]


@cache
def _text(name: str) -> str:
    return resources.files("btfkit.view").joinpath("text", name).read_text(encoding="utf-8")
