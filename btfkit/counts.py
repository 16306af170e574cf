"""One raw frame: counts of a sensor in a file, neither scaled nor converted."""

from __future__ import annotations

import importlib
import io
import struct
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.errors import FormatError
from btfkit.tifftags import Directory, below, chain_of

Counts = NDArray[Any]

CODED = {".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp"}
FLOATING = {".exr", ".hdr"}
RAW = {".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw", ".raw"}
SUFFIXES = CODED | FLOATING | RAW
# What a TIFF may be whose counts are read as they are: grey of which 0 is black, or RGB.
_SAMPLES_OF = {1: 1, 2: 3}
_PHOTOMETRIC = {0: "grey of which 0 is white", 3: "a palette", 4: "a mask", 5: "inks (CMYK)",
                6: "YCbCr", 8: "CIE L*a*b*", 32803: "a colour filter array",
                34892: "linear sensor values"}  # fmt: skip
# Format and bits of a sample.
_DEPTHS = {(1, 8), (1, 16), (3, 32)}
_BAYER = ("RGGB", "BGGR", "GRBG", "GBRG")
_CURVES = {291: "a grey response curve", 301: "a transfer function", 342: "a transfer range"}
_PNG_KINDS = {0: "grey", 2: "RGB", 3: "a palette", 4: "grey with alpha", 6: "RGB with alpha"}


def is_frame(name: str) -> bool:
    """Whether a name ends like a frame that `read` takes."""
    return PurePosixPath(name).suffix.lower() in SUFFIXES


def read(name: str, data: bytes) -> Counts:
    """Decode one frame.

    Args:
        name: for messages, and for its suffix.
        data: the bytes of the file.

    Returns:
        (h, w) or (h, w, 3) counts as the file has them: uint8, uint16 or float32, RGB, row 0 on
        top. RAW files give the mosaic of their visible area, black level not subtracted.

    Raises:
        FormatError: not an image, damaged, not laid out as plain counts, or a RAW file without
            rawpy.
    """
    suffix = PurePosixPath(name).suffix.lower()
    if suffix in FLOATING:
        return _read_floats(name, data)
    if suffix in RAW:
        return _read_raw(name, data)
    if suffix not in CODED:
        raise FormatError(
            name, f"ends in {suffix!r}; expected one of {', '.join(sorted(SUFFIXES))}"
        )
    return _read_codes(name, data)


