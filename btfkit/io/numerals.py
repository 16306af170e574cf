"""Numbers in the text files of others: with a point or a comma, whatever machine reads them.

No locale decides: one comma between digits and no point is a decimal comma, and a line whose
commas may be either is refused where it is read.
"""

from __future__ import annotations

import math
import re

_NUMBER = re.compile(r"[-+]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][-+]?\d+)?", re.ASCII)
# Excel writes "1,000" for a thousand where the comma is no decimal sign.
_GROUPED = re.compile(r"[-+]?[1-9]\d{0,2}(?:,\d{3})+", re.ASCII)
_LONGEST = 64
# Between the words of a line, commas aside. A no-break space is what tables of the web have.
_BETWEEN = " \t;\u00a0"
_STRONG = re.compile(f"[{_BETWEEN}]+")


def number(word: str) -> float | None:
    """The number that a word is, decimal point or comma; None where it is none or not finite."""
    if len(word) > _LONGEST or not _NUMBER.fullmatch(word):
        return None
    value = float(word.replace(",", "."))
    return value if math.isfinite(value) else None


def is_grouped(word: str) -> bool:
    """Whether a word may be a number whose comma groups thousands."""
    return _GROUPED.fullmatch(word) is not None


def numbers(line: str, count: int) -> list[float] | None:
    """The `count` numbers of a line, between white space or semicolons, or between commas.

    Where white space or semicolons part so many, commas within are decimal ones. None where there
    are not so many.
    """
    plain = line.strip(_BETWEEN + ",")
    words = [word.rstrip(",") for word in _STRONG.split(plain)]
    return _all(words, count) or _all([word.strip(_BETWEEN) for word in plain.split(",")], count)


def named_numbers(line: str, count: int) -> tuple[str, list[float]] | None:
    """A name, which may hold separators itself, and the last `count` numbers; None otherwise.

    Where commas alone separate, no number has a point, and the name seems to end in one more, they
    may as well be decimal commas: None.
    """
    rest, words = _from_right(line.rstrip(_BETWEEN + ","), count)
    found = _all([word.rstrip(",") for word in words], count)
    if found is not None:
        return rest.rstrip(_BETWEEN + ","), found
    head, *tail = line.rstrip(_BETWEEN + ",").rsplit(",", count - 1)
    cut = max(head.rfind(each) for each in _BETWEEN + ",") + 1
    words = [head[cut:], *(word.strip(_BETWEEN) for word in tail)]
    name = head[:cut].rstrip(_BETWEEN + ",")
    found = _all(words, count)
    bare = not any("." in word for word in words)
    if found is None or (bare and number(name.rsplit(",", 1)[-1].strip(_BETWEEN)) is not None):
        return None
    return name, found


def _from_right(line: str, count: int) -> tuple[str, list[str]]:
    """What is left of the last `count` words, and they.

    One pass: an expression for the whole line would go through it over and over.
    """
    words: list[str] = []
    for _ in range(count):
        line = line.rstrip(_BETWEEN)
        cut = max(line.rfind(each) for each in _BETWEEN) + 1
        words.insert(0, line[cut:])
        line = line[:cut]
    return line, words


def _all(words: list[str], count: int) -> list[float] | None:
    values = [value for word in words if (value := number(word)) is not None]
    return values if len(words) == len(values) == count else None
