"""A folder and a zip behind one face: names of members, and their bytes when asked for."""

from __future__ import annotations

import threading
import zipfile
import zlib
from pathlib import Path, PurePosixPath
from typing import final

from btfkit.errors import FormatError

# One member that unpacks to more than this is no image of a sample.
_MOST_BYTES = 1 << 31
# Deflate shrinks at most 1032 times; images hardly at all.
_MOST_RATIO = 200
_IGNORED = {"thumbs.db", ".ds_store", "desktop.ini"}


@final
class Archive:
    """Members of a folder (recursively) or of a zip, by their relative POSIX names.

    Args:
        path: folder or zip file.

    Raises:
        FormatError: a damaged zip, or one with members that leave it or stand in it twice.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._local = threading.local()
        self._zip = not path.is_dir()
        self._infos: dict[str, zipfile.ZipInfo] = {}
        if self._zip:
            self._infos = self._checked()
            self.names = sorted(self._infos)
        else:
            found = (p for p in path.rglob("*") if p.is_file())
            self.names = sorted(p.relative_to(path).as_posix() for p in found if _counts(p))

    def read(self, name: str) -> bytes:
        """The bytes of a member. May be called from several threads.

        Raises:
            FormatError: missing, damaged, encrypted, or larger than it says.
        """
        if not self._zip:
            try:
                return (self.path / name).read_bytes()
            except FileNotFoundError as error:
                raise FormatError(
                    self.path / name, "the file has gone since it was listed"
                ) from error
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
                f"member {name!r} cannot be unpacked ({error})",
                remedy="copy the archive again",
            ) from error
        if len(data) != info.file_size:
            raise FormatError(
                self.path, f"member {name!r} does not have the {info.file_size} bytes it says"
            )
        return data

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
            if info.is_dir() or not _counts(name):
                continue
            if name.is_absolute() or ".." in name.parts or (name.parts and ":" in name.parts[0]):
                raise FormatError(self.path, f"member {info.filename!r} would leave the archive")
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
    """Names of members without checking them: for `detect`. Empty where nothing is readable."""
    try:
        if path.is_dir():
            return [p.relative_to(path).as_posix() for p in path.rglob("*") if p.is_file()]
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as file:
                return [info.filename for info in file.infolist()]
    except (OSError, zipfile.BadZipFile, ValueError, NotImplementedError):
        return []
    return []


def _counts(path: Path | PurePosixPath) -> bool:
    return path.name.lower() not in _IGNORED and "__MACOSX" not in path.parts