def encode_png(counts: NDArray[np.uint16]) -> bytes:
    """A (h, w) or (h, w, 3) frame as a PNG of 16 bits; the same counts give the same bytes."""
    import cv2

    if counts.dtype != np.uint16 or counts.shape[2:] not in ((), (3,)) or counts.ndim < 2:
        raise ValueError(f"counts are {counts.dtype} {counts.shape}; expected uint16 (h, w[, 3])")
    if counts.ndim == 3:
        counts = np.ascontiguousarray(counts[..., ::-1])
    # Level 1: noise does not shrink further, and the camera waits for the disk.
    done, data = cv2.imencode(".png", counts, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not done:
        raise ValueError("the frame cannot be encoded")
    return bytes(data.tobytes())


def _read_codes(name: str, data: bytes) -> Counts:
    import cv2

    check_whole(name, data)
    _check_layout(name, data)
    # Without IGNORE_ORIENTATION a camera that was held upright would turn some of the frames.
    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        codes = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise FormatError(name, f"not a readable image ({error})") from error
    if codes is None:
        raise FormatError(name, "not a readable image", remedy="copy it again")
    if codes.dtype not in (np.uint8, np.uint16, np.float32):
        raise FormatError(name, f"pixels are {codes.dtype}; expected 8 or 16 bit, or float32")
    if codes.ndim == 3 and codes.shape[2] == 3:
        codes = np.ascontiguousarray(codes[..., ::-1])
    return np.asarray(codes)


def _read_floats(name: str, data: bytes) -> Counts:
    import OpenImageIO as oiio

    suffix = PurePosixPath(name).suffix.lower()
    # OpenImageIO's Python face opens names only.
    with tempfile.NamedTemporaryFile(suffix=suffix) as file:
        file.write(data)
        file.flush()
        source = oiio.ImageInput.open(file.name)
        pixels = None if source is None else source.read_image(oiio.FLOAT)
        # Asked for, or the library prints it at exit.
        fault = oiio.geterror() if source is None else source.geterror()
        if source is None or pixels is None or fault:
            raise FormatError(name, f"not a readable {suffix} image", remedy="copy it again")
        values = np.asarray(pixels, np.float32)
        source.close()
    return values[..., 0] if values.shape[2] == 1 else np.ascontiguousarray(values[..., :3])


@final
@dataclass(frozen=True, eq=False)
class RawFile:
    """A RAW file: its mosaic, and what the camera says of it.

    Attributes:
        mosaic: (h, w) counts of the visible area. cfa: colours of its first 2 x 2 pixels.
        black, white: levels of no light and of saturation, counts; black by colour (3,).
        balance: (3,) what the camera multiplies its colours by for a white, green 1.
        to_rgb: (3, 3) balanced colours of the camera to linear sRGB. from_xyz: (3, 3) CIE XYZ to
            the camera's colours. Zeros where a matrix is not known.
    """

    mosaic: NDArray[np.uint16]
    cfa: str
    black: NDArray[np.float64]
    white: float
    balance: NDArray[np.float64]
    to_rgb: NDArray[np.float64]
    from_xyz: NDArray[np.float64]


def read_raw(name: str, data: bytes) -> RawFile:
    """A RAW file with its levels.

    Raises:
        FormatError: no RAW file, not of a mosaic of red, green and blue, or without rawpy.
    """
    with _opened(name, data) as raw:
        if raw.raw_image_visible.ndim != 2 or raw.raw_colors_visible is None:
            raise FormatError(name, "a RAW file without a mosaic", remedy="develop it elsewhere")
        letters = raw.color_desc.decode("ascii", "replace")
        tile = raw.raw_colors_visible[:2, :2].ravel().tolist()
        cfa = "".join(letters[number] for number in tile)
        colours = raw.raw_colors_visible[:16, :16]
        tiled = np.tile(colours[:2, :2], (8, 8))[: colours.shape[0], : colours.shape[1]]
        if cfa not in _BAYER or (colours != tiled).any():
            raise FormatError(
                name, f"a RAW file of the mosaic {cfa}; expected red, green and blue, 2 x 2",
                remedy="develop it elsewhere to linear 16-bit TIFF, and say --transfer linear",
            )  # fmt: skip
        # Greens may be told apart; they are one colour.
        order = [letters.index(letter) for letter in "RGB"]
        given = np.array(raw.camera_whitebalance, float)[order]
        good = np.isfinite(given).all() and (given > 0).all()
        return RawFile(
            np.array(raw.raw_image_visible, np.uint16), cfa,
            np.array(raw.black_level_per_channel, float)[order], float(raw.white_level),
            given / given[1] if good else np.ones(3),
            np.array(raw.color_matrix, float)[:, order], np.array(raw.rgb_xyz_matrix, float)[order],
        )  # fmt: skip


def _read_raw(name: str, data: bytes) -> Counts:
    with _opened(name, data) as raw:
        return np.array(raw.raw_image_visible, np.uint16)


@contextmanager
def _opened(name: str, data: bytes) -> Iterator[Any]:
    """A RAW file open in rawpy."""
    try:
        rawpy = importlib.import_module("rawpy")
    except ImportError as error:
        raise FormatError(
            name, "a RAW file, which rawpy reads", remedy='pip install "btfkit[raw]"'
        ) from error
    try:
        with rawpy.imread(io.BytesIO(data)) as raw:
            yield raw
    except rawpy.LibRawError as error:
        raise FormatError(name, f"not a readable RAW file ({error})") from error


def check_whole(name: str, data: bytes) -> None:
    """Refuse what decoders fill with grey or noise without a word: cut files, damaged chunks."""
    if data.startswith(b"\xff\xd8") and b"\xff\xd9" not in data[-4096:]:
        raise FormatError(name, "the image is cut short", remedy="copy it again")
    if not data.startswith(b"\x89PNG"):
        return
    at, kind = 8, b""
    while kind != b"IEND":
        size = int.from_bytes(data[at : at + 4], "big")
        kind = data[at + 4 : at + 8]
        end = at + 8 + size
        if end + 4 > len(data):
            raise FormatError(name, "the image is cut short", remedy="copy it again")
        if zlib.crc32(data[at + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            raise FormatError(name, f"chunk {kind!r} of the PNG is damaged", remedy="copy it again")
        at = end + 4


def _check_layout(name: str, data: bytes) -> None:
    """Refuse what decoders turn into other counts without a word.

    Raises:
        FormatError: a TIFF or PNG that is not one picture of grey or RGB counts as they are.
    """
    if data.startswith(b"\x89PNG"):
        if len(data) < 26:
            raise FormatError(name, "the image is cut short", remedy="copy it again")
        bits, kind = data[24], data[25]
        if kind not in (0, 2) or bits not in (8, 16):
            what = _PNG_KINDS.get(kind, f"colour type {kind}")
            raise _no_counts(name, f"holds {what} of {bits} bits")
    if data[:4] not in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        return
    try:
        chain = chain_of(data)
        pages = [*chain, *(each for d in chain for each in below(data, d))]
        if len(pages) != 1:
            raise _no_counts(name, f"holds {len(pages)} pictures")
        fault, strips = _fault_of(pages[0]), pages[0].fault_of_strips()
    except (struct.error, ValueError, KeyError) as error:
        raise FormatError(name, "not a readable image", remedy="copy it again") from error
    if fault:
        raise _no_counts(name, fault)
    if strips:
        raise FormatError(name, strips, remedy="copy it again")


def _fault_of(picture: Directory) -> str | None:
    """Why a picture of a TIFF is no plain counts; None where it is."""
    photometric, samples = picture.number(262, -1), picture.number(277, 1)
    if photometric not in _SAMPLES_OF:
        return f"holds {_PHOTOMETRIC.get(photometric, f'photometric interpretation {photometric}')}"
    if samples != _SAMPLES_OF[photometric]:
        more = "beside grey" if photometric == 1 else "of RGB"
        return f"has {samples} samples a pixel {more}"
    if samples > 1 and picture.number(284, 1) != 1:
        return "has its colours in separate planes"
    depths = {(form, bits) for form in picture.values(339) or (1,) for bits in picture.values(258)}
    if len(depths) != 1 or not depths <= _DEPTHS:
        listed = ", ".join(f"{bits} of format {form}" for form, bits in sorted(depths)) or "1"
        return f"has samples of {listed} bits"
    return next((f"declares {what}" for tag, what in _CURVES.items() if tag in picture), None)


def _no_counts(name: str, found: str) -> FormatError:
    return FormatError(
        name, f"{found}; counts of a sensor are one picture of grey, 0 black, or RGB, 8 or 16 bits "
        "a sample or floats of 32, colours side by side, without alpha",
        remedy="write the frames as 16-bit grey PNG or TIFF",
    )  # fmt: skip
