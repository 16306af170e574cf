"""What campaigns found in pictures, each as the smallest file that shows it."""

from __future__ import annotations

import io
import struct

import cv2
import numpy as np
import pytest
import tifffile

from btfkit.errors import FormatError
from btfkit.io import images
from btfkit.tifftags import chain_of


def test_a_bmp_whose_pixels_lie_in_its_palette_is_refused() -> None:
    grey = cv2.imencode(".bmp", np.full((3, 4), 90, np.uint8))[1].tobytes()
    assert images.read("a.bmp", grey, transfer="linear").shape[:2] == (3, 4)
    data = bytearray(grey)
    data[10:14] = struct.pack("<I", 54)
    with pytest.raises(FormatError, match=f"pixels at byte 54 of {len(data)}; expected 1078 or"):
        images.read("a.bmp", bytes(data), transfer="linear")


@pytest.mark.parametrize("options", [{}, {"rowsperstrip": 6}, {"planarconfig": "separate"}])
def test_a_tiff_with_fewer_strips_than_rows_is_refused(options: dict[str, object]) -> None:
    shape = options == {"planarconfig": "separate"}
    pixels = np.full((3, 20, 4) if shape else (20, 4, 3), 90, np.uint8)
    buffer = io.BytesIO()
    tifffile.imwrite(buffer, pixels, photometric="rgb", metadata=None, **options)
    data = bytearray(buffer.getvalue())
    assert images.read("a.tif", bytes(data), transfer="linear").shape == (20, 4, 3)
    (directory,) = chain_of(bytes(data))
    taller = directory.patched(257, 72)
    with pytest.raises(FormatError, match=r"strips of .* rows for 72 rows; expected"):
        images.read("a.tif", taller, transfer="linear")


def test_a_tiff_without_a_size_is_refused() -> None:
    buffer = io.BytesIO()
    tifffile.imwrite(buffer, np.full((20, 4, 3), 90, np.uint8), photometric="rgb", metadata=None)
    data = bytearray(buffer.getvalue())
    (directory,) = chain_of(bytes(data))
    at = directory._at[257]
    data[at + 4 : at + 8] = bytes(4)
    with pytest.raises(FormatError, match=r"a\.tif"):
        images.read("a.tif", bytes(data), transfer="linear")


def _bitmap(codes: np.ndarray, bits: int, used: int, coding: int = 0) -> bytes:
    """A BMP of rows from the bottom, with a palette of `used` greys."""
    h, w = codes.shape
    rows = np.unpackbits(codes[::-1].astype(np.uint8)[..., None], axis=-1)[..., 8 - bits :]
    packed = np.packbits(rows.reshape(h, -1), axis=1)
    packed = np.pad(packed, ((0, 0), (0, -packed.shape[1] % 4)), constant_values=255)
    palette = np.repeat(np.linspace(0, 255, used).astype(np.uint8)[:, None], 4, axis=1)
    start = 54 + palette.nbytes
    head = struct.pack("<2sIHHI", b"BM", start + packed.nbytes, 0, 0, start)
    sizes = struct.pack("<IiiHHIIiiII", 40, w, h, 1, bits, coding, packed.nbytes, 0, 0, used, 0)
    return head + sizes + palette.tobytes() + packed.tobytes()


@pytest.mark.parametrize(("bits", "used"), [(8, 7), (4, 5), (1, 1)])
def test_a_bmp_whose_pixels_name_no_colour_of_its_palette_is_refused(bits: int, used: int) -> None:
    codes = np.arange(15).reshape(3, 5) % used
    read = images.read("a.bmp", _bitmap(codes, bits, used), transfer="linear")
    greys = np.linspace(0, 255, used).astype(np.uint8)[codes] / 255
    np.testing.assert_allclose(read[..., 0], greys, atol=1e-6)
    codes[1, 4] = used
    with pytest.raises(FormatError, match=f"palette of {used} colours for pixels up to {used}"):
        images.read("a.bmp", _bitmap(codes, bits, used), transfer="linear")
    # Runs are not unpacked for it.
    if bits > 1:
        with pytest.raises(FormatError, match=f"pixels up to {(1 << bits) - 1}"):
            images.read(
                "a.bmp", _bitmap(codes * 0, bits, used, {8: 1, 4: 2}[bits]), transfer="linear"
            )


def test_a_jpeg_of_more_blocks_than_bits_is_cut_short() -> None:
    flat = np.full((1000, 1000, 3), 90, np.uint8)
    data = bytearray(cv2.imencode(".jpg", flat)[1].tobytes())
    assert images.read("a.jpg", bytes(data), transfer="linear").shape == flat.shape
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = struct.pack(">HH", 9000, 9000)
    with pytest.raises(FormatError, match="cut short"):
        images.read("a.jpg", bytes(data), transfer="linear")
