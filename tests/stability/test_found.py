"""What campaigns found, each as the smallest file that shows it."""

from __future__ import annotations

import contextlib
import io
import json
import struct
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import sources
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

import btfkit
from btfkit.cli import btfkit as command
from btfkit.cli.outcome import run
from btfkit.errors import BtfkitError, FormatError, one_line
from btfkit.io import archive, detect, images, queryfile
from btfkit.materials import file as model_file
from btfkit.materials.base import Header
from btfkit.materials.lambert import Lambert, LambertSpec


def _npy(header: str, body: bytes = b"") -> bytes:
    head = header.encode("latin1") + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + body


@pytest.mark.parametrize(
    ("member", "data", "message"),
    [
        # numpy takes the memory before it looks for the numbers.
        (
            "uv.npy",
            _npy("{'descr': '<f4', 'fortran_order': False, 'shape': (2000000000, 2)}"),
            "holds less",
        ),
        (
            "uv.npy",
            _npy("{'descr': '<f4', 'fortran_order': False, 'shape': (2"),
            "not a readable query file",
        ),
        (
            "uv.npy",
            _npy("{'descr': '|O', 'fortran_order': False, 'shape': (1, 2)}"),
            "holds less|not a readable",
        ),
        # No values, in rows that take a minute to go through.
        (
            "channels.npy",
            _npy("{'descr': '<U1', 'fortran_order': False, 'shape': (2000000000, 0, 3)}"),
            "holds less",
        ),
        # What is no array comes back from numpy as bytes.
        ("uv.npy", b"no array at all", "not a readable query file"),
    ],
)
def test_queries_whose_arrays_lie_are_refused_before_memory_is_taken(
    member: str, data: bytes, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "q.npz"
    up = np.tile(np.float32([0, 0, 1]), (2, 1))
    np.savez(path, light=up, view=up)
    with zipfile.ZipFile(path, "a") as file:
        file.writestr(member, data)
    with pytest.raises(FormatError, match=message):
        queryfile.read(path)


def test_a_profile_without_a_name_is_a_damaged_header() -> None:
    data = cv2.imencode(".png", np.zeros((3, 4, 3), np.uint8))[1].tobytes()
    chunk = b"iCCP" + b"x" * 5
    profile = struct.pack(">I", 5) + chunk + struct.pack(">I", zlib.crc32(chunk))
    with pytest.raises(FormatError, match="the header is damaged"):
        images.read("a.png", data[:33] + profile + data[33:], transfer="srgb")


@pytest.mark.parametrize("offset", [0, 13, 10**9])
def test_a_bmp_whose_pixels_lie_in_its_header_or_nowhere_is_refused(offset: int) -> None:
    data = bytearray(cv2.imencode(".bmp", np.full((3, 4, 3), 90, np.uint8))[1].tobytes())
    assert images.read("a.bmp", bytes(data), transfer="linear").shape == (3, 4, 3)
    data[10:14] = struct.pack("<I", offset)
    with pytest.raises(FormatError, match=f"pixels at byte {offset} of"):
        images.read("a.bmp", bytes(data), transfer="linear")


def test_a_zip_of_folders_in_folders_is_refused_at_once(tmp_path: Path) -> None:
    path = tmp_path / "deep.zip"
    with zipfile.ZipFile(path, "w") as file:
        for i in range(3000):
            file.writestr(f"{'d/' * 90}{i}.png", b"")
    start = time.process_time()
    with pytest.raises(FormatError, match="no reader knows this file"):
        detect(path)
    with pytest.raises(FormatError, match="lies 90 folders deep; expected 32 at most"):
        archive.Archive(path)
    # Every reader parsed all names before: over a minute.
    assert time.process_time() - start < 5


def test_messages_are_one_printable_line_of_some_length() -> None:
    said = str(FormatError("a\x1b[2J.exr", "channel '\x02':\nwidth \u202e8", remedy="save it"))
    assert said == "a\\x1b[2J.exr: channel '\\x02': width \\u202e8; save it"
    assert len(one_line("[" * 10000)) < 1000


def test_a_name_cannot_speak_to_the_terminal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "\x1b[2Jwool"
    folder.mkdir()
    for light in (10, 20):
        picture = cv2.imencode(".png", np.full((3, 4, 3), light, np.uint8))[1].tobytes()
        (folder / f"tl{light:03d}_pl000_tv000_pv000.png").write_bytes(picture)
    assert run(command, ["ingest", str(folder), "--no-preview"]) == 0
    said = capsys.readouterr()
    assert "\x1b" not in said.out + said.err
    assert "\\x1b[2Jwool" in said.out
    assert io.StringIO(said.err).read().startswith("next: ")


@pytest.mark.parametrize("name", ["spec", "provenance", "channels"])
@pytest.mark.parametrize(
    "told", ["[" * 9999, "__import__('os')", "null", "3", '["a"]', '"a"', "1e308"]
)
def test_a_header_that_describes_no_material_is_refused_in_one_line(
    name: str, told: str, tmp_path: Path
) -> None:
    texture = np.ones((4, 4, 3), np.float32)
    path = tmp_path / "m.safetensors"
    model_file.save(Lambert(LambertSpec((4, 4)), {"texture": texture}, Header((4, 4))), path)
    arrays = load_file(path)
    with safe_open(path, "numpy") as file:
        metadata = file.metadata()
    save_file(arrays, path, metadata | {name: told})
    for read in (model_file.load, model_file.header_of):
        with contextlib.suppress(FormatError):
            read(path)
    with pytest.raises(FormatError, match="the header does not describe a material"):
        model_file.load(path)


def _lamp(folder: Path) -> None:
    (folder / "light_power.txt").write_text("1e-320,1500.0,1400.0\n")


def _coefficients(path: Path) -> None:
    data = bytearray(path.read_bytes())
    # Scales of the coefficients, behind the header's lines.
    start = data.index(b"\n", data.rindex(b"\n", 0, 60)) + 1
    data[start : start + 32] = np.full(8, 3e38, "<f4").tobytes()
    path.write_bytes(data)


@contextlib.contextmanager
def _edited(path: Path) -> Iterator[Any]:
    """A JSON document, written back as it is then."""
    told = json.loads(path.read_text())
    yield told
    path.write_text(json.dumps(told))


def _area(folder: Path) -> None:
    with _edited(folder / "sequence.json") as told:
        told["target"]["sample"]["size_mm"] = [7, [[5]]]


def _sample(folder: Path) -> None:
    with _edited(folder / "sequence.json") as told:
        told["target"]["sample"] = []


def _direction(folder: Path) -> None:
    with _edited(folder / "sequence.json") as told:
        told["rig"]["axes"][0]["direction"] = [0, 1e308, 1e308]


def _rotation(folder: Path) -> None:
    with _edited(folder / "sequence.json") as told:
        told["rig"]["camera"]["rotation"][0][2] = 1e12


def _no_rotation(folder: Path) -> None:
    with _edited(folder / "sequence.json") as told:
        told["rig"]["camera"]["rotation"] = [[2, 0, 0], [0, -2, 0], [0, 0, -2]]


def _away(folder: Path) -> None:
    with _edited(folder / "sequence.json") as told:
        told["rig"]["camera"]["rotation"] = np.eye(3).tolist()


def _name(folder: Path) -> None:
    path = folder / "sequence.csv"
    path.write_text(path.read_text().replace("frames/003.png", "frames/003.\x00g"))


def _intensity(folder: Path) -> None:
    path = folder / "light_intensities.txt"
    path.write_text(path.read_text().replace("3 4 5", "3 1e-320 5"))


def _signal(path: Path) -> None:
    data = bytearray(path.read_bytes())
    at = data.index(b"9 2 1\r\n") + 7
    data[at : at + 4] = struct.pack("<I", 0x7F800001)
    path.write_bytes(data)


def _no_run(folder: Path) -> None:
    with _edited(folder / "texture" / "zarr.json") as told:
        told["chunk_grid"]["configuration"]["chunk_shape"][0] = 0


def _endless(folder: Path) -> None:
    with _edited(folder / "sequence.json") as told:
        told["target"]["sample"]["size_mm"] = [7, 10**12]


def _far(folder: Path) -> None:
    with _edited(folder / "sequence.json") as told:
        told["rig"]["axes"][0]["point_mm"] = [1e308, 0, 0]


def _shard(folder: Path) -> None:
    with _edited(folder / "texture" / "zarr.json") as told:
        told["chunk_grid"]["configuration"]["chunk_shape"][1] *= 2


def _frame(folder: Path) -> None:
    (folder / "frames" / "000.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(4) + b"IEND\xaeB`\x82")


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("materialgan", _lamp, "expected three powers above 0"),
        ("hsh", _coefficients, "its coefficients give values that are no numbers"),
        ("sequence", _area, "says no target.sample.size_mm"),
        ("sequence", _sample, r"target\.sample is \[\]; expected an object"),
        ("sequence", _direction, "has no direction"),
        ("zarr", _shard, "chunk|checksum|texture 0"),
        ("sequence", _frame, "cut short"),
        ("sequence", _rotation, "expected three perpendicular unit vectors"),
        ("sequence", _no_rotation, "expected three perpendicular unit vectors"),
        ("sequence", _endless, r"size_mm \[7, 1000000000000\] takes \d+ x \d+ texels"),
        ("sequence", _far, r"the camera of pair . lies at \[.*e\+30"),
        ("sequence", _away, "no frame's camera sees the middle of the sample"),
        ("sequence", _name, r"first: frames/003\.\\x00g\)"),
        ("diligent", _intensity, "holds one that is not 1e-15 to"),
        ("hsh", _signal, "a scale or bias is not finite"),
        ("zarr", _no_run, "has shape|damaged"),
    ],
)
def test_what_lies_in_a_source_is_refused_by_name(
    name: str, change: Callable[[Path], None], message: str, tmp_path: Path
) -> None:
    source = sources.SOURCES[name](tmp_path)
    change(source)
    with pytest.raises(BtfkitError, match=message):
        btfkit.open(source).texture(0)


def test_a_member_that_says_it_is_larger_than_its_archive_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.zip"
    picture = cv2.imencode(".png", np.full((3, 4, 3), 90, np.uint8))[1].tobytes()
    with zipfile.ZipFile(path, "w") as file:
        for light in (10, 20):
            file.writestr(f"tl{light:03d}_pl000_tv000_pv000.png", picture)
    data = path.read_bytes()
    at = data.rindex(b"PK\x01\x02")
    sizes = struct.pack("<II", 1528902000, 2041545324)
    path.write_bytes(data[: at + 20] + sizes + data[at + 28 :])
    with pytest.raises(FormatError, match="says it takes 1528902000 of the file's"):
        btfkit.open(path).texture(1)


def test_text_of_a_query_file_that_is_no_unicode_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "q.npz"
    up = np.tile(np.float32([0, 0, 1]), (2, 1))
    text = np.frombuffer(b"\xff\xff\xff\x7f", "<U1").reshape(())
    np.savez(path, uv=up[:, :2], light=up, view=up, provenance=text)
    with pytest.raises(FormatError, match="holds text that cannot be read"):
        queryfile.read(path)


def test_channels_are_as_many_names_as_there_are_numbers(tmp_path: Path) -> None:
    path = tmp_path / "q.npz"
    up = np.tile(np.float32([0, 0, 1]), (2, 1))
    np.savez(path, uv=up[:, :2], light=up, view=up, rgb=up, channels=[["R", "G", "B"]])
    with pytest.raises(FormatError, match=r"channels of shape \(1, 3\) for rgb of 3"):
        queryfile.read(path)
