"""A picture with all that its file says of it, so that it can be written again in kind."""

from __future__ import annotations

import os
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit import colour
from btfkit.errors import BtfkitError
from btfkit.files import whole
from btfkit.io import images
from btfkit.io.images import exr
from btfkit.io.images.encoding import jpeg_with_profile, png_with_profile, write_tiff
from btfkit.io.images.profiles import Declared
from btfkit.synthesis import IndexMap
from btfkit.textures import narrowed

_EIGHT_BITS = (".jpg", ".jpeg", ".bmp")
_TIFF = (".tif", ".tiff")
WRITTEN = (".png", ".exr", *_TIFF, *_EIGHT_BITS)
# float32 values through two matrices.
_ROUNDING = 1e-5


@final
@dataclass(frozen=True, eq=False)
class Picture:
    """A picture as it lies in its file.

    Attributes:
        linear: (h, w, c) float32 colour; linear BT.709 where it is R, G and B.
        alpha: (h, w) as stored, None where there is none.
        depth: dtype of the pixels in the file.
        channels: names of the colour channels, where the file has names.
        declared: what the file says of its colour, which is passed on.
    """

    linear: NDArray[np.float32]
    alpha: NDArray[Any] | None
    depth: np.dtype[Any]
    channels: tuple[str, ...]
    declared: Declared | None = None

    def tiled(self, linear: NDArray[np.float32], index: IndexMap) -> Picture:
        """The picture with the colour of a tile, and its alpha from the same places."""
        return replace(
            self, linear=linear, alpha=None if self.alpha is None else index.of(self.alpha)
        )

    def write(self, path: Path, *, force: bool) -> None:
        """Write the picture, whole or not at all, as deep as the kind of file can hold.

        Raises:
            ValueError: a suffix that no writer knows, or channels that it cannot hold.
        """
        suffix = path.suffix.lower()
        if suffix not in WRITTEN:
            raise ValueError(f"{path}: no writer for {suffix!r}; there are {', '.join(WRITTEN)}")
        if suffix != ".exr" and self.linear.shape[2] not in (1, 3):
            raise ValueError(f"{path}: {self.linear.shape[2]} channels; only an EXR holds them")
        if self.alpha is not None and suffix in _EIGHT_BITS:
            warnings.warn(f"{suffix} holds no alpha: it is left out", stacklevel=2)
        with whole(path, force=force) as partial:
            if suffix == ".exr":
                self._write_exr(partial)
            elif suffix in _TIFF:
                self._write_tiff(partial)
            else:
                partial.write_bytes(self._encoded(suffix))

    def _write_exr(self, path: Path) -> None:
        values, names = self.linear, self.channels
        if self.alpha is not None:
            peak = np.iinfo(self.alpha.dtype).max if self.alpha.dtype.kind == "u" else 1
            values = np.concatenate([values, (self.alpha / peak)[..., None]], axis=-1)
            names = (*names, "A")
        # 8-bit codes fit a half float; 16-bit ones do not.
        half = self.depth in (np.float16, np.uint8)
        declared = None if self.declared is None else self.declared.chromaticities
        if declared is not None and self.declared is not None:
            values = values.copy()
            values[..., :3] = self.declared.in_own_primaries(values[..., :3])
        kept = narrowed(values) if half else values.astype(np.float32)
        images.write_exr(path, kept, names, chromaticities=declared)

    def _write_tiff(self, path: Path) -> None:
        pixels = self._pixels(self.depth if self.depth.kind == "u" else np.dtype(np.float32))
        write_tiff(path, pixels, alpha=self.alpha is not None, profile=self._profile)

    @property
    def _profile(self) -> bytes | None:
        return None if self.declared is None else self.declared.profile

    def _encoded(self, suffix: str) -> bytes:
        import cv2

        bits = np.dtype(np.uint8 if suffix in _EIGHT_BITS else self.depth)
        depth = np.dtype(np.uint16) if bits.kind == "f" else bits
        pixels = self._pixels(depth, alpha=suffix not in _EIGHT_BITS)
        swapped = np.concatenate([pixels[..., 2::-1], pixels[..., 3:]], axis=-1)
        options = [cv2.IMWRITE_JPEG_QUALITY, 98, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x111111]
        done, data = cv2.imencode(suffix, swapped, options if suffix[:3] == ".jp" else [])
        if not done:
            raise ValueError(f"the picture cannot be encoded as {suffix}")
        with_profile = {".png": png_with_profile, ".bmp": None}.get(suffix, jpeg_with_profile)
        if self._profile is None or with_profile is None:
            return data.tobytes()
        return with_profile(data.tobytes(), self._profile)

    def _pixels(self, depth: np.dtype[Any], *, alpha: bool = True) -> NDArray[Any]:
        """(h, w, 1, 3 or 4) as they are stored; encoded unless they are floats."""
        colours = self._colours(depth)
        if self.alpha is None or not alpha:
            return colours
        cover = self.alpha if self.alpha.dtype == depth else _requantised(self.alpha, depth)
        three = colours if colours.shape[2] == 3 else np.repeat(colours, 3, axis=2)
        return np.concatenate([three, cover[..., None]], axis=-1)

    def _colours(self, depth: np.dtype[Any]) -> NDArray[Any]:
        profiled = self.declared if self._profile is not None else None
        if depth.kind == "f":
            if profiled is None:
                return self.linear.astype(depth)
            coded = profiled.in_own_primaries if profiled.is_linear else profiled.encoded
            return np.asarray(coded(self.linear), depth)
        measured = np.nan_to_num(self.linear.astype(np.float64), nan=0.0)
        own = measured if profiled is None else profiled.in_own_primaries(measured)
        # Primaries to and fro move the ends by some rounding.
        outside = int(((own < -_ROUNDING) | (own > 1 + _ROUNDING)).any(axis=-1).sum())
        if outside:
            warnings.warn(
                f"{outside} texels are beyond the codes of {depth} pixels: clipped; "
                f"an .exr holds them",
                stacklevel=4,
            )
        if profiled is None:
            encoded = colour.to_srgb(np.clip(measured, 0, 1))
        else:
            encoded = profiled.encoded(measured)
        return np.rint(np.iinfo(depth).max * encoded).astype(depth)


