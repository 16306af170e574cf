"""Reflectance transformation imaging: a light position file `*.lp` and the images it names.

    3
    jpg/lion_0001.jpg -0.0019 -0.1472 0.9891

The first line is the number of images; each line is a file name, which may contain spaces or be
a path of the machine that wrote it, and a direction: x right, y up, z to the camera, which
looks straight down.
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path, PurePosixPath

import numpy as np

from btfkit.btf import BTF
from btfkit.errors import FormatError
from btfkit.io import listing, named, numerals
from btfkit.io.archive import Archive

_SHORTEST = 1e-4


def detect(path: Path) -> bool:
    """Whether it is an .lp file, or a folder or zip with one; names only."""
    if path.is_file() and path.suffix.lower() == ".lp":
        return True
    return bool(_light_files(listing.names_of(path)))


def read(
    path: Path,
    *,
    transfer: str | None = None,
    cosine: str | None = None,
    orientation: str | None = None,
) -> BTF:
    """An RTI sequence as a BTF of one view; textures are decoded when they are asked for.

    Args:
        path: .lp file beside its images, or a folder or zip that holds one.
        transfer: of code values; sRGB is assumed.
        cosine: "in" is assumed: photographs hold it.
        orientation: "y_up" (assumed) or "y_down", for files whose y runs down the rows.

    Raises:
        FormatError: damaged, a light twice, or none of the images is there.
    """
    values, record = named.assumptions(
        transfer=(transfer, "srgb"),
        cosine=(cosine, "in"),
        orientation=(orientation, "y_up"),
        scale=(None, "relative: 1 is the brightest code value, lights of equal power"),
    )
    holder, file = _found(path)
    entries = parse(str(path), holder.text(file))
    base = str(PurePosixPath(file).parent)
    located = [(holder.locate_image(name, base), light) for name, light in entries]
    present = [(name, light) for name, light in located if name is not None]
    if not present:
        raise FormatError(path, f"none of the {len(entries)} images it names is there")
    missing = [name for (name, _), (at, _) in zip(entries, located, strict=True) if at is None]
    if missing:
        warnings.warn(
            f"{path}: {len(missing)} of {len(entries)} images are missing, first {missing[0]!r}",
            stacklevel=2,
        )
    names = [name for name, _ in present]
    if len(set(names)) < len(names):
        again = next(name for name in names if names.count(name) > 1)
        raise FormatError(path, f"{again!r} has two lights", remedy="remove one line")
    light = np.array([light for _, light in present])
    light[:, 1] *= y_sign(values["orientation"])
    view = np.broadcast_to([0.0, 0.0, 1.0], light.shape)
    decode = named.Decoder.of(values, record)
    return named.assembled(
        path,
        named.ImageTextures(
            holder, names, decode, named.cosine_factor(values["cosine"], light)
        ),
        light=light,
        view=view,
        provenance={
            "source": str(path), "format": "lp", "missing_images": len(missing), **record,
        },
    )  # fmt: skip


def parse(path: str, text: str) -> list[tuple[str, list[float]]]:
    """Names and unit directions of a light position file.

    Raises:
        FormatError: a line that is none, or a direction without a length.
    """
    lines = [line.strip() for line in text.splitlines()]
    lines = [line for line in lines if line]
    if not lines or not re.fullmatch(r"\d{1,9}", lines[0].strip(" ,;")):
        start = lines[0][:60] if lines else ""
        raise FormatError(path, f"starts with {start!r}; expected the number of images")
    count = int(lines[0].strip(" ,;"))
    entries = []
    for number, line in enumerate(lines[1:], 2):
        parts = numerals.named_numbers(line, 3)
        if parts is None or not parts[0]:
            raise FormatError(path, f"line {number} is {line[:60]!r}; expected: file x y z")
        name, numbers = parts
        vector = np.array(numbers)
        length = float(np.linalg.norm(vector))
        if not _SHORTEST <= length < np.inf:
            raise FormatError(path, f"line {number}: {vector.tolist()} is not a direction")
        entries.append((name.strip("\"' \t"), (vector / length).tolist()))
    if not entries:
        raise FormatError(path, "names no image")
    if count != len(entries):
        warnings.warn(
            f"{path}: says {count} images and names {len(entries)}; all named ones are taken",
            stacklevel=3,
        )
    return entries


def y_sign(orientation: str) -> int:
    """1 where y runs up, -1 where it runs down the rows."""
    signs = {"y_up": 1, "y_down": -1}
    if orientation not in signs:
        raise ValueError(f"orientation {orientation!r}; expected y_up or y_down")
    return signs[orientation]


def _light_files(names: list[str]) -> list[str]:
    return [n for n in names if n.lower().endswith(".lp")]


def _found(path: Path) -> tuple[Archive, str]:
    """The archive and the .lp member in it."""
    if path.is_file() and path.suffix.lower() == ".lp":
        return Archive(path.parent), path.name
    holder = Archive(path)
    files = _light_files(holder.names)
    if len(files) != 1:
        listing = ", ".join(files[:5]) or "none"
        raise FormatError(path, f"light position files: {listing}; expected one", remedy="name it")
    return holder, files[0]
