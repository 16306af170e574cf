"""DiLiGenT folders: photometric stereo with calibrated far lights.

    filenames.txt            one image a line
    light_directions.txt     x y z, one line an image: x right, y up, z to the camera
    light_intensities.txt    red, green and blue, one line an image
    mask.png                 bright where the object is; may be missing
    001.png ...              16-bit, linear

Values are divided by the intensities; outside the mask nothing is valid. Source: Shi et al.,
"A Benchmark Dataset and Evaluation for Non-Lambertian and Uncalibrated Photometric Stereo", 2016.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import BTF
from btfkit.errors import FormatError
from btfkit.io import listing, named
from btfkit.io.archive import Archive
from btfkit.io.images.masks import read_mask
from btfkit.io.lp import y_sign

# A lamp of less, relative to the others, is no lamp; its reciprocal still has to be a float32.
_FAINTEST = 1e-15
_REQUIRED = ("light_directions.txt", "light_intensities.txt", "filenames.txt")


def detect(path: Path) -> bool:
    """Whether a folder or zip holds the three text files; names only."""
    return listing.folder_with(listing.names_of(path), *_REQUIRED) is not None


def read(
    path: Path,
    *,
    transfer: str | None = None,
    cosine: str | None = None,
    orientation: str | None = None,
) -> BTF:
    """A DiLiGenT folder as a BTF of one view; textures are decoded when they are asked for.

    Args:
        path: folder or zip.
        transfer: of code values; "linear" by the publisher.
        cosine: "in" is assumed: photographs hold it.
        orientation: "y_up" (assumed) or "y_down", for files whose y runs down the rows.

    Raises:
        FormatError: damaged, or not as many lights as images.
    """
    values, record = named.assumptions(
        transfer=(transfer, "linear"),
        cosine=(cosine, "in"),
        orientation=(orientation, "y_up"),
        scale=(None, "relative: 1 is the brightest code value under a light of intensity 1"),
    )
    holder = Archive(path)
    base = listing.folder_with(holder.names, *_REQUIRED)
    if base is None:
        raise FormatError(path, f"lacks one of {', '.join(_REQUIRED)}")
    folder = PurePosixPath(base)
    names = _images(holder, base)
    light = _rows(holder, str(folder / "light_directions.txt"), len(names))
    light[:, 1] *= y_sign(values["orientation"])
    intensity = _rows(holder, str(folder / "light_intensities.txt"), len(names))
    if not ((intensity > _FAINTEST) & (intensity < 1 / _FAINTEST)).all():
        raise FormatError(
            path, f"light_intensities.txt holds one that is not {_FAINTEST:g} to {1 / _FAINTEST:g}"
        )
    scale = named.Product(
        named.Gains((1 / intensity).astype(np.float32)),
        named.cosine_factor(values["cosine"], light),
    )
    textures = named.ImageTextures(holder, names, named.Decoder.of(values, record), scale)
    if textures.shape[3] != 3:
        raise FormatError(path / names[0], f"{textures.shape[3]} channels; expected 3")
    validity, how = _mask(holder, str(folder / "mask.png"), textures.shape[1:3])
    return named.assembled(
        path,
        textures,
        light=light,
        view=np.broadcast_to([0.0, 0.0, 1.0], light.shape),
        validity=validity,
        provenance={
            "source": str(path), "format": "diligent", **record,
            **({"mask": how} if how else {}),
        },
    )  # fmt: skip


def _images(holder: Archive, base: str) -> list[str]:
    lines = holder.text(str(PurePosixPath(base) / "filenames.txt")).splitlines()
    listed = [line.strip() for line in lines if line.strip()]
    names = []
    for line in listed:
        name = holder.locate_image(line, base)
        if name is None:
            raise FormatError(holder.path, f"filenames.txt names {line!r}, which is not there")
        names.append(name)
    if not names:
        raise FormatError(holder.path, "filenames.txt names no image")
    if len(set(names)) < len(names):
        raise FormatError(holder.path, "filenames.txt names an image twice", remedy="remove one")
    return names


def _rows(holder: Archive, name: str, n: int) -> NDArray[np.float64]:
    rows = holder.table(name, 3)
    if len(rows) != n:
        raise FormatError(holder.path / name, f"{len(rows)} lines for {n} images")
    return rows


def _mask(
    holder: Archive, name: str, size: tuple[int, ...]
) -> tuple[NDArray[np.bool_], str] | tuple[None, None]:
    """(1, h, w) bool and how it was taken; None without a mask."""
    if name not in holder:
        return None, None
    mask, how = read_mask(str(holder.path / name), holder.read(name))
    if mask.shape != size:
        raise FormatError(holder.path / name, f"the mask is {mask.shape}; the images are {size}")
    return mask[None], how
