"""Sources that declare or unpack to far more than they are: refused at once, in bounded memory.

All are read in one process of two gigabytes of address space (a third of it is libraries): what
allocates by what a header says ends there in a MemoryError, which is no answer.
"""

from __future__ import annotations

import json
import os
import re
import resource
import struct
import subprocess
import sys
import textwrap
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sources

from btfkit.io import images

LIMIT = 2 << 30
READER = """
    import json, sys, time, warnings
    from pathlib import Path
    import numpy, cv2, OpenImageIO, zarr  # what is loaded once does not count
    import btfkit
    from btfkit.errors import BtfkitError
    for line in sys.stdin:
        case = json.loads(line)
        start, said = time.monotonic(), {}
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            try:
                btf = btfkit.open(case["path"], format=case["format"])
                for pair in range(min(4, len(btf))):
                    btf.texture(pair)
                said["error"], said["message"] = None, str(btf.shape)
            except BaseException as error:
                harmless = isinstance(error, (BtfkitError, ValueError, OSError))
                said["error"] = "refused" if harmless else type(error).__name__
                said["message"] = str(error)
        said["warnings"] = [str(warning.message) for warning in told]
        said["seconds"] = time.monotonic() - start
        print(json.dumps(said), flush=True)
"""


def png(side: tuple[int, int], body: bytes) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    head = struct.pack(">IIBBBBB", side[1], side[0], 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


def black_png(side: int) -> bytes:
    """A valid black picture: a thousandth of what it unpacks to."""
    packer = zlib.compressobj(9)
    line = bytes(1 + 3 * side)
    body = b"".join(packer.compress(line) for _ in range(side)) + packer.flush()
    return png((side, side), body)


def bmp(side: int) -> bytes:
    """Run-length coded, with hardly a run."""
    head = struct.pack("<IiiHHIIiiII", 40, side, side, 1, 8, 1, 4, 0, 0, 256, 0)
    return b"BM" + struct.pack("<IHHI", 2000, 0, 0, 1078) + head + bytes(1024) + b"\0\1\0\1"


def tiff(side: int) -> bytes:
    tags = [
        (256, 4, side),
        (257, 4, side),
        (258, 3, 8),
        (259, 3, 1),
        (262, 3, 1),
        (273, 4, 8),
        (277, 3, 1),
        (278, 4, side),
        (279, 4, 100),
    ]
    entries = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in tags)
    return b"II" + struct.pack("<HIH", 42, 8, len(tags)) + entries + bytes(200)


def jpeg(side: int) -> bytes:
    data = images.encode_jpeg(np.zeros((8, 8, 3), np.float32))
    at = data.index(b"\xff\xc0") + 5
    return data[:at] + struct.pack(">HH", side, side) + data[at + 4 :]


def scans(count: int) -> bytes:
    data = images.encode_jpeg(np.zeros((8, 8, 3), np.float32))
    at = data.index(b"\xff\xda")
    return data[:at] + data[at:-2] * count + data[-2:]


def exr(folder: Path, channels: int, window: tuple[int, int] | None) -> bytes:
    names = [f"{400 + i}" for i in range(channels)]
    images.write_exr(folder / "x.exr", np.zeros((2, 2, channels), np.float16), names)
    data = (folder / "x.exr").read_bytes()
    (folder / "x.exr").unlink()
    if window:
        for name in (b"dataWindow", b"displayWindow"):
            at = data.index(name + b"\0box2i\0") + len(name) + 19
            data = data[:at] + struct.pack("<ii", *window) + data[at + 8 :]
    return data


def hdr(side: int) -> bytes:
    return (
        f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {side} +X {side}\n".encode() + b"\2\2\0\1" * 50
    )


def named(suffix: str, data: Callable[[Path], bytes]) -> Callable[[Path], Path]:
    """One image that a reader of angles finds by its name."""

    def make(folder: Path) -> Path:
        (folder / f"tl015_pl000_tv000_pv000{suffix}").write_bytes(data(folder))
        return folder

    return make


def changed(kind: str, file: str, change: Callable[[str], str]) -> Callable[[Path], Path]:
    """A sample with one of its text files changed."""

    def make(folder: Path) -> Path:
        path = sources.SOURCES[kind](folder)
        (path / file).write_text(change((path / file).read_text()))
        return path

    return make


def in_manifest(**entries: Any) -> Callable[[Path], Path]:
    return changed(
        "manifest", "manifest.json", lambda text: json.dumps({**json.loads(text), **entries})
    )


def in_store(file: str, **entries: Any) -> Callable[[Path], Path]:
    return changed("zarr", file, lambda text: json.dumps({**json.loads(text), **entries}))


