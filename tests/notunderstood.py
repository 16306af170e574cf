"""Pictures that declare what no reader here understands: each has to be refused by name."""

from __future__ import annotations

import struct
import tempfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import tifffile
from pictures import profile
from PIL import Image

from btfkit.io import images

RGB = np.random.default_rng(0).integers(0, 255, (8, 8, 3), endpoint=True).astype("u1")


@dataclass(frozen=True)
class Case:
    """Suffix and bytes of a file, and what the refusal has to say of it."""

    suffix: str
    data: Callable[[], bytes]
    message: str


def tiff(
    pixels: np.ndarray, *more: np.ndarray, photometric: str = "rgb", **options: object
) -> bytes:
    file = BytesIO()
    with tifffile.TiffWriter(file) as writer:
        for each in (pixels, *more):
            writer.write(each, photometric=photometric, metadata=None, **options)
    return file.getvalue()


def stack() -> bytes:
    file = BytesIO()
    tifffile.imwrite(file, np.zeros((5, 8, 8), "u1"), imagej=True)
    return file.getvalue()


def cut_stack() -> bytes:
    """One directory that stands for five pictures."""
    file = BytesIO()
    tifffile.imwrite(file, np.zeros((5, 8, 8), "u1"), truncate=True, photometric="minisblack")
    return file.getvalue()


def raw() -> bytes:
    """A preview, and what the sensor saw below it, as cameras write it."""
    file = BytesIO()
    with tifffile.TiffWriter(file) as writer:
        writer.write(RGB, photometric="rgb", subfiletype=1, subifds=1, metadata=None)
        writer.write(np.zeros((32, 32), "u2"), photometric="cfa", metadata=None)
    return file.getvalue()


def below() -> bytes:
    """A small picture, and a larger one below it that is no preview."""
    file = BytesIO()
    with tifffile.TiffWriter(file) as writer:
        writer.write(RGB, photometric="rgb", subifds=1, metadata=None)
        writer.write(np.zeros((32, 32, 3), "u2"), photometric="rgb", metadata=None)
    return file.getvalue()


def png(kind: bytes, body: bytes) -> bytes:
    """A PNG with one more chunk behind its header."""
    file = BytesIO()
    Image.fromarray(RGB).save(file, "PNG")
    data = file.getvalue()
    chunk = struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    return data[:33] + chunk + data[33:]


def with_profile(icc: bytes) -> bytes:
    return png(b"iCCP", b"x\0\0" + zlib.compress(icc))


def jpeg(change: Callable[[bytes], bytes]) -> bytes:
    file = BytesIO()
    Image.fromarray(RGB).save(file, "JPEG")
    return change(file.getvalue())


def frame(marker: int, precision: int) -> Callable[[bytes], bytes]:
    def change(data: bytes) -> bytes:
        at = data.index(b"\xff\xc0")
        return (
            data[: at + 1]
            + bytes([marker])
            + data[at + 2 : at + 4]
            + bytes([precision])
            + data[at + 5 :]
        )

    return change


def segment(body: bytes) -> Callable[[bytes], bytes]:
    whole = b"\xff\xe2" + struct.pack(">H", len(body) + 2) + body
    return lambda data: data[:2] + whole + data[2:]


def bmp() -> bytes:
    """Version 4, calibrated by end points."""
    head = struct.pack("<IiiHHIIiiII", 108, 8, 8, 1, 24, 0, 192, 0, 0, 0, 0)
    head += bytes(16) + bytes(4) + struct.pack("<9i", *[1 << 28] * 9) + bytes(12)
    return b"BM" + struct.pack("<IHHI", 14 + 108 + 192, 0, 0, 122) + head + bytes(192)


def exr(names: tuple[str, ...], *, chromaticities: tuple[float, ...] | None = None) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.exr"
        pixels = np.ones((8, 8, len(names)), np.float32)
        images.write_exr(path, pixels, names, chromaticities=chromaticities)
        return path.read_bytes()


def parts(*sizes: int) -> bytes:
    """Several parts with the same names."""
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "a.exr")
        specs = []
        for i, side in enumerate(sizes):
            specs.append(oiio.ImageSpec(side, side, 3, oiio.FLOAT))
            specs[-1].attribute("oiio:subimagename", f"view{i}")
        out = oiio.ImageOutput.create(path)
        assert out.open(path, specs)
        for i, side in enumerate(sizes):
            assert i == 0 or out.open(path, specs[i], "AppendSubimage")
            assert out.write_image(np.ones((side, side, 3), np.float32))
        out.close()
        return Path(path).read_bytes()


def subsampled() -> bytes:
    """Luminance and chroma of half the size."""
    data = exr(("BY", "RY", "Y"))
    at = data.index(b"BY\0") + 3 + 8
    return data[:at] + struct.pack("<II", 2, 2) + data[at + 8 :]


def hdr(line: str, form: str = "rgbe") -> bytes:
    top = f"#?RADIANCE\n{line}FORMAT=32-bit_rle_{form}\n\n-Y 8 +X 8\n"
    return top.encode() + bytes((128, 128, 128, 129)) * 64


