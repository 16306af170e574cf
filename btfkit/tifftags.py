"""The directories of a TIFF and their tags, before anything is decoded.

Source: TIFF 6.0, 1992; BigTIFF.
"""

from __future__ import annotations

import struct
from typing import Any, final

WIDTH, HEIGHT, SUBDIRECTORIES = 256, 257, 330
STRIPS, SAMPLES, STRIP_ROWS, PLANAR = 273, 277, 278, 284
_FORMS = {1: "B", 2: "s", 3: "H", 4: "I", 5: "II", 6: "b", 7: "s", 8: "h", 9: "i", 10: "ii",
          11: "f", 12: "d", 13: "I", 16: "Q", 17: "q", 18: "Q"}  # fmt: skip
_MOST_DIRECTORIES, _MOST_ENTRIES, _MOST_VALUE = 4096, 4096, 1 << 24


@final
class Directory:
    """One directory of a TIFF; values are unpacked when they are asked for."""

    def __init__(self, data: bytes, order: str, big: bool, at: int) -> None:
        self._data, self._order, self._big = data, order, big
        count, entry, word = ("Q", 20, "Q") if big else ("H", 12, "I")
        (entries,) = struct.unpack_from(order + count, data, at)
        start = at + struct.calcsize(order + count)
        self._at: dict[int, int] = {}
        for i in range(min(entries, _MOST_ENTRIES)):
            (tag,) = struct.unpack_from(order + "H", data, start + entry * i)
            self._at.setdefault(tag, start + entry * i)
        try:
            (self.next,) = struct.unpack_from(order + word, data, start + entry * entries)
        except struct.error:
            self.next = 0

    def __contains__(self, tag: int) -> bool:
        return tag in self._at

    def values(self, tag: int) -> tuple[Any, ...]:
        """The values of a tag; empty without it. Raises struct.error, ValueError or KeyError."""
        if tag not in self._at:
            return ()
        word, where = ("Q", 12) if self._big else ("I", 8)
        at = self._at[tag]
        kind, count = struct.unpack_from(self._order + "H" + word, self._data, at + 2)
        form = _FORMS[kind]
        if count > _MOST_VALUE:
            raise ValueError("absurdly long")
        form = self._order + (f"{count}s" if form == "s" else form * count if len(form) > 1
                              else f"{count}{form}")  # fmt: skip
        if struct.calcsize(form) > (8 if self._big else 4):
            (begin,) = struct.unpack_from(self._order + word, self._data, at + where)
        else:
            begin = at + where
        return struct.unpack_from(form, self._data, begin)

    def number(self, tag: int, default: int) -> int:
        """The first value of a tag."""
        values = self.values(tag)
        return int(values[0]) if values else default

    def patched(self, tag: int, value: int) -> bytes:
        """The file with another value of a tag that holds one SHORT."""
        at = self._at[tag] + (12 if self._big else 8)
        word = struct.pack(self._order + "H", value)
        return self._data[:at] + word + self._data[at + 2 :]

    def fractions(self, tag: int) -> list[float]:
        """Values of a tag of rationals. Raises ValueError where one is none."""
        pairs = self.values(tag)
        if not all(pairs[1::2]):
            raise ValueError("divided by zero")
        return [a / b for a, b in zip(pairs[::2], pairs[1::2], strict=True)]

    @property
    def size(self) -> tuple[int, int]:
        """(h, w). Raises struct.error, ValueError or KeyError where it is damaged."""
        sides = self.values(HEIGHT), self.values(WIDTH)
        if not all(sides):
            raise ValueError("no size")
        return int(sides[0][0]), int(sides[1][0])

    def fault_of_strips(self) -> str | None:
        """What is wrong where there are other strips than the rows need; None for tiles, too."""
        if STRIPS not in self:
            return None
        rows, _ = self.size
        each = min(self.number(STRIP_ROWS, rows), rows)
        planes = self.number(SAMPLES, 1) if self.number(PLANAR, 1) == 2 else 1
        needed = planes * -(-rows // each) if each > 0 else 0
        found = len(self.values(STRIPS))
        if found == needed:
            return None
        return f"{found} strips of {each} rows for {rows} rows; expected {needed}"


def chain_of(data: bytes) -> list[Directory]:
    """The directories, in their order. Raises struct.error or ValueError where damaged."""
    order = "<" if data[:2] == b"II" else ">"
    magic = struct.unpack_from(order + "H", data, 2)[0]
    if magic not in (42, 43):
        raise ValueError("no TIFF")
    big = magic == 43
    (at,) = struct.unpack_from(order + ("Q" if big else "I"), data, 8 if big else 4)
    found: list[Directory] = []
    seen: set[int] = set()
    while at and at not in seen and len(found) < _MOST_DIRECTORIES:
        seen.add(at)
        found.append(Directory(data, order, big, at))
        at = found[-1].next
    return found


def below(data: bytes, directory: Directory) -> list[Directory]:
    """The directories that one holds. Raises struct.error or ValueError where damaged."""
    return [
        Directory(data, directory._order, directory._big, at)
        for at in directory.values(SUBDIRECTORIES)[:_MOST_DIRECTORIES]
    ]
