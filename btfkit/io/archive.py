"""A folder and a zip behind one face: names of members, and their bytes when asked for."""

from __future__ import annotations

import functools
import os
import stat
import threading
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.errors import FormatError
from btfkit.io import listing, numerals, spelling
from btfkit.io.images import is_image

# One member of more bytes than this is no image of a sample.
_MOST_BYTES = 1 << 31
# Deflate shrinks at most 1032 times; images hardly at all.
_MOST_RATIO = 200
# A manifest of 300 000 images.
MOST_TEXT = 1 << 26


@final
class Archive:
    """Members of a folder (recursively) or of a zip, by their relative POSIX names.

    Args:
        path: folder or zip file.

    Raises:
        FormatError: a damaged zip, or one with members that leave it.

    What is wrong with one member shows when it is read: a link that leads out, a name that stands
    in the zip twice, bytes that unpack to absurdly many. Names may differ from those of members in
    case, composition (Unicode) and separators. It can be pickled and used from forked processes.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._local = threading.local()
        self._zip = not path.is_dir()
        self._twice: set[str] = set()
        self._infos = self._checked() if self._zip else {}

    def __getstate__(self) -> dict[str, Any]:
        # Open files stay behind; another process opens its own.
        return {name: value for name, value in self.__dict__.items() if name != "_local"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._local = threading.local()

    @functools.cached_property
    def names(self) -> list[str]:
        """All members, sorted."""
        if self._zip:
            return sorted(self._infos)
        return sorted(listing.files_of(self.path))

    def __contains__(self, name: str) -> bool:
        return self._member(name) is not None

    def _member(self, name: str) -> str | None:
        """The member of that name, spelt like it or not; None where there is none."""
        if self._there(name):
            return name
        found = self._by_key.get(spelling.key(name), [])
        if len(found) > 1:
            raise FormatError(
                self.path, f"{name!r} may be any of {', '.join(found[:3])}", remedy="rename them"
            )
        return found[0] if found else None

    def _there(self, name: str) -> bool:
        if self._zip:
            return name in self._infos
        try:
            return (self.path / name).is_file()
        except (OSError, ValueError):  # a name longer than any file's, or with a null
            return False

    def read(self, name: str) -> bytes:
        """The bytes of a member. May be called from several threads.

        Raises:
            FormatError: missing, damaged, encrypted, larger than it says, or outside.
        """
        member = self._member(name)
        if member is None:
            raise FormatError(self.path / name, "the file has gone since it was listed")
        if not self._zip:
            return self._read_file(self.path / member)
        info = self._infos[member]
        self._check_member(member, info)
        try:
            with self._file().open(info) as packed:
                data = packed.read(info.file_size + 1)
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
        """A member as text: UTF-16 where it starts with its mark, UTF-8, or else Latin-1.

        Raises:
            FormatError: binary, or far too long for a text that somebody wrote.
        """
        member = self._member(name) or name
        size = self._infos[member].file_size if self._zip else (self.path / member).stat().st_size
        if size > MOST_TEXT:
            raise FormatError(self.path / name, f"{size} bytes of text; at most {MOST_TEXT}")
        data = self.read(member)
        try:
            return listing.decoded(data)
        except ValueError as error:
            raise FormatError(self.path / name, "not a text file") from error

    def table(self, name: str, columns: int, *, comments: str = "") -> NDArray[np.float64]:
        """(rows, columns) numbers of a text member, as `numerals.numbers` takes a line.

        Args:
            name: of the member.
            columns: how many numbers a line has.
            comments: lines that start with one of these characters are left out.

        Raises:
            FormatError: a line that has not so many finite numbers, or no line at all.
        """
        rows = []
        for count, line in enumerate(self.text(name).splitlines(), 1):
            plain = line.strip()
            if not plain.strip(",;") or plain[0] in comments:
                continue
            row = numerals.numbers(plain, columns)
            if row is None:
                raise FormatError(
                    self.path / name, f"line {count} is {line[:60]!r}; expected {columns} numbers"
                )
            rows.append(row)
        if not rows:
            raise FormatError(self.path / name, "holds no numbers")
        return np.array(rows)

    def locate(self, name: str, base: str = "") -> str | None:
        """The member that a text file means by a name; None where there is none.

        Args:
            name: relative to `base`, or a path of another machine: then the member that shares its
                last part counts, and among several the one that shares most folders with it.
            base: folder of the text file, "" for the archive itself.

        Raises:
            FormatError: several members are meant equally.
        """
        relative = spelling.inside(name, base)
        member = self._member(relative) if relative is not None else None
        if member is not None:
            return member
        last = spelling.key(name).rsplit("/", 1)[-1]
        return self._the_one(name, self._by_last.get(last, []))

    def locate_image(self, name: str, base: str = "") -> str | None:
        """As `locate`; where there is no such file, the image of another suffix that it became."""
        member = self.locate(name, base)
        if member is not None or not is_image(name.replace("\\", "/")):
            return member
        stem = PurePosixPath(spelling.key(name)).stem
        others = [m for m in self._by_stem.get(stem, []) if is_image(m)]
        return self._the_one(str(PurePosixPath(name.replace("\\", "/")).with_suffix("")), others)

    def _the_one(self, name: str, members: list[str]) -> str | None:
        found = spelling.closest(name, members)
        if len(found) > 1:
            raise FormatError(
                self.path, f"{name!r} may be any of {', '.join(found[:3])}", remedy="rename them"
            )
        return found[0] if found else None

    @functools.cached_property
    def _by_key(self) -> dict[str, list[str]]:
        return _grouped(self.names, lambda key: key)

    @functools.cached_property
    def _by_last(self) -> dict[str, list[str]]:
        """Members by the last part of their names."""
        return _grouped(self.names, lambda key: key.rsplit("/", 1)[-1])

    @functools.cached_property
    def _by_stem(self) -> dict[str, list[str]]:
        return _grouped(self.names, lambda key: PurePosixPath(key).stem)

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
            plain = listing.zip_name(info).replace("\\", "/")
            if plain.count("/") > listing.MOST_FOLDERS:
                raise FormatError(
                    self.path,
                    f"member {plain!r} lies {plain.count('/')} folders deep; "
                    f"expected {listing.MOST_FOLDERS} at most",
                )
            name = PurePosixPath(plain)
            # ZipInfo.is_dir fails on an empty name.
            if plain[-1:] in ("", "/") or not spelling.all_count(name):
                continue
            if name.is_absolute() or ".." in name.parts or (name.parts and ":" in name.parts[0]):
                raise FormatError(self.path, f"member {info.filename!r} would leave the archive")
            if str(name) in infos:
                self._twice.add(str(name))
            infos[str(name)] = info
        return infos

    def _check_member(self, name: str, info: zipfile.ZipInfo) -> None:
        """Refuse a member that is not what its name says: one link, one of two, or far too much."""
        if stat.S_ISLNK(info.external_attr >> 16):
            raise FormatError(
                self.path, f"member {name!r} is a link", remedy="pack the files that links lead to"
            )
        if name in self._twice:
            raise FormatError(
                self.path, f"member {name!r} stands in the archive twice", remedy="pack it anew"
            )
        held = self.path.stat().st_size
        if info.header_offset + info.compress_size > held:
            raise FormatError(
                self.path,
                f"member {name!r} says it takes {info.compress_size} of the file's {held} bytes",
                remedy="copy it again",
            )
        if info.file_size > max(1 << 20, min(_MOST_BYTES, _MOST_RATIO * info.compress_size)):
            raise FormatError(
                self.path,
                f"member {name!r} says it unpacks from {info.compress_size} "
                f"to {info.file_size} bytes",
                remedy="unpack the archive and read the folder, if that is true",
            )

    def _file(self) -> zipfile.ZipFile:
        # A ZipFile of each thread's and process's own: a forked child shares its parent's position
        # in the file.
        if getattr(self._local, "process", None) != os.getpid():
            self._local.file = zipfile.ZipFile(self.path)
            self._local.process = os.getpid()
        file: zipfile.ZipFile = self._local.file
        return file


def _grouped(names: list[str], by: Callable[[str], str]) -> dict[str, list[str]]:
    """Names by some part of their keys."""
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(by(spelling.key(name)), []).append(name)
    return groups
