"""Files and folders that appear whole under their name or not at all."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def refuse_existing(path: str | os.PathLike[str], *, force: bool) -> Path:
    """`path` as a Path; FileExistsError where it exists and `force` is False."""
    final = Path(path)
    if final.exists() and not force:
        raise FileExistsError(f"{final} exists; --force (force=True) replaces it")
    if not final.parent.is_dir():
        raise FileNotFoundError(f"{final.parent} is not a folder; create it first")
    return final


@contextmanager
def whole(path: str | os.PathLike[str], *, force: bool = False) -> Iterator[Path]:
    """A file to write beside `path`, renamed to it on success and removed on failure.

    Args:
        path: final name; the temporary one keeps its suffix, since writers go by it.
        force: whether an existing file is replaced.

    Raises:
        FileExistsError: `path` exists and `force` is False.
    """
    final = refuse_existing(path, force=force)
    partial = final.with_name(f".{final.stem}.{secrets.token_hex(4)}.partial{final.suffix}")
    try:
        yield partial
        with partial.open("rb+") as file:
            os.fsync(file.fileno())
        partial.replace(final)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def whole_folder(path: str | os.PathLike[str], *, force: bool = False) -> Iterator[Path]:
    """A folder to fill beside `path`, renamed to it on success and removed on failure."""
    final = refuse_existing(path, force=force)
    partial = final.with_name(f".{final.name}.{secrets.token_hex(4)}.partial")
    partial.mkdir()
    try:
        yield partial
        replace_folder(partial, final)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def replace_folder(partial: Path, final: Path) -> None:
    """Give a finished folder its final name; what had that name before is removed after."""
    old = final.with_name(f".{final.name}.{secrets.token_hex(4)}.old")
    if final.exists():
        final.rename(old)
    partial.rename(final)
    if old.is_dir():
        shutil.rmtree(old, ignore_errors=True)
    else:
        old.unlink(missing_ok=True)
