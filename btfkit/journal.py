"""What lets a long job be interrupted and go on: a lock, a partial folder, a journal.

The result grows in `.NAME.partial` beside its final name. Whatever is finished is noted in the
journal inside, a line of JSON each, after it is safe on disk; the first line says which job it is,
and a later run goes on only where that is the same. A lock keeps a second run out as long as the
first lives.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from btfkit.errors import BtfkitError


def partial_folder(path: Path) -> Path:
    """Where `path` grows until it is whole."""
    return path.with_name(f".{path.name}.partial")


@contextmanager
def alone(path: Path) -> Iterator[None]:
    """Nobody else writes `path` meanwhile; a killed process lets go of its lock.

    Raises:
        BtfkitError: another process does.
    """
    try:
        import fcntl
    except ImportError:  # Windows: two runs at once are up to the user
        yield
        return
    lock = path.with_name(f".{path.name}.lock")
    with lock.open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise BtfkitError(
                f"{path}: another run is writing it", remedy="wait for it or end it"
            ) from error
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)


@final
@dataclass(frozen=True)
class Journal:
    """The journal in a folder; it may not be there yet.

    Attributes:
        folder: that holds `journal.jsonl`.
    """

    folder: Path

    @property
    def path(self) -> Path:
        """The file."""
        return self.folder / "journal.jsonl"

    def of_job(self, identity: Mapping[str, Any]) -> bool:
        """Whether an earlier run has begun the job that `identity` tells from others."""
        lines = self._lines()
        # As JSON gives it back: tuples are lists, keys are texts.
        return bool(lines) and lines[0] == json.loads(json.dumps(identity))

    def begin(self, identity: Mapping[str, Any]) -> None:
        """Note which job this is, as the first line."""
        self.note(identity)

    def go_on(self) -> None:
        """Cut off the line that a crash left unfinished, so that the next one begins anew."""
        whole = self.path.read_bytes().rfind(b"\n") + 1
        with self.path.open("rb+") as file:
            file.truncate(whole)

    def note(self, entry: Mapping[str, Any]) -> None:
        """Add a line and bring it to disk; lines of several workers do not mix."""
        # One write call a line.
        with self.path.open("ab", buffering=0) as file:
            file.write(json.dumps(entry).encode() + b"\n")
            os.fsync(file.fileno())

    def entries(self) -> list[dict[str, Any]]:
        """What was finished so far, without the first line; a line cut short does not count."""
        return self._lines()[1:]

    def remove(self) -> None:
        """Drop the journal: the job is done."""
        self.path.unlink(missing_ok=True)

    def _lines(self) -> list[dict[str, Any]]:
        if not self.path.is_file():
            return []
        lines = []
        for line in self.path.read_bytes().split(b"\n")[:-1]:
            try:
                lines.append(json.loads(line))
            except ValueError:
                break
        return lines


def to_disk(path: Path) -> None:
    """Bring a written file to disk, so that it may be noted."""
    with path.open("rb") as file:
        os.fsync(file.fileno())
