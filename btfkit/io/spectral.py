"""Bonn SPECTRAL: one multi-channel EXR a pair, its channels named by their wavelengths in nm.

    tv045_pv020/tv045.0_pv020.0_tl015.0_pl120.0.exr

Source of names and channels: cgbonn/btflib, imgs2bdi. Channels are put in the order of their
wavelengths, whatever their order in the file.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import final

import numpy as np

from btfkit.btf import BTF
from btfkit.errors import FormatError
from btfkit.io import anglenames, images, listing, named
from btfkit.io.archive import Archive
from btfkit.io.images import Image

SUFFIXES = {".exr"}
COLOUR = "spectral: one channel a wavelength in nm, linear"
# 400, 400.0, 400nm, w400, and S0.400,00nm of the spectral EXR layout by Fichet et al. 2021.
_WAVELENGTH = re.compile(r"(?:S0\.|T\.|[A-Za-z]*?)(\d{2,5}(?:[.,]\d+)?) *(?:nm)?", re.IGNORECASE)
# A preview, alpha, depth, luminance, and Stokes components beyond the intensity.
_BESIDE = re.compile(r"(?:.*\.)?(?:[RGBAYZ]|RY|BY)|S[123]\..*", re.IGNORECASE)
# Headers that are looked at before none is taken to be readable.
_LOOKS = 5
_SHORTEST_NM, _LONGEST_NM = 100, 20000


def detect(path: Path) -> bool:
    """Whether EXRs named by angles have wavelengths for channels; reads a header."""
    names = [n for n in listing.names_of(path) if PurePosixPath(n).suffix.lower() in SUFFIXES]
    for name in [n for n in names if anglenames.is_named(n)][:_LOOKS]:
        try:
            return bool(wavelengths(name, images.exr_channels(name, _bytes(path, name))))
        except FormatError:
            continue
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
    decode = Decoder()
    return named.read_named(
        path,
        decode,
        suffixes=SUFFIXES,
        cosine=values["cosine"],
        channels=lambda: decode.channels,
        colour=COLOUR,
        provenance={"format": "spectral", **record},
    )


@final
class Decoder:
    """EXRs to their wavelengths, ascending: those of the first, which all others must have.

    Attributes:
        channels: wavelengths in nm, once the first is decoded.
    """

    def __init__(self) -> None:
        self.channels: tuple[str, ...] = ()

    def __call__(self, name: str, data: bytes) -> Image:
        pixels, channels, _ = images.read_exr(name, data)
        order = wavelengths(name, channels)
        if not order:
            raise FormatError(name, f"channels {', '.join(channels[:6])}; expected wavelengths")
        names = tuple(f"{nm:g}" for nm in sorted(order))
        self.channels = self.channels or names
        if names != self.channels:
            raise FormatError(name, "has other wavelengths than the first image")
        taken = [order[nm] for nm in sorted(order)]
        beside = tuple(c for c in channels if c not in taken)
        values = pixels[..., [channels.index(channel) for channel in taken]]
        return Image(values, None, np.dtype(np.float32), None, beside)


def wavelengths(name: str, channels: Sequence[str]) -> dict[float, str]:
    """The channel of each wavelength, nm; empty without any.

    A preview in RGB, alpha, depth and the further Stokes components are no wavelengths and are left
    out.

    Raises:
        FormatError: a wavelength twice, or beside wavelengths a channel that is nothing known.
    """
    order: dict[float, str] = {}
    strange = []
    for channel in channels:
        match = _WAVELENGTH.fullmatch(channel.strip())
        nm = float(match[1].replace(",", ".")) if match else 0.0
        if _SHORTEST_NM <= nm <= _LONGEST_NM:
            if nm in order:
                raise FormatError(
                    name, f"channels {order[nm]} and {channel} are one wavelength",
                    remedy="save the one that is meant",
                )  # fmt: skip
            order[nm] = channel
        elif not _BESIDE.fullmatch(channel.strip()):
            strange.append(channel)
    if order and strange:
        raise FormatError(
            name, f"has wavelengths and channels {', '.join(strange[:6])}; expected wavelengths, "
            "and at most a preview in RGB, alpha and depth",
            remedy="save the wavelengths by themselves",
        )  # fmt: skip
    return order


def _bytes(path: Path, name: str) -> bytes:
    """One member without checking the others."""
    if path.is_dir():
        return (path / name).read_bytes()
    try:
        return Archive(path).read(str(PurePosixPath(name.replace("\\", "/"))))
    except (KeyError, zipfile.BadZipFile) as error:
        raise FormatError(path, f"member {name!r} cannot be read ({error})") from error
