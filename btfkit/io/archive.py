"""A folder and a zip behind one face: names of members, and their bytes when asked for."""

from __future__ import annotations

import functools
import os
import posixpath
import stat
import threading
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit.errors import FormatError

# One member of more bytes than this is no image of a sample.
_MOST_BYTES = 1 << 31
# Deflate shrinks at most 1032 times; images hardly at all.
_MOST_RATIO = 200
# A manifest of 300 000 images.
MOST_TEXT = 1 << 26
_IGNORED = {"thumbs.db", ".ds_store", "desktop.ini"}


@final
class Archive:
    """Members of a folder (recursively) or of a zip, by their relative POSIX names.

    Args:
        path: folder or zip file.

    Raises:
        FormatError: a damaged zip, or one with members that leave it or stand in it twice.

    A link inside a folder may not lead out of it either: `read` refuses it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._local = threading.local()
        self._zip = not path.is_dir()
        self._infos = self._checked() if self._zip else {}

    @functools.cached_property
    def names(self) -> list[str]:
        """All members, sorted."""
        if self._zip:
            return sorted(self._infos)
        return sorted(name for name in _files(self.path) if _counts(PurePosixPath(name)))

    def __contains__(self, name: str) -> bool:
        if self._zip:
            return name in self._infos
        try:
            return (self.path / name).is_file()
        except OSError:  # a name longer than any file's
            return False

    def read(self, name: str) -> bytes:
        """The bytes of a member. May be called from several threads.

        Raises:
            FormatError: missing, damaged, encrypted, larger than it says, or outside.
        """
        if not self._zip:
            return self._read_file(self.path / name)
        info = self._infos[name]
        try:
            with self._file().open(info) as member:
                data = member.read(info.file_size + 1)
        except (
            zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError,
            NotImplementedError, ValueError,
        ) as error:  # fmt: skip
            raise FormatError(
                self.path,
                # A damaged header is cited at length.
                f"member {name[:100]!r} cannot be unpacked ({str(error)[:200]})",
                remedy="copy the archive again",
            ) from error
        if len(data) != info.file_size:
            raise FormatError(
                self.path, f"member {name!r} does not have the {info.file_size} bytes it says"
            )
        return data

    def text(self, name: str) -> str:
        """A member as text, UTF-8 or else Latin-1.

        Raises:
            FormatError: binary, or far too long for a text that somebody wrote.
        """
        size = self._infos[name].file_size if self._zip else (self.path / name).stat().st_size
        if size > MOST_TEXT:
            raise FormatError(self.path / name, f"{size} bytes of text; at most {MOST_TEXT}")
        data = self.read(name)
        if b"\0" in data:
            raise FormatError(self.path / name, "not a text file")
        try:
            return data.decode("utf-8-sig")
        except UnicodeDecodeError:
            return data.decode("latin-1")

    def table(self, name: str, columns: int, *, comments: str = "") -> NDArray[np.float64]:
        """(rows, columns) numbers of a text member, separated by commas or white space.

        Args:
            name: of the member.
            columns: how many numbers a line has.
            comments: lines that start with one of these characters are left out.

        Raises:
            FormatError: a line that has not so many finite numbers, or no line at all.
        """
        rows = []
        for number, line in enumerate(self.text(name).splitlines(), 1):
            words = line.replace(",", " ").split()
            if not words or words[0][0] in comments:
                continue
            try:
                # Python reads 1_5 as 15.
                row = [] if "_" in line else [float(word) for word in words]
            except ValueError:
                row = []
            if len(row) != columns or not np.isfinite(row).all():
                raise FormatError(
                    self.path / name, f"line {number} is {line[:60]!r}; expected {columns} numbers"
                )
            rows.append(row)
        if not rows:
            raise FormatError(self.path / name, "holds no numbers")
        return np.array(rows)

    def locate(self, name: str, base: str = "") -> str | None:
        """The member that a text file means by a name; None where there is none.

        Args:
            name: relative to `base`, or a path of another machine, whose last part counts.
            base: folder of the text file, "" for the archive itself.

        Raises:
            FormatError: several members have that last part.
        """
        plain = name.replace("\\", "/")
        relative = inside(plain, base)
        if relative is not None and relative in self:
            return relative
        found = self._by_last.get(PurePosixPath(plain).name.lower(), [])
        if len(found) > 1:
            raise FormatError(
                self.path, f"{name!r} may be any of {', '.join(found[:3])}", remedy="rename them"
            )
        return found[0] if found else None

    @functools.cached_property
    def _by_last(self) -> dict[str, list[str]]:
        """Members by the last part of their names."""
        members: dict[str, list[str]] = {}
        for member in self.names:
            members.setdefault(PurePosixPath(member).name.lower(), []).append(member)
        return members

    def _read_file(self, path: Path) -> bytes:
        try:
            if not path.resolve().is_relative_to(self._root):
                raise FormatError(
                    path, "is a link that leaves the folder", remedy="put the file in its place"
                )
            if path.stat().st_size > _MOST_BYTES:
                raise FormatError(path, f"is larger than {_MOST_BYTES} bytes")
            return path.read_bytes()
        except FileNotFoundError as error:
            raise FormatError(path, "the file has gone since it was listed") from error
        except RuntimeError as error:  # of Path.resolve
            raise FormatError(path, "is a link that leads to itself") from error

    @functools.cached_property
    def _root(self) -> Path:
        return self.path.resolve()

    def _checked(self) -> dict[str, zipfile.ZipInfo]:
        infos: dict[str, zipfile.ZipInfo] = {}
        try:
            members = self._file().infolist()
        except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
            raise FormatError(
                self.path, f"not a readable zip ({error})", remedy="copy the archive again"
            ) from error
        for info in members:
            name = PurePosixPath(info.filename.replace("\\", "/"))
            # ZipInfo.is_dir fails on an empty name.
            if info.filename[-1:] in ("", "/") or not _counts(name):
                continue
            if name.is_absolute() or ".." in name.parts or (name.parts and ":" in name.parts[0]):
                raise FormatError(self.path, f"member {info.filename!r} would leave the archive")
            if stat.S_ISLNK(info.external_attr >> 16):
                raise FormatError(
                    self.path,
                    f"member {info.filename!r} is a link",
                    remedy="pack the files that links lead to",
                )
            if str(name) in infos:
                raise FormatError(
                    self.path, f"member {info.filename!r} stands in the archive twice"
                )
            if info.file_size > max(1 << 20, min(_MOST_BYTES, _MOST_RATIO * info.compress_size)):
                raise FormatError(
                    self.path,
                    f"member {info.filename!r} says it unpacks from {info.compress_size} "
                    f"to {info.file_size} bytes",
                )
            infos[str(name)] = info
        return infos

    def _file(self) -> zipfile.ZipFile:
        # A ZipFile of each thread's own: they share no lock and no file position.
        if not hasattr(self._local, "file"):
            self._local.file = zipfile.ZipFile(self.path)
        file: zipfile.ZipFile = self._local.file
        return file


def names_of(path: Path) -> list[str]:
    """Names of members without checking them: for `detect`. Empty for a damaged zip."""
    if path.is_dir():
        return list(_files(path))
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as file:
                return [info.filename for info in file.infolist()]
    except (OSError, zipfile.BadZipFile, ValueError, NotImplementedError):
        return []
    return []


def inside(name: str, base: str = "") -> str | None:
    """`name`, relative to `base`, as a member's name; None where it leaves the archive."""
    plain = posixpath.join(base, name.replace("\\", "/"))
    relative = posixpath.normpath(plain)
    leaves = relative.startswith(("/", "../")) or relative in ("..", ".") or "\0" in relative
    return None if leaves or ":" in relative.split("/")[0] else relative


def folder_with(names: list[str], *required: str) -> str | None:
    """The folder of a listing that holds all the `required` files; the highest of several."""
    present = {PurePosixPath(name.replace("\\", "/")) for name in names}
    folders = {path.parent for path in present if path.name == required[0]}
    found = [f for f in folders if all(f / name in present for name in required)]
    if not found:
        return None
    best = min(found, key=lambda folder: (len(folder.parts), str(folder)))
    return "" if best == PurePosixPath(".") else str(best)


def _files(folder: Path) -> Iterator[str]:
    """Relative names of all files below a folder, links to files included, those to folders not.

    The disk is asked for listings alone, not about each of 20 000 images.
    """
    pending = [""]
    while pending:
        base = pending.pop()
        with os.scandir(folder / base) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    pending.append(f"{base}{entry.name}/")
                elif _is_file(entry):
                    yield base + entry.name


def _is_file(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_file()
    except OSError:  # a link that leads to itself
        return False


def _counts(path: Path | PurePosixPath) -> bool:
    return path.name.lower() not in _IGNORED and "__MACOSX" not in path.parts