TABLE = profile(None, 2.2).replace(b"rXYZ", b"A2B0")
INKS = profile(None, 2.2).replace(b"mntrRGB ", b"prtrCMYK")
FLOATS = np.ones((8, 8, 3), "f8")
REFUSED: dict[str, Case] = {
    "inks": Case(".tif", lambda: tiff(np.zeros((8, 8, 4), "u1"), photometric="separated"), r"holds inks"),
    "CIELAB": Case(".tif", lambda: tiff(RGB, photometric="cielab"), r"holds CIE L\*a\*b\*"),
    "signed": Case(".tif", lambda: tiff(RGB.astype("i2")), "pixels are signed numbers of 16 bits"),
    "32 bits": Case(".tif", lambda: tiff(RGB.astype("u4")), "pixels are whole numbers of 32 bits"),
    "floats of 64 bits in tiles": Case(".tif", lambda: tiff(FLOATS, tile=(16, 16)), "floats of 64 bits in tiles"),
    "inverted floats": Case(".tif", lambda: tiff(FLOATS[..., 0].astype("f4"), photometric="miniswhite"), "0 is white"),
    "five bands": Case(
        ".tif", lambda: tiff(np.zeros((8, 8, 5), "u1"), photometric="minisblack", planarconfig="contig", extrasamples=[0] * 4),
        "has 5 samples a pixel, 4 of them beside grey",
    ),
    "two pages": Case(".tif", lambda: tiff(RGB, RGB), r"holds 2 pictures \(0: 8 x 8, 1: 8 x 8\); expected one"),
    "a stack": Case(".tif", stack, "holds 5 pictures"),
    "a stack of one directory": Case(".tif", cut_stack, "holds a stack of 5 pictures"),
    "a RAW": Case(".tif", raw, "holds a colour filter array, and a preview of it"),
    "a photograph below": Case(".tif", below, r"holds 2 pictures \(0: 8 x 8, 1: 32 x 32\)"),
    "a transfer function": Case(".tif", lambda: tiff(RGB, extratags=[(301, 3, 256, tuple(range(256)), True)]), "declares a transfer function"),
    "an animation": Case(".png", lambda: png(b"acTL", struct.pack(">II", 2, 0)), "animated, of 2 pictures"),
    "a chunk": Case(".png", lambda: png(b"CgBI", bytes(4)), "needs chunk b'CgBI' to be understood"),
    "PQ": Case(".png", lambda: png(b"cICP", bytes([9, 16, 0, 1])), "declares colour by code points 9, 16, 0, 1"),
    "narrow range": Case(".png", lambda: png(b"cICP", bytes([1, 13, 0, 0])), "declares colour by code points 1, 13, 0, 0"),
    "a damaged profile": Case(".png", lambda: with_profile(bytes(200)), "its ICC profile is damaged"),
    "a profile of tables": Case(".png", lambda: with_profile(TABLE), "its ICC profile is 'none', a table of colours"),
    "a profile of inks": Case(".png", lambda: with_profile(INKS), "its ICC profile is for CMYK"),
    "a grey profile": Case(".png", lambda: with_profile(profile(None, 2.2, grey=True)), "is for 1 channels, the image has 3"),
    "a profile in parts": Case(".jpg", lambda: jpeg(segment(b"ICC_PROFILE\0\x01\x02" + bytes(9))), "profile lacks a part"),
    "12 bits": Case(".jpg", lambda: jpeg(frame(0xC1, 12)), "has 3 components of 12 bits"),
    "lossless": Case(".jpg", lambda: jpeg(frame(0xC3, 8)), r"lossless or hierarchical \(SOF3\)"),
    "end points": Case(".bmp", bmp, "declares colour space"),
    "two layers": Case(".exr", lambda: exr(("a.R", "a.G", "a.B", "b.R", "b.G", "b.B")), "several layers hold colour"),
    "no colour": Case(".exr", lambda: exr(("N.X", "N.Y", "N.Z", "Z")), "channels .*; expected R, G, B, or Y"),
    "two views": Case(".exr", lambda: parts(8, 8), "several layers hold colour"),
    "halved chroma": Case(".exr", subsampled, "the EXR cannot be|holds|subsampl"),
    "primaries in a line": Case(
        ".exr", lambda: exr(("R", "G", "B"), chromaticities=(0.1, 0.1, 0.2, 0.2, 0.3, 0.3, 0.3, 0.3)), "chromaticities .* are none",
    ),
    "XYZE": Case(".hdr", lambda: hdr("", "xyze"), "holds XYZ; expected RGB"),
    "no primaries": Case(".hdr", lambda: hdr("PRIMARIES= 0.64 0.33\n"), "PRIMARIES .* are none"),
    "no correction": Case(".hdr", lambda: hdr("COLORCORR= 1 0 1\n"), "COLORCORR .* is not three positive numbers"),
}  # fmt: skip
