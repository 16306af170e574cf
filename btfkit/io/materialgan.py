"""MaterialGAN folders: photographs of a flat sample, with positions of camera and flash.

    00.png 01.png ...        rectified, square
    camera_pos.txt           x,y,z in cm, one line an image (or one for all)
    light_pos.txt            the same; with a flash beside the lens equal to the camera
    image_size.txt           edge of the images in cm
    light_power.txt          red, green and blue power of the lamp; may be missing

Frame and radiometry follow the publisher's renderer: x right, y up, z out of the sample, origin
in the middle; code value = (power f cos / d^2)^(1/2.2) texel by texel, so that the quantity is
pi d^2 / power times the linear value. Source: tflsguoyu/materialgan, src/render.py.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import numpy as np

from btfkit.btf import BTF
from btfkit.errors import FormatError
from btfkit.io import images, listing, named
from btfkit.io.archive import Archive
from btfkit.nearfield import PointLight
from btfkit.textures import Array

_REQUIRED = ("light_pos.txt", "camera_pos.txt", "image_size.txt")
_MM_PER_CM = 10.0


def detect(path: Path) -> bool:
    """Whether a folder or zip holds the three text files; names only."""
    return listing.folder_with(listing.names_of(path), *_REQUIRED) is not None


def read(path: Path, *, transfer: str | None = None, cosine: str | None = None) -> BTF:
    """A MaterialGAN folder as a BTF with positions; textures are decoded when asked for.

    Args:
        path: folder or zip.
        transfer: of code values; exponent 2.2 is assumed, as in the publisher's code.
        cosine: "in" is assumed: photographs hold it.

    Raises:
        FormatError: damaged, or not as many positions as images.
    """
    holder = Archive(path)
    base = listing.folder_with(holder.names, *_REQUIRED)
    if base is None:
        raise FormatError(path, f"lacks one of {', '.join(_REQUIRED)}")
    folder = PurePosixPath(base)
    names = _images(holder, base)
    if not names:
        raise FormatError(path, "no image is named by a number, like 00.png")
    light = _positions(holder, str(folder / "light_pos.txt"), len(names))
    view = _positions(holder, str(folder / "camera_pos.txt"), len(names))
    size = holder.table(str(folder / "image_size.txt"), 1)
    if size.shape[0] != 1 or not 1e-3 < size[0, 0] < 1e5:
        raise FormatError(path, f"image_size.txt holds {size.ravel().tolist()}; expected one edge")
    power = _power(holder, str(folder / "light_power.txt"))
    values, record = named.assumptions(
        transfer=(transfer, "2.2"),
        cosine=(cosine, "in"),
        scale=(
            None,
            "relative: 1 is the brightest code value, irradiance of the first light in the middle"
            if power is None
            else "irradiance at a texel is light_power / distance^2, distance in cm",
        ),
    )
    if values["cosine"] not in ("in", "out"):
        raise ValueError(f"cosine {values['cosine']!r}; expected in or out")
    plain = named.ImageTextures(holder, names, named.Decoder.of(values, record))
    _, h, w, c = plain.shape
    if c != 3:
        raise FormatError(path / names[0], f"{c} channels; expected 3")
    if h != w:
        raise FormatError(path / names[0], f"is {h} x {w}; image_size.txt holds for squares only")
    if power is None:
        power_mm = np.full((1, 1), np.pi * np.sum(light[0] ** 2))
    else:
        power_mm = power[None] * _MM_PER_CM**2
    texel_mm = float(size[0, 0]) * _MM_PER_CM / w
    scale = PointLight(
        position_mm=light,
        texel_mm=texel_mm,
        power=np.broadcast_to(power_mm, (len(names), power_mm.shape[1])),
        cosine=values["cosine"] == "out",
    )
    return named.assembled(
        path,
        plain.scaled(scale),
        light=light,
        view=view,
        light_position=light,
        view_position=view,
        texel_mm=texel_mm,
        provenance={
            "source": str(path),
            "format": "materialgan",
            "light_power": None if power is None else power.tolist(),
            **record,
        },
    )


def _images(holder: Archive, base: str) -> list[str]:
    """Images in the folder that are named by a number, in the order of the numbers."""
    found = []
    for name in holder.names:
        path = PurePosixPath(name)
        inside = path.parent == PurePosixPath(base)
        if inside and images.is_image(name) and path.stem.isdecimal() and len(path.stem) < 10:
            found.append((int(path.stem), name))
    numbers = [number for number, _ in found]
    if len(set(numbers)) < len(numbers):
        raise FormatError(holder.path, "two images have the same number", remedy="remove one")
    return [name for _, name in sorted(found)]


def _positions(holder: Archive, name: str, n: int) -> Array:
    """(n, 3) millimetres of one line an image, or one for all."""
    rows = holder.table(name, 3) * _MM_PER_CM
    if len(rows) not in (1, n):
        raise FormatError(holder.path / name, f"{len(rows)} positions for {n} images")
    low = np.flatnonzero(rows[:, 2] <= 0)
    if low.size:
        raise FormatError(
            holder.path / name, f"line {low[0] + 1} lies on or below the sample (z <= 0)"
        )
    return np.broadcast_to(rows, (n, 3)).astype(np.float32)


# Radiance x cm^2 beyond which, or below its inverse, no lamp is: such numbers are damage.
_FAINTEST = 1e-15


def _power(holder: Archive, name: str) -> Array | None:
    if name not in holder:
        return None
    power = holder.table(name, 3)
    if len(power) != 1 or not ((power > _FAINTEST) & (power < 1 / _FAINTEST)).all():
        raise FormatError(
            holder.path / name, f"holds {power.ravel().tolist()}; expected three powers above 0"
        )
    return power[0]
