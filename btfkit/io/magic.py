"""What a format is told by: the first bytes of its files."""

from __future__ import annotations

from pathlib import Path


def begins(path: Path, magic: bytes) -> bool:
    """Whether `path` is a file that begins with `magic`."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(magic)) == magic