def sparse(kind: str, file: str) -> Callable[[Path], Path]:
    """A sample with one file of 20 GB, of which the disk holds nothing."""

    def make(folder: Path) -> Path:
        path = sources.SOURCES[kind](folder)
        os.truncate(path / file if path.is_dir() else path, 20 << 30)
        return path

    return make


def packed(data: bytes, count: int = 1) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        with zipfile.ZipFile(folder / "x.zip", "w", zipfile.ZIP_DEFLATED) as file:
            for index in range(count):
                file.writestr(f"tl{index % 90:03d}_pl000_tv000_pv000.png", data)
        return folder / "x.zip"

    return make


def one(name: str, data: bytes) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / name).write_bytes(data)
        return folder / name

    return make


LINES = "a.png 0 0 1\n"
NESTED = "[" * 200_000 + "]" * 200_000
HUGE = 10**3000
ENTRY = '{"file": "a.exr", "light": [0, 0, 1]}'
# Name: format, source, what the message says; None where the rest can still be used.
CASES: dict[str, tuple[str, Callable[[Path], Path], str | None]] = {
    "zip bomb": ("utia", packed(bytes(1 << 28)), "says it unpacks from"),
    "png declares": ("utia", named(".png", lambda _: png((2**31 - 1, 2**31 - 1), b"x")), "declares 2147483647"),
    "png unpacks": ("utia", named(".png", lambda _: black_png(12000)), "declares 12000 x 12000 x 3 values in"),
    "png in zip": ("utia", packed(black_png(12000)), "declares 12000 x 12000"),
    "bmp declares": ("manifest", lambda f: image_of(f, "a.bmp", bmp(30000)), "declares 30000 x 30000"),
    "tiff declares": ("manifest", lambda f: image_of(f, "a.tif", tiff(60000)), "declares 60000 x 60000"),
    "jpeg declares": ("ubo2003", lambda f: named(".jpg", lambda _: jpeg(65500))(f), "declares 65500 x 65500"),
    "jpeg scans": ("utia", named(".jpg", lambda _: scans(5000)), "more than 100 scans"),
    "exr window": ("utia", named(".exr", lambda f: exr(f, 3, (50000, 50000))), "declares|EXR"),
    "exr bomb": ("utia", named(".exr", lambda f: exr(f, 3, (11000, 11000))), "declares 11001 x 11001 x 3 values in|EXR"),
    "hdr declares": ("ubo2003", named(".hdr", lambda _: hdr(30000)), "declares|flat pixels"),
    "hdr lines": ("ubo2003", named(".hdr", lambda _: hdr(9000)), "cut short|start with its length|flat pixels"),
    "image of 20 GB": ("materialgan", sparse("materialgan", "00.png"), "larger than 2147483648 bytes"),
    "table of 20 GB": ("materialgan", sparse("materialgan", "light_pos.txt"), "21474836480 bytes of text"),
    "manifest of 20 GB": ("manifest", sparse("manifest", "manifest.json"), "21474836480 bytes of text"),
    "lp of 20 GB": ("lp", sparse("lp", "dirs.lp"), "21474836480 bytes of text"),
    "merl of 20 GB": ("merl", sparse("merl", ""), "21474836480 bytes; expected 34992012"),
    "utia brdf of 20 GB": ("utia_brdf", sparse("utia_brdf", ""), "21474836480 bytes; expected 1990656"),
    "store metadata of 20 GB": ("zarr", sparse("zarr", "zarr.json"), "not a readable Zarr group|bytes"),
    "lp count": ("lp", changed("lp", "dirs.lp", lambda t: "999999999" + t[1:]), None),
    "lp count of many digits": ("lp", changed("lp", "dirs.lp", lambda t: "9" * 5000 + t[1:]), "expected the number of images"),
    "lp line of digits": ("lp", one("a.lp", b"1\n" + b"1" * 3_000_000), "expected: file x y z"),
    "lp line of commas": ("lp", one("a.lp", b"1\na" + b",1" * 2_000_000 + b"x"), "expected: file x y z"),
    "lp line of dots": ("lp", one("a.lp", b"1\n" + b"1.1e1 ." * 500_000), "expected: file x y z"),
    "merl dimensions": ("merl", one("a.binary", struct.pack("<iii", 90, 90, 2**31 - 1) + bytes(64)), "expected \\(90, 90, 180\\)"),
    "merl of the other end": ("merl", one("a.binary", struct.pack(">iii", 90, 90, 180) + bytes(64)), "expected \\(90, 90, 180\\)"),
    "store texture": ("zarr", in_store("texture/zarr.json", shape=[4, 2**20, 2**20, 3]), "texture has shape"),
    "store pairs": ("zarr", in_store("texture/zarr.json", shape=[2**40, 5, 7, 3]), "texture has shape"),
    "store light": ("zarr", in_store("light/zarr.json", shape=[2**40, 3]), "light is float32 of shape"),
    "store chunks": ("zarr", in_store("light/zarr.json", chunk_grid={"name": "regular", "configuration": {"chunk_shape": [2**40, 3]}}), "damaged|missing"),
    "store of pickles": ("zarr", in_store("light/zarr.json", codecs=[{"name": "pickle"}]), "Unknown codec"),
    "store nested": ("zarr", changed("zarr", "zarr.json", lambda _: '{"btfkit": ' + NESTED + "}"), "not a readable Zarr group"),
    "store colour": ("zarr", changed("zarr", "zarr.json", lambda t: t.replace('"linear BT.709, D65"', "[1]")), "colour is '\\[1\\]'"),
    "store texel": ("zarr", changed("zarr", "zarr.json", lambda t: t.replace("0.25", str(HUGE))), "contradicts itself"),
    "manifest nested": ("manifest", one("a.json", f'{{"images": [{ENTRY}], "provenance": {{"a": {NESTED}}}}}'.encode()), "not JSON"),
    "manifest nested less": ("manifest", one("a.json", f'{{"images": [{ENTRY}], "provenance": {{"a": {NESTED[199_800:200_200]}}}}}'.encode()), "nested more than 50 deep"),
    "manifest texel": ("manifest", in_manifest(texel_mm=HUGE), "texel_mm is no sensible number"),
    "manifest power": ("manifest", in_manifest(light_power=HUGE), "light_power"),
    "manifest nan": ("manifest", in_manifest(texel_mm=float("nan")), "NaN is no JSON number"),
    "manifest key twice": ("manifest", one("a.json", f'{{"images": [{ENTRY}], "images": []}}'.encode()), "'images' stands twice"),
    "manifest position": ("manifest", in_manifest(images=[{"file": "images/00000.exr", "light": [HUGE, 0, 1]}]), "expected a number"),
    "manifest names": ("manifest", in_manifest(images=[{"file": "a" * 100_000, "light": [0, 0, 1]}]), "none of the 1 images"),
    "manifest NUL": ("manifest", in_manifest(images=[{"file": "a\0.exr", "light": [0, 0, 1]}]), "would leave the folder"),
    "manifest surrogate": ("manifest", in_manifest(images=[{"file": "\ud800.exr", "light": [0, 0, 1]}]), "none of the 1 images"),
    "csv cell": ("manifest", one("a.csv", b'file,tl,pl\n"' + b"a" * 1_000_000 + b'",0,0\n'), "not CSV|none of the"),
    "csv columns": ("manifest", one("a.csv", b"file,tl,pl" + b",x" * 1_000_000 + b"\na,0,0\n"), "line 1|names no columns|line 2 has 3 cells"),
    "csv quote": ("manifest", one("a.csv", b'file,tl,pl\n"' + b"a,0,0\n" * 200_000), "not CSV|cells|none of the"),
    "csv number": ("manifest", one("a.csv", b"file,tl,pl\na.png," + b"9" * 100_000 + b",0\n"), "tl is '9999"),
}  # fmt: skip


