"""The journal of a run: one record a line, appended and synced, each with its CRC.

    {"record": "frame", ...}<TAB>1a2b3c4d

A last line that is torn is what a crash leaves, and is cut off; damage anywhere before is
somebody else's doing, and the run is refused.
"""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any, final

from btfkit.errors import FormatError

NAME = "journal.jsonl"
Record = dict[str, Any]


@final
class Journal:
    """Records of one run, appended to a file; use `with`.

    Attributes:
        records: what it holds, those of earlier sessions first.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.records, whole = read(path) if path.exists() else ([], 0)
        self._file: IO[bytes] = path.open("ab")
        if self._file.tell() != whole:
            self._file.truncate(whole)
            self._file.seek(0, os.SEEK_END)
            os.fsync(self._file.fileno())

    def append(self, record: Mapping[str, Any]) -> None:
        """Write a record and wait until it is on the disk."""
        self._file.write(encoded(record))
        self._file.flush()
        os.fsync(self._file.fileno())
        self.records.append(dict(record))

    def tear(self, record: Mapping[str, Any]) -> None:
        """Write half a record, as a crash does."""
        line = encoded(record)
        self._file.write(line[: len(line) // 2])
        self._file.flush()

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def encoded(record: Mapping[str, Any]) -> bytes:
    """The line of a record."""
    text = json.dumps(record, allow_nan=False, separators=(",", ":")).encode()
    return text + b"\t%08x\n" % zlib.crc32(text)


def read(path: Path) -> tuple[list[Record], int]:
    """Records of a journal, and bytes that they take; a torn last line is left out.

    Raises:
        FormatError: a line before the last is damaged.
    """
    data = path.read_bytes()
    records: list[Record] = []
    at = 0
    while at < len(data):
        end = data.find(b"\n", at)
        line = data[at:] if end < 0 else data[at:end]
        record = None if end < 0 else _record(line)
        if record is None:
            # A crash tears the end of the file, which may fall on a line's end by chance.
            if end < 0 or end == len(data) - 1:
                return records, at
            raise FormatError(
                path, f"line {len(records) + 1} is damaged, and more follow it: no crash did this",
                remedy="restore the journal from a copy, or start a new run in another folder",
            )  # fmt: skip
        records.append(record)
        at = end + 1
    return records, at


def _record(line: bytes) -> Record | None:
    text, tab, crc = line.rpartition(b"\t")
    if not tab or crc != b"%08x" % zlib.crc32(text):
        return None
    try:
        record = json.loads(text)
    except ValueError:
        return None
    return record if isinstance(record, dict) else None
