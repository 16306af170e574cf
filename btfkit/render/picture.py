"""Pictures as files: PNG to look at, EXR to compute with, surroundings to light with."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit.errors import FormatError
from btfkit.files import whole
from btfkit.io import images
from btfkit.render import surroundings
from btfkit.render.preview import Rendering

Array = NDArray[np.float32]
# ITU-R BT.709, linear.
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)


def read_surroundings(path: Path, *, channels: Sequence[str]) -> Array:
    """Radiance (h, w, c) by latitude and longitude for a material's channels.

    A material of three channels takes R, G and B; any other the luminance in every channel. What
    is not finite or negative, and square probes, are treated as `surroundings` says.

    Raises:
        FormatError: neither *.hdr nor *.exr, damaged, without colour, or in another projection.
    """
    if path.suffix.lower() not in (".exr", ".hdr"):
        raise FormatError(path, "surroundings are *.hdr or *.exr")
    image = images.decode(os.fspath(path), path.read_bytes(), transfer="linear")
    values = surroundings.as_panorama(path, surroundings.cleaned(path, image.linear))
    if values.shape[2] == len(channels):
        return values
    grey = values @ _LUMINANCE if values.shape[2] == 3 else values[..., 0]
    return np.repeat(grey[..., None], len(channels), axis=2)


def check_name(path: Path) -> None:
    """ValueError unless a picture can be written under that name."""
    if path.suffix.lower() not in (".png", ".jpg", ".jpeg", ".exr"):
        raise ValueError(f"{path}: pictures are *.png or *.jpg (sRGB), or *.exr (linear)")


def write(
    picture: Rendering,
    path: Path,
    *,
    channels: Sequence[str],
    exposure: float = 0.0,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    about: Mapping[str, Any] | None = None,
    force: bool = False,
) -> None:
    """Write a picture.

    PNG, JPEG: exposed, over the background, clamped to 0..1, sRGB encoded. EXR: float32 as it is,
    premultiplied by its cover, which is A; what the picture shows stands in "btfkit:about".

    Args:
        channels: names of those of the picture: RGB, one, or wavelengths in nm.
        exposure: stops. background: linear RGB, not exposed. Both of PNG only.
        about: what is seen; JSON types only.

    Raises:
        ValueError: another suffix, or channels that a PNG cannot show.
        FileExistsError: `path` exists and `force` is False.
    """
    check_name(path)
    if path.suffix.lower() == ".exr":
        pixels = np.concatenate([picture.radiance, picture.cover[..., None]], axis=2)
        attributes = {"btfkit:about": json.dumps(dict(about or {}))}
        with whole(path, force=force) as partial:
            images.write_exr(partial, pixels, (*channels, "A"), attributes)
        return
    shown = picture.radiance @ to_rgb(channels) * np.float32(2.0**exposure)
    behind = (1 - picture.cover[..., None]) * np.asarray(background, np.float32)
    with whole(path, force=force) as partial:
        encode = images.encode_png if path.suffix.lower() == ".png" else images.encode_jpeg
        partial.write_bytes(encode(shown + behind))


def to_rgb(channels: Sequence[str]) -> Array:
    """(c, 3) matrix from channels to linear BT.709 RGB.

    Wavelengths are lit by D65 and seen by the CIE 1931 observer, linear between them and constant
    beyond them, so that a reflectance of 1 throughout is white.

    Raises:
        ValueError: other than three channels, one, or wavelengths in nm.
    """
    if len(channels) == 3 and not all(_is_number(name) for name in channels):
        return np.eye(3, dtype=np.float32)
    if len(channels) == 1:
        return np.ones((1, 3), np.float32)
    if not all(_is_number(name) for name in channels):
        raise ValueError(
            f"channels {', '.join(channels)} are neither RGB, one, nor wavelengths: "
            "a PNG cannot show them; write an EXR"
        )
    import colour

    from btfkit.colour import xyz_to_rgb

    nm = np.arange(360, 781)
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    lamp = colour.SDS_ILLUMINANTS["D65"]
    curves = np.stack([np.interp(nm, observer.wavelengths, c) for c in observer.values.T], axis=1)
    seen = curves * np.interp(nm, lamp.wavelengths, lamp.values)[:, None]
    waves = np.array([float(name) for name in channels])
    order = np.argsort(waves)
    hats = np.zeros((len(channels), len(nm)))
    for row, hat in zip(order, np.eye(len(order)), strict=True):
        hats[row] = np.interp(nm, waves[order], hat)
    rgb = xyz_to_rgb(hats @ seen / seen[:, 1].sum())
    # D65 itself is white only to the table's steps: white is made exact.
    return (rgb / rgb.sum(axis=0)).astype(np.float32)


def _is_number(name: str) -> bool:
    try:
        return float(name) > 0
    except ValueError:
        return False
