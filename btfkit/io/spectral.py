"""Bonn SPECTRAL: one multi-channel EXR a pair, its channels named by their wavelengths in nm.

    tv045_pv020/tv045.0_pv020.0_tl015.0_pl120.0.exr

Source of names and channels: cgbonn/btflib, imgs2bdi. Channels are put in the order of their
wavelengths, whatever their order in the file.
"""

from __future__ import annotations

import re
import zipfile
from pathlib import Path, PurePosixPath

from btfkit.btf import BTF
from btfkit.errors import FormatError
from btfkit.io import anglenames, archive, images, named
from btfkit.io.archive import Archive
from btfkit.textures import Array

SUFFIXES = {".exr"}
COLOUR = "spectral: one channel a wavelength in nm, linear"
# 400, 400.0, 400nm, w400, and S0.400,00nm of the spectral EXR layout by Fichet et al. 2021.
_WAVELENGTH = re.compile(r"(?:S0\.|T\.|[A-Za-z]*?)(\d{2,5}(?:[.,]\d+)?) *(?:nm)?", re.IGNORECASE)
_SHORTEST_NM, _LONGEST_NM = 100, 20000


def detect(path: Path) -> bool:
    """Whether EXRs named by angles have wavelengths for channels; reads one header."""
    names = [n for n in archive.names_of(path) if PurePosixPath(n).suffix.lower() in SUFFIXES]
    name = next((n for n in names if anglenames.parse(n)), None)
    if name is None:
        return False
    try:
        return bool(_order(images.exr_channels(name, _bytes(path, name))))
    except FormatError:
        return False


def read(path: Path, *, cosine: str | None = None) -> BTF:
    """A spectral BTF; textures are decoded when they are asked for.

    Args:
        path: folder or zip.
        cosine: "in" is assumed.

    Raises:
        FormatError: damaged, a pair twice, or images of different sizes or wavelengths.
    """
    values, record = named.assumptions(
        cosine=(cosine, "in"), scale=(None, "as stored: 1 is a white diffuser")
    )
    wanted: list[dict[float, str]] = []

    def decode(name: str, data: bytes) -> Array:
        pixels, channels, _ = images.read_exr(name, data)
        order = _order(channels)
        if not order:
            raise FormatError(name, f"channels {', '.join(channels[:6])}; expected wavelengths")
        if not wanted:
            wanted.append(order)
        if order.keys() != wanted[0].keys():
            raise FormatError(name, "has other wavelengths than the first image")
        return pixels[..., [channels.index(order[nm]) for nm in sorted(order)]]

    return named.read_named(
        path,
        decode,
        suffixes=SUFFIXES,
        cosine=values["cosine"],
        channels=lambda: tuple(f"{nm:g}" for nm in sorted(wanted[0])),
        colour=COLOUR,
        provenance={"format": "spectral", **record},
    )


def _order(channels: tuple[str, ...]) -> dict[float, str]:
    """Channel of each wavelength; empty unless every channel is one, each once."""
    order: dict[float, str] = {}
    for channel in channels:
        match = _WAVELENGTH.fullmatch(channel.strip())
        nm = float(match[1].replace(",", ".")) if match else 0.0
        if not _SHORTEST_NM <= nm <= _LONGEST_NM or nm in order:
            return {}
        order[nm] = channel
    return order


def _bytes(path: Path, name: str) -> bytes:
    """One member without checking the others."""
    if path.is_dir():
        return (path / name).read_bytes()
    try:
        return Archive(path).read(str(PurePosixPath(name.replace("\\", "/"))))
    except (KeyError, zipfile.BadZipFile) as error:
        raise FormatError(path, f"member {name!r} cannot be read ({error})") from error