def image_of(folder: Path, name: str, data: bytes) -> Path:
    (folder / name).write_bytes(data)
    (folder / "manifest.csv").write_text(f"file,tl,pl\n{name},0,0\n")
    return folder


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """What one process of limited memory says to every case."""
    jobs = []
    for kind, make, _ in CASES.values():
        path = make(tmp_path_factory.mktemp("case"))
        jobs.append(json.dumps({"path": str(path), "format": kind}))
    process = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(READER)],
        input="\n".join(jobs) + "\n",
        capture_output=True,
        text=True,
        timeout=300,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (LIMIT, LIMIT)),
        # Each thread of a numeric library sets address space aside.
        env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )
    lines = process.stdout.splitlines()
    assert len(lines) == len(CASES), process.stderr[-2000:]
    return dict(zip(CASES, map(json.loads, lines), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_what_declares_too_much_is_refused_within_seconds_and_memory(
    case: str, answers: dict[str, dict[str, Any]]
) -> None:
    answer, expected = answers[case], CASES[case][2]
    if expected is None:
        assert answer["error"] is None
        assert answer["warnings"]
        return
    assert answer["error"] == "refused", answer
    assert re.search(expected, answer["message"]), answer["message"]
    assert "\n" not in answer["message"]
    assert len(answer["message"]) < 1000
    assert answer["seconds"] < 10
