"""UBO2003 and ATRIUM (University of Bonn): one JPEG or Radiance image a pair, in a folder or a zip.

    MANYFILES/tv000_pv000/00081 tl015 pl000 tv000 pv000.jpg

The running number is 81 * light + view; pairs are taken in its order. Images are rectified to the
frontal view; phi = 0 is image +x and phi grows counter-clockwise, y up.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from btfkit import directions
from btfkit.btf import BTF
from btfkit.files import whole_folder
from btfkit.io import images, listing, named
from btfkit.io.anglenames import Angles

SUFFIXES = {".jpg", ".jpeg", ".png", ".hdr"}


def detect(path: Path) -> bool:
    """Whether images named `... tl000 pl000 tv000 pv000.*` lie in a folder or zip; names only."""
    return named.looks_named(listing.names_of(path), SUFFIXES, spaces=True)


def read(
    path: Path,
    *,
    transfer: str | None = None,
    cosine: str | None = None,
    orientation: str | None = None,
) -> BTF:
    """A UBO2003 or ATRIUM BTF; textures are decoded when they are asked for.

    Args:
        path: folder or zip.
        transfer: of JPEG code values; the database does not say, sRGB is assumed (brightness
            against the angle of the light then falls as that of paper does).
        cosine: "in" is assumed: brightness falls with the cosine.
        orientation: of Radiance images: "standard" (assumed) or "btf_extractor".

    Raises:
        FormatError: damaged, a pair twice, or images of different sizes.
    """
    values, record = named.assumptions(
        transfer=(transfer, "srgb"),
        cosine=(cosine, "in"),
        orientation=(orientation, "standard"),
        scale=(None, "relative: 1 is the brightest code value"),
    )
    return named.read_named(
        path,
        named.Decoder(
            values["transfer"],
            assumed="transfer" in record["assumed"],
            orientation=values["orientation"],
        ),
        suffixes=SUFFIXES,
        cosine=values["cosine"],
        number=_running_number,
        provenance={"format": "ubo2003", **record},
    )


def write(
    btf: BTF,
    path: str | os.PathLike[str],
    *,
    quality: int = 100,
    force: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write a folder of JPEGs named as UBO2003 does; values are clamped to 0..1 and sRGB encoded.

    Args:
        btf: whose directions must be whole degrees, as the names hold no more.
        path: folder to write; one folder a view inside.
        quality: of the JPEG, 1 to 100.
        force: whether an existing folder is replaced.
        progress: called with (images written, n).

    Raises:
        ValueError: channels that a JPEG does not have, or directions between whole degrees.
    """
    if btf.shape[3] not in (1, 3):
        raise ValueError(f"UBO2003 files hold 1 or 3 channels; the BTF has {btf.shape[3]}")
    names = _names(btf)
    lost = named.Lost()
    with whole_folder(path, force=force) as folder:
        for pair, name in enumerate(names):
            file = folder / name
            file.parent.mkdir(parents=True, exist_ok=True)
            texture = lost.count(btf.texture(pair))
            file.write_bytes(images.encode_jpeg(texture, quality=quality))
            if progress:
                progress(pair + 1, len(btf))
    lost.warn(path, remedy="manifest keeps them")


def _names(btf: BTF) -> list[str]:
    """Relative names: running number (81 * light + view where they are Bonn's), four angles."""
    lights, light_index = directions.unique(btf.light)
    views, view_index = directions.unique(btf.view)
    for name, table in (("light", lights), ("view", views)):
        _refuse_fractions(name, table)
    light_degrees, view_degrees = (_whole_degrees(table) for table in (lights, views))
    names = []
    for i, j in zip(light_index, view_index, strict=True):
        (tl, pl), (tv, pv) = light_degrees[i], view_degrees[j]
        number = _running_number(Angles(tl, pl, tv, pv))
        number = number if number >= 0 else len(views) * int(i) + int(j)
        base = f"{number:05d} tl{tl:03d} pl{pl:03d} tv{tv:03d} pv{pv:03d}.jpg"
        names.append(f"tv{tv:03d}_pv{pv:03d}/{base}")
    if len({name.split(" ", 1)[1] for name in names}) < len(names):
        raise ValueError(
            "directions are closer than one degree: UBO2003 names cannot tell them apart; "
            "write utia or manifest instead"
        )
    return names


def _refuse_fractions(name: str, table: np.ndarray) -> None:
    """Refuse directions that whole degrees would move."""
    rounded = directions.from_angles(*np.radians(np.array(_whole_degrees(table), float)).T)
    moved = np.linalg.norm(rounded - table, axis=1)
    worst = int(np.argmax(moved))
    # float32 directions are 1e-5 degrees off; 0.05 would be told from a whole degree in any name.
    if moved[worst] > np.radians(0.05):
        theta, phi = np.degrees(directions.to_angles(table[worst]))
        raise ValueError(
            f"a {name} has angles {theta:.2f}, {phi:.2f}: UBO2003 names hold whole degrees; "
            "write utia or manifest instead"
        )


@functools.cache
def _bonn81() -> dict[tuple[float, float], int]:
    degrees = _whole_degrees(directions.bonn81())
    return {angles: index for index, angles in enumerate(degrees)}


def _running_number(angles: Angles) -> int:
    """81 * light + view as in Bonn's table of 81 directions; -1 for directions outside it."""
    light = _bonn81().get((angles.tl, angles.pl % 360 if angles.tl else 0))
    view = _bonn81().get((angles.tv, angles.pv % 360 if angles.tv else 0))
    return -1 if light is None or view is None else 81 * light + view


def _whole_degrees(table: np.ndarray) -> list[tuple[int, int]]:
    theta, phi = directions.to_angles(table)
    degrees = np.rint(np.degrees([theta, phi])).astype(int)
    return [(int(t), int(p) % 360) for t, p in degrees.T]
