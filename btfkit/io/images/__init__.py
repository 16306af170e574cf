"""One image: bytes in, (h, w, c) float32 linear values out, row 0 on top, RGB."""

from __future__ import annotations

from pathlib import PurePosixPath

from btfkit.io.images import codes, exr, radiance
from btfkit.io.images.encoding import encode_jpeg, encode_png, encode_png_numbers, write_exr
from btfkit.io.images.exr import exr_channels, read_exr
from btfkit.io.images.image import Array, Image

__all__ = [
    "SUFFIXES", "Image", "decode", "encode_jpeg", "encode_png", "encode_png_numbers",
    "exr_channels", "is_image", "read", "read_exr", "write_exr",
]  # fmt: skip
SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".exr", ".hdr", ".bmp"}


def is_image(name: str) -> bool:
    """Whether a name ends like an image that can be read."""
    return PurePosixPath(name).suffix.lower() in SUFFIXES


def read(name: str, data: bytes, *, transfer: str) -> Array:
    """The colours of one image, as `decode` gives them."""
    return decode(name, data, transfer=transfer).linear


def decode(
    name: str,
    data: bytes,
    *,
    transfer: str,
    assumed: bool = False,
    orientation: str = "standard",
) -> Image:
    """Decode one image.

    Args:
        name: for messages, and for its suffix.
        data: the bytes of the file.
        transfer: what integer code values mean: srgb, linear or an exponent; EXR, HDR and floats
            are linear.
        assumed: whether the curve that a file declares comes before `transfer`. Primaries that it
            declares are converted in any case.
        orientation: of Radiance pictures, as `radiance.decode` takes it.

    Returns:
        The picture, upright: 1 or 3 channels, linear BT.709 where there are three.

    Raises:
        FormatError: not an image, damaged, absurdly large, or declaring what is not understood.
    """
    suffix = PurePosixPath(name).suffix.lower()
    if suffix == ".exr":
        return exr.decode(name, data)
    if suffix == ".hdr" or data[:2] == b"#?":
        return radiance.decode(name, data, orientation=orientation)
    return codes.decode(name, data, transfer=transfer, assumed=assumed)
