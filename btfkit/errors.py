"""What can go wrong, as the caller tells it apart.

    BtfkitError
    ├── FormatError        a file is not what it says it is
    ├── DeviceError        a rig refused, failed or fell silent
    ├── CalibrationError   a measurement cannot be calibrated as it stands
    └── FitError           a model cannot be fitted to this data

Wrong arguments are ValueError and TypeError, as everywhere in Python.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any


class BtfkitError(Exception):
    """Root of everything btfkit raises by itself.

    Args:
        message: what was found, where, and what was expected.
        remedy: what the user can do about it; shown after the message.
    """

    def __init__(self, message: str, *, remedy: str | None = None) -> None:
        super().__init__(printable(f"{message}; {remedy}" if remedy else message))
        self.message = message
        self.remedy = remedy

    def __reduce__(self) -> tuple[Any, ...]:
        # Exceptions are remade from their line alone, which is not what constructors here take.
        return _remade, (type(self), str(self)), self.__dict__


def _remade(kind: type[BtfkitError], line: str) -> BtfkitError:
    error = kind.__new__(kind)
    Exception.__init__(error, line)
    return error


class FormatError(BtfkitError):
    """A file is damaged, unsupported or not what it says it is.

    Args:
        path: the file or folder, or the member inside an archive.
        message: what was found and what was expected.
        remedy: what the user can do about it.
    """

    def __init__(
        self, path: str | os.PathLike[str], message: str, *, remedy: str | None = None
    ) -> None:
        super().__init__(one_line(f"{os.fspath(path)}: {message}"), remedy=remedy)
        self.path = os.fspath(path)


class DeviceError(BtfkitError):
    """A device of the rig refused a command, failed or did not answer."""


class CalibrationError(BtfkitError):
    """A sequence lacks what a calibration stage needs, or contradicts itself."""


class FitError(BtfkitError):
    """A model cannot be fitted: no usable data, or training that diverges."""


def one_line(text: str, most: int = 900) -> str:
    """One printable line, whatever a name in an archive or a foreign library says.

    Control characters, which a terminal would obey, are shown as escapes; the middle of what is
    longer than `most` characters is left out.
    """
    line = " ".join(text.split())
    line = printable(line)
    return line if len(line) <= most else f"{line[: most * 2 // 3]} … {line[-most // 4 :]}"


def printable(text: str) -> str:
    """`text` with control characters, of which a terminal obeys some, as escapes."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def unknown(kind: str, name: str, known: Iterable[str]) -> str:
    """The message for a name that there is not: what it may have meant, and what there is."""
    names = list(known)
    return f"no {kind} {name!r}{meaning(name, names)}; there are {', '.join(names)}"


def meaning(name: str, known: Iterable[str]) -> str:
    """` (did you mean ...?)` where a known name is close; empty where none is."""
    import difflib

    close = difflib.get_close_matches(name.lower(), list(known), n=1, cutoff=0.7)
    return f" (did you mean {close[0]}?)" if close else ""
