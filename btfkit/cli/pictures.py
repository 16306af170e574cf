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
from btfkit.synthesis import IndexMap

_EIGHT_BITS = (".jpg", ".jpeg", ".bmp")
WRITTEN = (".png", ".tif", ".tiff", ".exr", *_EIGHT_BITS)


@final
@dataclass(frozen=True, eq=False)
class Picture:
    """A picture as it lies in its file.

    Attributes:
        linear: (h, w, c) float32 colour.
        alpha: (h, w) as stored, None where there is none.
        depth: dtype of the pixels in the file.
        channels: names of the colour channels, where the file has names.
    """

    linear: NDArray[np.float32]
    alpha: NDArray[Any] | None
    depth: np.dtype[Any]
    channels: tuple[str, ...]

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
        images.write_exr(path, values.astype(np.float16 if half else np.float32), names)

    def _encoded(self, suffix: str) -> bytes:
        import cv2

        depth = np.dtype(np.uint8 if suffix in _EIGHT_BITS else self.depth)
        if depth.kind == "f":
            depth = np.dtype(np.float32 if suffix != ".png" else np.uint16)
        pixels = self._pixels(depth)
        if self.alpha is not None and suffix not in _EIGHT_BITS:
            alpha = self.alpha if self.alpha.dtype == depth else _requantised(self.alpha, depth)
            colours = pixels if pixels.shape[2] == 3 else np.repeat(pixels, 3, axis=2)
            pixels = np.concatenate([colours, alpha[..., None]], axis=-1)
        options = [cv2.IMWRITE_JPEG_QUALITY, 98, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x111111]
        done, data = cv2.imencode(suffix, pixels, options if suffix[:3] == ".jp" else [])
        if not done:
            raise ValueError(f"the picture cannot be encoded as {suffix}")
        return data.tobytes()

    def _pixels(self, depth: np.dtype[Any]) -> NDArray[Any]:
        """(h, w, c) blue first, sRGB encoded unless they are floats."""
        if depth.kind == "f":
            return np.ascontiguousarray(self.linear[..., ::-1], depth)
        measured = np.nan_to_num(self.linear, nan=0.0)
        outside = int(((measured < 0) | (measured > 1)).any(axis=-1).sum())
        if outside:
            warnings.warn(
                f"{outside} texels are beyond the codes of {depth} pixels: clipped; "
                f"an .exr holds them",
                stacklevel=4,
            )
        encoded = colour.to_srgb(np.clip(measured.astype(np.float64), 0, 1))
        codes = np.rint(np.iinfo(depth).max * encoded).astype(depth)
        return np.ascontiguousarray(codes[..., ::-1])


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
    linear = images.read(file.name, data, transfer="srgb")
    names = ("R", "G", "B") if linear.shape[2] == 3 else ("Y",)
    if file.suffix.lower() == ".hdr" or data[:2] == b"#?":
        return Picture(linear, None, np.dtype(np.float32), names)
    import cv2

    codes: Any = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    alpha = codes[..., 3] if codes.ndim == 3 and codes.shape[2] == 4 else None
    return Picture(linear, alpha, codes.dtype, names)


def _read_exr(file: Path, data: bytes) -> Picture:
    import OpenImageIO as oiio

    values, names, _ = images.read_exr(file.name, data)
    if "Z" in names:
        raise BtfkitError(
            f"{file} is a relief: its channel Z holds heights, not colour",
            remedy="tile the BTF that it belongs to",
        )
    half = oiio.ImageBuf(os.fspath(file)).spec().format == oiio.HALF
    colours = [i for i, name in enumerate(names) if name != "A"]
    if not colours:
        raise BtfkitError(f"{file} has only an alpha channel; expected colour")
    alpha = values[..., names.index("A")] if "A" in names else None
    depth = np.dtype(np.float16 if half else np.float32)
    return Picture(values[..., colours], alpha, depth, tuple(names[i] for i in colours))


def _requantised(alpha: NDArray[Any], depth: np.dtype[Any]) -> NDArray[Any]:
    """Alpha in the codes, or the 0..1, of another depth."""
    share = alpha / (np.iinfo(alpha.dtype).max if alpha.dtype.kind == "u" else 1)
    if depth.kind == "f":
        return share.astype(depth)
    return np.rint(np.clip(share, 0, 1) * np.iinfo(depth).max).astype(depth)
