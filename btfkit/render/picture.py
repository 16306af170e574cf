"""Pictures as files: PNG to look at, EXR to compute with."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from btfkit.files import whole
from btfkit.io import images
from btfkit.render.preview import Picture


def read(path: Path) -> NDArray[np.float32]:
    """A linear picture (h, w, 3) or (h, w, 1) from *.hdr or *.exr."""
    return images.read(os.fspath(path), path.read_bytes(), transfer="srgb")


def write(
    picture: Picture,
    path: Path,
    *,
    channels: Sequence[str],
    exposure: float = 0.0,
    force: bool = False,
) -> None:
    """Write a picture: PNG sRGB encoded and clamped, EXR linear with its cover as A.

    Raises:
        ValueError: a suffix that is neither, or channels that a PNG has not.
        FileExistsError: `path` exists and `force` is False.
    """
    suffix = path.suffix.lower()
    if suffix not in (".png", ".exr"):
        raise ValueError(f"{path}: pictures are *.png or *.exr")
    if suffix == ".exr":
        pixels = np.concatenate([picture.radiance, picture.cover[..., None]], axis=2)
        with whole(path, force=force) as partial:
            images.write_exr(partial, pixels.astype(np.float32), (*channels, "A"))
        return
    if len(channels) not in (1, 3):
        raise ValueError(f"a PNG has 1 or 3 channels, the model {len(channels)}; write an EXR")
    linear = picture.radiance * np.float32(2.0**exposure)
    with whole(path, force=force) as partial:
        partial.write_bytes(images.encode_png(linear))
