"""Folders and zips behind one face, and zips that mean harm."""

from __future__ import annotations

import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest

from btfkit.errors import FormatError
from btfkit.io import listing
from btfkit.io.archive import Archive
from btfkit.io.listing import folder_with
from btfkit.io.spelling import inside


def zip_of(path: Path, members: dict[str, bytes], how: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", how) as file:
        for name, data in members.items():
            file.writestr(name, data)
    return path


def test_a_folder_and_a_zip_list_and_read_the_same_and_leave_out_litter(tmp_path: Path) -> None:
    members = {"a/1.png": b"one", "a/b/2.png": b"two", "c.txt": b"text"}
    litter = {"a/Thumbs.db": b"", "__MACOSX/a/._1.png": b"", ".DS_Store": b"", "desktop.ini": b""}
    packed = Archive(zip_of(tmp_path / "x.zip", members | litter))
    for name, data in (members | litter).items():
        file = tmp_path / "x" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(data)
    folder = Archive(tmp_path / "x")
    assert packed.names == folder.names == sorted(members)
    for name, data in members.items():
        assert packed.read(name) == folder.read(name) == data
        assert name in packed
        assert name in folder


def test_a_file_that_goes_is_said_to_have_gone(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"x")
    folder = Archive(tmp_path)
    assert folder.names == ["a"]
    (tmp_path / "a").unlink()
    with pytest.raises(FormatError, match="has gone since it was listed"):
        folder.read("a")


@pytest.mark.parametrize("name", ["../evil.png", "a/../../evil.png", "/etc/x.png", "C:/x.png"])
def test_a_member_that_leaves_the_zip_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="would leave the archive"):
        Archive(zip_of(tmp_path / "x.zip", {name: b"x"}))


def test_backslashes_separate_too(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="would leave the archive"):
        Archive(zip_of(tmp_path / "x.zip", {"a\\..\\..\\evil.png": b"x"}))
    assert Archive(zip_of(tmp_path / "y.zip", {"a\\b.png": b"x"})).names == ["a/b.png"]


def test_a_zip_bomb_is_refused_before_it_unpacks(tmp_path: Path) -> None:
    bomb = zip_of(tmp_path / "x.zip", {"a.png": bytes(64 << 20)}, zipfile.ZIP_DEFLATED)
    assert bomb.stat().st_size < 100_000
    with pytest.raises(FormatError, match=r"says it unpacks from \d+ to 67108864 bytes; unpack"):
        Archive(bomb).read("a.png")


def test_a_member_that_unpacks_to_more_than_it_says_is_refused(tmp_path: Path) -> None:
    path = zip_of(tmp_path / "x.zip", {"a.png": b"x" * 1000}, zipfile.ZIP_DEFLATED)
    data = bytearray(path.read_bytes())
    # Uncompressed size, in the local header and in the central directory.
    data[22:26] = struct.pack("<I", 10)
    at = data.index(b"PK\x01\x02")
    data[at + 24 : at + 28] = struct.pack("<I", 10)
    path.write_bytes(data)
    with pytest.raises(FormatError, match=r"cannot be unpacked|does not have the 10 bytes"):
        Archive(path).read("a.png")


def test_a_member_twice_is_refused(tmp_path: Path) -> None:
    path = zip_of(tmp_path / "x.zip", {"a.png": b"1"})
    with zipfile.ZipFile(path, "a") as file, pytest.warns(UserWarning, match="Duplicate name"):
        file.writestr("a.png", b"2")
    with pytest.raises(FormatError, match="stands in the archive twice; pack it anew"):
        Archive(path).read("a.png")


def test_a_cut_or_flipped_zip_is_refused(tmp_path: Path) -> None:
    path = zip_of(tmp_path / "x.zip", {"a.png": bytes(range(256)) * 4})
    whole = path.read_bytes()
    path.write_bytes(whole[:-30])
    with pytest.raises(FormatError, match=r"not a readable zip .*; copy the archive again"):
        Archive(path)
    flipped = bytearray(whole)
    flipped[300] ^= 1
    path.write_bytes(flipped)
    with pytest.raises(FormatError, match=r"member 'a.png' cannot be unpacked .*CRC"):
        Archive(path).read("a.png")


def test_an_encrypted_member_is_refused(tmp_path: Path) -> None:
    path = zip_of(tmp_path / "x.zip", {"a.png": b"secret"})
    data = bytearray(path.read_bytes())
    data[6] |= 1
    data[data.index(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(data)
    with pytest.raises(FormatError, match=r"cannot be unpacked .*encrypted"):
        Archive(path).read("a.png")


def test_detection_of_damaged_zips_sees_nothing(tmp_path: Path) -> None:
    (tmp_path / "x.zip").write_bytes(b"PK\x03\x04" + bytes(100))
    assert listing.names_of(tmp_path / "x.zip") == []
    assert listing.names_of(tmp_path / "nothing") == []


@pytest.mark.parametrize(
    ("name", "base", "expected"),
    [
        ("a.png", "", "a.png"),
        ("a.png", "b", "b/a.png"),
        ("../a.png", "b", "a.png"),
        ("x/../a.png", "", "a.png"),
        ("x\\a.png", "", "x/a.png"),
        ("../a.png", "", None),
        ("/a.png", "b", None),
        ("C:\\a.png", "", None),
        ("..", "", None),
        ("", "", None),
        ("a\0.png", "", None),
    ],
)
def test_a_name_stays_inside_or_is_none(name: str, base: str, expected: str | None) -> None:
    assert inside(name, base) == expected


def test_a_text_file_means_members_by_relative_name_or_by_last_part(tmp_path: Path) -> None:
    for name in ("a/1.png", "b/2.png", "c/2.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    folder = Archive(tmp_path)
    assert folder.locate("1.png", "a") == "a/1.png"
    assert folder.locate("../b/2.png", "a") == "b/2.png"
    assert folder.locate(r"D:\photos\session 3\1.PNG") == "a/1.png"
    assert folder.locate("/../../etc/passwd") is None
    with pytest.raises(FormatError, match=r"'2.png' may be any of b/2.png, c/2.png; rename them"):
        folder.locate("2.png", "a")


def test_tables_are_read_with_commas_or_spaces_and_lines_are_named(tmp_path: Path) -> None:
    (tmp_path / "t.txt").write_text("\ufeff1, 2,3\n\n 4 5\t6e0 \n", encoding="utf-8")
    np.testing.assert_array_equal(Archive(tmp_path).table("t.txt", 3), [[1, 2, 3], [4, 5, 6]])
    for text, message in (
        ("1 2 3\n1 2\n", "line 2 is '1 2'; expected 3 numbers"),
        ("1 2 nan\n", "line 1 is '1 2 nan'; expected 3 numbers"),
        ("1 2 x\n", "line 1 is '1 2 x'; expected 3 numbers"),
        ("\n", "holds no numbers"),
        ("1 2\0 3", "not a text file"),
    ):
        (tmp_path / "t.txt").write_text(text)
        with pytest.raises(FormatError, match=message):
            Archive(tmp_path).table("t.txt", 3)
    (tmp_path / "t.txt").write_bytes("Löwe".encode("latin-1"))
    assert Archive(tmp_path).text("t.txt") == "Löwe"


def test_the_highest_folder_with_all_files_is_taken() -> None:
    names = ["x/y/a", "x/y/b", "x/a", "x/b", "a"]
    assert folder_with(names, "a", "b") == "x"
    assert folder_with(names, "a") == ""
    assert folder_with(names, "a", "c") is None
