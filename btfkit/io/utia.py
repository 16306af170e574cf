"""UTIA BTFs: one PNG (sRGB) or EXR (half, CIE XYZ under D65) a pair, in a folder or a zip.

    tv000_pv000/tl000_pl000_tv000_pv000.png

Where light and view coincide the lamp was physically shifted; the name keeps the nominal angles.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, final

import numpy as np

from btfkit import colour, directions
from btfkit.btf import BTF
from btfkit.errors import FormatError
from btfkit.files import whole_folder
from btfkit.io import images, listing, named
from btfkit.io.archive import Archive
from btfkit.io.images import Image, exr
from btfkit.io.images.profiles import CIE_XYZ
from btfkit.textures import Array, narrowed

SUFFIXES = {".png", ".exr", ".jpg", ".jpeg"}


def detect(path: Path) -> bool:
    """Whether images named `tl000_pl000_tv000_pv000.*` lie in a folder or zip; names only."""
    return named.looks_named(listing.names_of(path), SUFFIXES, spaces=False)


def read(
    path: Path,
    *,
    transfer: str | None = None,
    cosine: str | None = None,
    exr_colour: str | None = None,
    light_shift: Path | None = None,
) -> BTF:
    """A UTIA BTF; textures are decoded when they are asked for.

    Args:
        path: folder or zip.
        transfer: of PNG code values, sRGB by the publisher.
        cosine: "in" is assumed.
        exr_colour: of EXR values: "xyz" (by the publisher) or "rgb".
        light_shift: a text table with columns number, theta, phi, theta_S, phi_S (degrees): where
            the lamp really stood when light and view coincide.

    Raises:
        FormatError: damaged, a pair twice, images of different sizes, or no such table.
    """
    values, record = named.assumptions(
        transfer=(transfer, "srgb"), cosine=(cosine, "in"), exr_colour=(exr_colour, "xyz")
    )
    if values["exr_colour"] not in ("xyz", "rgb"):
        raise ValueError(f"exr_colour {values['exr_colour']!r}; expected xyz or rgb")

    decode = _Decoder(
        named.Decoder.of(values, record),
        xyz=values["exr_colour"] == "xyz",
        assumed="exr_colour" in record["assumed"],
    )
    moved: dict[str, Any] = {}

    def relit(light: Array, view: Array) -> Array:
        if light_shift is None:
            return light
        shifted, pairs = _shifted(light, view, Path(light_shift))
        moved.update(light_shift=str(light_shift), light_shifted=pairs)
        return shifted

    btf = named.read_named(
        path,
        decode,
        suffixes=SUFFIXES,
        cosine=values["cosine"],
        relit=relit,
        provenance={"format": "utia", **record},
    )
    return replace(btf, provenance={**btf.provenance, **moved})


@final
class _Decoder:
    """Code values by the decoder of all formats; EXRs as XYZ or RGB.

    Args:
        codes: of everything but EXRs.
        xyz: whether R, G and B of an EXR hold XYZ. assumed: whether nobody said so: then what an
            EXR declares comes first.
    """

    def __init__(self, codes: named.Decoder, *, xyz: bool, assumed: bool) -> None:
        self._codes, self._xyz, self._assumed = codes, xyz, assumed

    def __call__(self, name: str, data: bytes) -> Image:
        if not name.lower().endswith(".exr"):
            return self._codes(name, data)
        file = pixels, channels, _ = images.read_exr(name, data)
        named_xyz = {"X", "Y", "Z"} <= set(channels)
        taken = ("X", "Y", "Z") if named_xyz else exr.colours(name, channels)
        if len(taken) != 3:
            raise FormatError(name, f"channels {', '.join(channels)}; expected three of colour")
        image = exr.of_channels(name, file, taken)
        if image.declared is not None and self._assumed and not image.declared.is_xyz:
            return image
        stored = pixels[..., [channels.index(channel) for channel in taken]]
        linear = colour.xyz_to_rgb(stored) if named_xyz or self._xyz else stored
        return replace(image, linear=linear, declared=None)


def _shifted(light: Array, view: Array, table: Path) -> tuple[Array, list[int]]:
    """(n, 3) true lights, and the pairs (whose nominal light and view coincide) that moved."""
    table = table.resolve()
    rows = Archive(table.parent).table(table.name, 5, comments="#%")
    if (np.abs(rows[:, 1:]) > 360).any() or (rows[:, [1, 3]] < 0).any():
        raise FormatError(table, "holds angles that are none; expected degrees")
    theta, phi, theta_s, phi_s = np.radians(rows[:, 1:]).T
    nominal, real = directions.from_angles(theta, phi), directions.from_angles(theta_s, phi_s)
    shifted, moved = light.copy(), []
    coincide = np.flatnonzero(np.sum(light * view, axis=1) > 1 - 1e-6)
    for pair in coincide:
        match = np.flatnonzero(nominal @ light[pair] > 1 - 1e-6)
        if match.size:
            shifted[pair] = real[match[0]]
            moved.append(int(pair))
    if len(moved) < len(coincide):
        warnings.warn(
            f"{table}: has no row for {len(coincide) - len(moved)} of {len(coincide)} pairs whose "
            "light and view coincide",
            stacklevel=4,
        )
    return shifted, moved


def write(
    btf: BTF,
    path: str | os.PathLike[str],
    *,
    exr: bool = False,
    force: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write a folder of images named as UTIA does; angles with as many decimals as they need.

    Args:
        btf: of three channels.
        path: folder to write; one folder a view inside.
        exr: half EXR in CIE XYZ, unclamped; else 8-bit sRGB PNG.
        force: whether an existing folder is replaced.
        progress: called with (images written, n).

    Raises:
        ValueError: not three channels, or two pairs with the same name.
    """
    if btf.shape[3] != 3:
        raise ValueError(f"UTIA files hold three channels; the BTF has {btf.shape[3]}")
    names = [_name(btf.light[i], btf.view[i], exr) for i in range(len(btf))]
    if len(set(names)) < len(names):
        raise ValueError("two pairs are closer than 0.01 degrees; write manifest instead")
    lost = named.Lost()
    with whole_folder(path, force=force) as folder:
        for pair, name in enumerate(names):
            file = folder / name
            file.parent.mkdir(exist_ok=True)
            texture = btf.texture(pair)
            if exr:
                xyz = narrowed(colour.rgb_to_xyz(texture))
                images.write_exr(file, xyz, ("R", "G", "B"), chromaticities=CIE_XYZ)
            else:
                file.write_bytes(images.encode_png(lost.count(texture)))
            if progress:
                progress(pair + 1, len(btf))
    lost.warn(path, remedy="EXR (exr=True) keeps them")


def _name(light: Array, view: Array, exr: bool) -> str:
    (tl, pl), (tv, pv) = _degrees(light), _degrees(view)
    return f"tv{tv}_pv{pv}/tl{tl}_pl{pl}_tv{tv}_pv{pv}.{'exr' if exr else 'png'}"


def _degrees(direction: Array) -> tuple[str, str]:
    """Angles as text: 045, or 007.5 where a whole degree would move the direction."""
    theta, phi = (float(np.degrees(angle)) for angle in directions.to_angles(direction))
    return _angle(theta), _angle(phi % 360)


def _angle(degrees: float) -> str:
    rounded = round(degrees, 3)
    whole = round(rounded)
    if abs(rounded - whole) < 0.01:
        return f"{whole % 360:03d}"
    return f"{rounded:07.3f}".rstrip("0")
