"""What lies in a folder or a zip, by names alone, and text however it was saved."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from btfkit.io import spelling

_BYTE_ORDER_MARKS = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}
# Folders in folders that a member of a zip may lie in.
MOST_FOLDERS = 32
# General purpose bit 11 of a zip: names are UTF-8.
_UTF8 = 1 << 11


def names_of(path: Path) -> list[str]:
    """Names of members without checking them: for `detect`. Empty for a damaged zip."""
    if path.is_dir():
        return list(files_of(path))
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as file:
                names = [zip_name(info).replace("\\", "/") for info in file.infolist()]
            # Every reader parses all of them: thousands that lie deep took minutes.
            if max((name.count("/") for name in names), default=0) > MOST_FOLDERS:
                return []
            return [name for name in names if spelling.all_count(PurePosixPath(name))]
    except (OSError, zipfile.BadZipFile, ValueError, NotImplementedError):
        return []
    return []


def folder_with(names: list[str], *required: str) -> str | None:
    """The folder of a listing that holds all the `required` files; the highest of several."""
    folders: dict[PurePosixPath, set[str]] = {}
    for name in names:
        path = PurePosixPath(name.replace("\\", "/"))
        folders.setdefault(path.parent, set()).add(spelling.key(path.name))
    wanted = {spelling.key(name) for name in required}
    found = [folder for folder, files in folders.items() if wanted <= files]
    if not found:
        return None
    best = min(found, key=lambda folder: (len(folder.parts), str(folder)))
    return "" if best == PurePosixPath(".") else str(best)


def zip_name(info: zipfile.ZipInfo) -> str:
    """The name of a member; where nothing is said of its encoding, UTF-8 if it is that.

    Python takes it for code page 437, which macOS never writes.
    """
    if info.flag_bits & _UTF8:
        return info.filename
    try:
        return info.filename.encode("cp437").decode("utf-8")
    except UnicodeError:
        return info.filename


def files_of(folder: Path) -> Iterator[str]:
    """Relative names of all files below a folder, links to files included, those to folders not.

    What lies behind a link to a folder inside is listed where it lies. Hidden files, litter and
    stores are left out. The disk is asked for listings alone, not about each of 20 000 images.
    """
    pending = [""]
    while pending:
        base = pending.pop()
        with os.scandir(folder / base) as entries:
            for entry in entries:
                if not spelling.counts(entry.name):
                    continue
                if entry.is_dir(follow_symlinks=False):
                    pending.append(f"{base}{entry.name}/")
                elif _is_file(entry):
                    yield base + entry.name


def _is_file(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_file()
    except OSError:  # a link that leads to itself
        return False


def decoded(data: bytes, errors: str = "strict") -> str:
    """Text of bytes: UTF-16 where it starts with its mark, UTF-8, or else Latin-1.

    Raises:
        ValueError: binary.
    """
    if data[:2] in _BYTE_ORDER_MARKS:
        return data.decode(_BYTE_ORDER_MARKS[data[:2]], errors)
    if b"\0" in data:
        raise ValueError("binary")
    try:
        return data.decode("utf-8-sig", errors)
    except UnicodeDecodeError:
        return data.decode("latin-1")