def read_picture(path: str | os.PathLike[str]) -> Picture:
    """A picture from a file; codes are taken for sRGB.

    Raises:
        FormatError: damaged.
        BtfkitError: a relief file, whose channels are no colours.
    """
    file = Path(path)
    data = file.read_bytes()
    if file.suffix.lower() == ".exr":
        return _read_exr(file, data)
    image = images.decode(file.name, data, transfer="srgb", assumed=True)
    names = ("R", "G", "B") if image.linear.shape[2] == 3 else ("Y",)
    return Picture(image.linear, image.alpha, image.depth, names, image.declared)


def _read_exr(file: Path, data: bytes) -> Picture:
    """All channels but alpha, whatever their roles: they are tiled together."""
    stored = images.read_exr(file.name, data)
    names = stored[1]
    if "Z" in names:
        raise BtfkitError(
            f"{file} is a relief: its channel Z holds heights, not colour",
            remedy="tile the BTF that it belongs to",
        )
    colours = tuple(name for name in names if name != "A")
    if not colours:
        raise BtfkitError(f"{file} has only an alpha channel; expected colour")
    image = exr.of_channels(file.name, stored, colours)
    declared = image.declared
    if declared is None and (said := exr.declared_by(file.name, stored[2])) is not None:
        # Among other channels the colours are carried as they are.
        declared = replace(said, matrix=None)
    alpha = stored[0][..., names.index("A")] if "A" in names else None
    return Picture(image.linear, alpha, image.depth, colours, declared)


def _requantised(alpha: NDArray[Any], depth: np.dtype[Any]) -> NDArray[Any]:
    """Alpha in the codes, or the 0..1, of another depth."""
    share = alpha / (np.iinfo(alpha.dtype).max if alpha.dtype.kind == "u" else 1)
    if depth.kind == "f":
        return share.astype(depth)
    return np.rint(np.clip(share, 0, 1) * np.iinfo(depth).max).astype(depth)
