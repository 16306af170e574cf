"""Damage to files, as hypothesis draws it: what a bad disk, a cut copy or an ill will leaves."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from hypothesis import strategies as st

# What upsets a parser: numbers that are none, too large or below zero, and what opens and closes.
TOKENS = [
    b"\xff" * 4, b"\x00" * 4, b"\x7f\xff\xff\xff", b"\x80\x00\x00\x00", b"1e999", b"-1", b"nan", b"inf",
    b"99999999999", b"1_0", b"\n", b'"', b"[[[[", b"{", b"]", b",", b"\xff\xfe", b"\xc3", b"..", b"/", b"\\", b":",
]  # fmt: skip


@dataclass(frozen=True)
class Damage:
    """One change of one file.

    Attributes:
        file: which of the files, 0..1 of their number.
        at: where, 0..1 of its length.
        kind: cut, flip, put (overwrite), insert or remove.
        what: the bytes.
    """

    file: float
    at: float
    kind: str
    what: bytes

    def of(self, data: bytes) -> bytes:
        """`data`, damaged."""
        at = min(int(self.at * len(data)), max(len(data) - 1, 0))
        size = len(self.what)
        match self.kind:
            case "cut":
                return data[:at]
            case "flip":
                flipped = bytes(a ^ b for a, b in zip(data[at:], self.what, strict=False))
                return data[:at] + flipped + data[at + len(flipped) :]
            case "put":
                return data[:at] + self.what + data[at + size :]
            case "insert":
                return data[:at] + self.what + data[at:]
            case _:
                return data[:at] + data[at + size :]


def damages(*kinds: str) -> st.SearchStrategy[Damage]:
    """Any damage, heads more often than the rest: there the sizes stand."""
    share = st.floats(0, 1, exclude_max=True)
    at = st.one_of(share, share.map(lambda x: x**6))
    bit = st.integers(0, 7).map(lambda shift: bytes([1 << shift]))
    kind = st.sampled_from(kinds or ("cut", "flip", "put", "insert", "remove"))
    what = st.one_of(bit, st.sampled_from(TOKENS), st.binary(min_size=1, max_size=12))
    return st.builds(Damage, share, at, kind, what)


@contextmanager
def damaged(files: list[Path], hurt: list[Damage]) -> Iterator[list[Path]]:
    """The files with their damage; whole again afterwards. Gives those that differ."""
    before: dict[Path, bytes] = {}
    try:
        for each in hurt:
            file = files[int(each.file * len(files))]
            before.setdefault(file, file.read_bytes())
            file.write_bytes(each.of(file.read_bytes()))
        yield [file for file, data in before.items() if file.read_bytes() != data]
    finally:
        for file, data in before.items():
            file.write_bytes(data)


def files_of(source: Path) -> list[Path]:
    """All files of a source, sorted."""
    if source.is_file():
        return [source]
    # Readers leave alone the list that says what --force may remove.
    found = (path for path in source.rglob("*") if path.is_file())
    return sorted(path for path in found if path.name != ".btfkit")
