"""Names of files as people and systems spell them: case, composition, separators, and litter."""

from __future__ import annotations

import posixpath
import unicodedata
from collections.abc import Iterable
from pathlib import PurePosixPath

# What systems put beside the files of their users; all that starts with a dot is hidden anyway.
_LITTER = {
    "thumbs.db", "ehthumbs.db", "desktop.ini", "__macosx", "@eadir", "$recycle.bin",
    "system volume information", "lost+found", "icon\r",
}  # fmt: skip
# A native store is no image folder: it may lie in the folder that it was made of, its preview too.
_OURS = (".btf.zarr", ".preview.png")


def key(name: str) -> str:
    """A name such that equal ones differ in case, composition or the separator of folders only."""
    return unicodedata.normalize("NFC", name.replace("\\", "/")).casefold()


def counts(name: str) -> bool:
    """Whether one part of a path is the user's: not hidden, no litter, not ours."""
    low = name.lower()
    return not (low.startswith(".") or low in _LITTER or low.endswith(_OURS))


def all_count(path: PurePosixPath) -> bool:
    """Whether all parts of a relative path are the user's."""
    return all(part in ("..", ".") or counts(part) for part in path.parts)


def inside(name: str, base: str = "") -> str | None:
    """`name`, relative to `base`, as a member's name; None where it leaves the archive."""
    plain = posixpath.join(base, name.replace("\\", "/"))
    relative = posixpath.normpath(plain)
    leaves = relative.startswith(("/", "../")) or relative in ("..", ".") or "\0" in relative
    return None if leaves or ":" in relative.split("/")[0] else relative


def is_absolute(name: str) -> bool:
    """Whether a name is a path of some machine: from a root, a drive or a server."""
    return name.startswith(("/", "\\")) or ":" in name.replace("\\", "/").split("/")[0]


def closest(name: str, members: Iterable[str]) -> list[str]:
    """Of members with the same last part those that share most folders with a path's end."""
    wanted = key(name).split("/")[::-1]

    def shared(member: str) -> int:
        parts = key(member).split("/")[::-1]
        pairs = zip(wanted, parts, strict=False)
        return next((i for i, (a, b) in enumerate(pairs) if a != b), min(len(wanted), len(parts)))

    scores = {member: shared(member) for member in members}
    best = max(scores.values(), default=0)
    return [member for member, score in scores.items() if score == best]
