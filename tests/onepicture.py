"""Sources of every reader that takes images, each of one picture, lit and seen from above."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Reader:
    """How a picture gets before a reader.

    Attributes:
        make: folder, suffix and bytes to the source.
        suffixes: of the pictures it takes.
        assumes: the transfer where no file says one.
        colours: how many channels it takes; 0 for any.
        square: whether pictures have to be.
    """

    make: Callable[[Path, str, bytes], Path]
    suffixes: tuple[str, ...]
    assumes: str = "srgb"
    colours: int = 0
    square: bool = False


ANY = (".png", ".jpg", ".tif", ".bmp", ".exr", ".hdr")


def _named(name: str) -> Callable[[Path, str, bytes], Path]:
    def make(folder: Path, suffix: str, data: bytes) -> Path:
        (folder / (name + suffix)).write_bytes(data)
        return folder

    return make


def _manifest(folder: Path, suffix: str, data: bytes) -> Path:
    (folder / f"a{suffix}").write_bytes(data)
    (folder / "manifest.csv").write_text(f"file,tl,pl\na{suffix},0,0\n")
    return folder


def _lp(folder: Path, suffix: str, data: bytes) -> Path:
    (folder / f"a{suffix}").write_bytes(data)
    (folder / "a.lp").write_text(f"1\na{suffix} 0 0 1\n")
    return folder


def _diligent(folder: Path, suffix: str, data: bytes) -> Path:
    (folder / f"a{suffix}").write_bytes(data)
    (folder / "filenames.txt").write_text(f"a{suffix}\n")
    (folder / "light_directions.txt").write_text("0 0 1\n")
    (folder / "light_intensities.txt").write_text("1 1 1\n")
    return folder


def _materialgan(folder: Path, suffix: str, data: bytes) -> Path:
    (folder / f"00{suffix}").write_bytes(data)
    for name in ("camera_pos.txt", "light_pos.txt"):
        (folder / name).write_text("0,0,16.5\n")
    (folder / "image_size.txt").write_text("6.8\n")
    return folder


READERS: dict[str, Reader] = {
    "ubo2003": Reader(_named("00000 tl000 pl000 tv000 pv000"), (".png", ".jpg", ".hdr")),
    "utia": Reader(_named("tl000_pl000_tv000_pv000"), (".png", ".jpg", ".exr")),
    "manifest": Reader(_manifest, ANY),
    "lp": Reader(_lp, ANY),
    "diligent": Reader(_diligent, ANY, assumes="linear", colours=3),
    "materialgan": Reader(_materialgan, ANY, assumes="2.2", colours=3, square=True),
}
