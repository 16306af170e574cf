"""Images to linear values: orientations, transfers, and pictures that are cut or crafted."""

from __future__ import annotations

import struct
import time
import warnings
import zlib
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image

from btfkit import colour
from btfkit.errors import FormatError
from btfkit.io import images
from btfkit.io.images import headers, radiance


def picture(h: int = 6, w: int = 11) -> np.ndarray:
    """No symmetry has it: a different colour in every corner."""
    row, col = np.indices((h, w))
    return np.stack([row * 20 + 10, col * 15 + 20, row * col + 5], axis=-1).astype(np.uint8)


def test_a_png_is_rgb_with_row_0_on_top() -> None:
    codes = np.zeros((2, 3, 3), np.uint8)
    codes[0, 2] = [255, 128, 0]
    buffer = BytesIO()
    Image.fromarray(codes).save(buffer, "png")
    pixels = images.read("a.png", buffer.getvalue(), transfer="linear")
    np.testing.assert_allclose(pixels[0, 2], [1, 128 / 255, 0], rtol=1e-7)
    assert pixels.dtype == np.float32
    assert pixels[1:].max() == 0


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("transfer", ["srgb", "linear", "2.2"])
@pytest.mark.parametrize("kind", [".png", ".tif", ".bmp"])
def test_code_values_become_linear_by_the_closed_form(bits: int, transfer: str, kind: str) -> None:
    if kind == ".bmp" and bits == 16:
        return
    dtype = np.uint8 if bits == 8 else np.uint16
    codes = np.linspace(0, (1 << bits) - 1, 6 * 11 * 3).reshape(6, 11, 3).astype(dtype)
    data = cv2.imencode(kind, np.ascontiguousarray(codes[..., ::-1]))[1].tobytes()
    pixels = images.read(f"a{kind}", data, transfer=transfer)
    expected = colour.decode(transfer, codes / ((1 << bits) - 1))
    np.testing.assert_allclose(pixels, expected, rtol=1e-6)


@pytest.mark.parametrize(("mode", "c"), [("L", 1), ("LA", 3), ("RGBA", 3), ("P", 3), ("I;16", 1)])
def test_alpha_is_left_out_and_palettes_are_colours(mode: str, c: int) -> None:
    image = Image.fromarray(picture())
    if mode == "I;16":
        image = Image.fromarray(picture()[..., 0].astype(np.uint16) * 257)
    else:
        image = image.convert(mode)
    buffer = BytesIO()
    image.save(buffer, "png")
    pixels = images.read("a.png", buffer.getvalue(), transfer="linear")
    assert pixels.shape == (6, 11, c)


@pytest.mark.parametrize("tag", range(1, 9))
@pytest.mark.parametrize("kind", ["jpeg", "tiff"])
def test_exif_orientation_is_honoured(tag: int, kind: str) -> None:
    stored = np.kron(picture(), np.ones((8, 8, 1), np.uint8))
    exif = Image.Exif()
    exif[0x0112] = tag
    buffer = BytesIO()
    options = {"quality": 100, "subsampling": 0} if kind == "jpeg" else {}
    Image.fromarray(stored).save(buffer, kind, exif=exif, **options)
    pixels = images.read(f"a.{kind}", buffer.getvalue(), transfer="linear")
    # EXIF 2.3, tag 0112H: where the first row and the first column of the stored data belong.
    shown = {
        1: stored,
        2: stored[:, ::-1],
        3: stored[::-1, ::-1],
        4: stored[::-1],
        5: stored.transpose(1, 0, 2),
        6: stored.transpose(1, 0, 2)[:, ::-1],
        7: stored.transpose(1, 0, 2)[::-1, ::-1],
        8: stored.transpose(1, 0, 2)[::-1],
    }[tag]
    assert pixels.shape == shown.shape
    # JPEG of quality 100 rounds twice.
    np.testing.assert_allclose(pixels * 255, shown, atol=4)


def test_grey_jpegs_have_one_channel() -> None:
    data = images.encode_jpeg(np.full((4, 4, 1), 0.25, np.float32))
    pixels = images.read("a.jpg", data, transfer="srgb")
    assert pixels.shape == (4, 4, 1)
    np.testing.assert_allclose(pixels, 0.25, atol=0.01)


def rgbe(h: int, w: int) -> np.ndarray:
    """(h, w, 4) asymmetric RGBE values, runs and all exponents."""
    row, col = np.indices((h, w))
    mantissas = np.stack([row * 40 + 1, col // 3 * 9, np.full((h, w), 77)], axis=-1)
    return np.concatenate([mantissas % 256, (120 + col // 4)[..., None]], -1).astype(np.uint8)


def values_of(codes: np.ndarray) -> np.ndarray:
    """Ward's definition, one value at a time."""
    return (codes[..., :3] + 0.5) * 2.0 ** (codes[..., 3:].astype(float) - 136)


def run_length(line: np.ndarray) -> bytes:
    """New-style scanline of (w, 4) values: runs of three and more, the rest as it is."""
    out = bytes([2, 2, len(line) >> 8, len(line) & 255])
    for channel in line.T.tolist():
        at = 0
        while at < len(channel):
            run = 1
            while at + run < len(channel) and channel[at + run] == channel[at] and run < 127:
                run += 1
            if run >= 3:
                out += bytes([128 + run, channel[at]])
                at += run
            else:
                out += bytes([1, channel[at]])
                at += 1
    return out


def hdr(stored: np.ndarray, line: str, *, rle: bool, header: str = "") -> bytes:
    """A Radiance file of (scanlines, pixels, 4) values."""
    body = b"".join(map(run_length, stored)) if rle else stored.tobytes()
    top = f"#?RADIANCE\n{header}FORMAT=32-bit_rle_rgbe\n\n"
    return top.encode() + f"{line} \n".replace(" \n", "\n").encode() + body


# What is stored for a picture (rows from the top), by resolution line.
ORIENTATIONS = {
    "-Y {h} +X {w}": lambda p: p,
    "-Y {h} -X {w}": lambda p: p[:, ::-1],
    "+Y {h} +X {w}": lambda p: p[::-1],
    "+Y {h} -X {w}": lambda p: p[::-1, ::-1],
    "+X {w} -Y {h}": lambda p: p.transpose(1, 0, 2),
    "-X {w} -Y {h}": lambda p: p[:, ::-1].transpose(1, 0, 2),
    "+X {w} +Y {h}": lambda p: p[::-1].transpose(1, 0, 2),
    "-X {w} +Y {h}": lambda p: p[::-1, ::-1].transpose(1, 0, 2),
}


@pytest.mark.parametrize("rle", [False, True])
@pytest.mark.parametrize("line", ORIENTATIONS)
def test_all_eight_orientations_of_radiance_pictures_are_upright(line: str, rle: bool) -> None:
    upright = rgbe(9, 13)
    stored = np.ascontiguousarray(ORIENTATIONS[line](upright))
    data = hdr(stored, line.format(h=9, w=13), rle=rle)
    pixels = images.read("a.hdr", data, transfer="srgb")
    np.testing.assert_allclose(pixels, values_of(upright), rtol=1e-6)
    assert pixels.dtype == np.float32


def test_an_independent_reader_agrees_on_the_common_orientation(tmp_path: Path) -> None:
    data = hdr(rgbe(9, 13), "-Y 9 +X 13", rle=True)
    other = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)[..., ::-1]
    # OpenCV leaves Ward's half code value out: 2^(e - 137).
    half = 2.0 ** (rgbe(9, 13)[..., 3:].astype(float) - 137)
    np.testing.assert_allclose(radiance.read("a.hdr", data), other + half, rtol=1e-6)


def test_btf_extractors_reading_of_atrium_is_an_option() -> None:
    stored = rgbe(9, 13)
    data = hdr(stored, "+X 9 -Y 13", rle=True)
    pixels = radiance.read("a.hdr", data, orientation="btf_extractor")
    np.testing.assert_allclose(pixels, values_of(stored)[::-1], rtol=1e-6)
    with pytest.raises(ValueError, match="orientation 'up'; expected standard or btf_extractor"):
        radiance.read("a.hdr", data, orientation="up")


def test_the_resolution_line_is_found_wherever_the_header_ends() -> None:
    # BTF_extractor looks at byte 53.
    long = "# a comment\nSOFTWARE=x\nPRIMARIES=0.64 0.33 0.3 0.6 0.15 0.06 0.3127 0.329\n"
    data = hdr(rgbe(9, 13), "-Y 9 +X 13", rle=True, header=long)
    np.testing.assert_allclose(radiance.read("a.hdr", data), values_of(rgbe(9, 13)), rtol=1e-6)


def test_exposures_of_a_radiance_header_are_divided_out() -> None:
    data = hdr(rgbe(9, 13), "-Y 9 +X 13", rle=True, header="EXPOSURE=2.0\nEXPOSURE= 4\n")
    np.testing.assert_allclose(radiance.read("a.hdr", data), values_of(rgbe(9, 13)) / 8, rtol=1e-6)


def test_an_exponent_of_zero_is_black() -> None:
    stored = np.zeros((8, 8, 4), np.uint8)
    stored[..., :3] = 200
    assert radiance.read("a.hdr", hdr(stored, "-Y 8 +X 8", rle=False)).max() == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.replace(b"-Y 9 +X 13", b"-Y 9 +Y 13"), "names one axis twice"),
        (lambda d: d.replace(b"-Y 9 +X 13", b"-Y 9 +X"), "no resolution line"),
        (lambda d: d.replace(b"-Y 9 +X 13", b"-Y 0 +X 13"), "declares 0 x 13"),
        (lambda d: d.replace(b"-Y 9 +X 13", b"-Y 99999999 +X 9"), "declares 99999999 x 9"),
        (lambda d: d.replace(b"-Y 9 +X 13", b"-Y 65000 +X 65000"), "declares 65000 x 65000"),
        (lambda d: d.replace(b"rgbe", b"xyze"), "holds XYZ; expected RGB"),
        (lambda d: d.replace(b"FORMAT", b"EXPOSURE=x\nFORMAT"), "EXPOSURE .* no positive number"),
        (lambda d: d.replace(b"FORMAT", b"EXPOSURE=-1\nFORMAT"), "EXPOSURE .* no positive number"),
        (lambda d: d[:-1], "damaged at byte|cut short"),
        (lambda d: d[: len(d) // 2], "damaged at byte|cut short|start with its length"),
        (lambda d: d[:70], "damaged|cut short|start with its length"),
        (lambda d: d[:20], "no resolution line"),
    ],
)
def test_damaged_radiance_pictures_are_refused(change, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(FormatError, match=message):
        radiance.read("a.hdr", change(hdr(rgbe(9, 13), "-Y 9 +X 13", rle=True)))


def test_flat_radiance_pictures_that_are_cut_are_refused() -> None:
    data = hdr(rgbe(9, 13), "-Y 9 +X 13", rle=False)
    with pytest.raises(FormatError, match="467 bytes of flat pixels; expected 468; copy it again"):
        radiance.read("a.hdr", data[:-1])


def exr(path: Path, values: np.ndarray, channels: tuple[str, ...]) -> bytes:
    images.write_exr(path, values, channels, {"made": "here"})
    return path.read_bytes()


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_an_exr_comes_back_bit_by_bit_with_names_and_attributes(dtype, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    values = np.random.default_rng(0).normal(size=(5, 7, 4)).astype(dtype)
    values[1, 2] = np.nan
    values[0, 0, 0] = -3
    data = exr(tmp_path / "a.exr", values, ("R", "G", "B", "Z"))
    pixels, names, attributes = images.read_exr("a.exr", data)
    np.testing.assert_array_equal(pixels, values)
    assert names == ("R", "G", "B", "Z")
    assert attributes["made"] == "here"
    assert pixels.dtype == np.float32


def test_channels_of_an_exr_are_taken_by_name(tmp_path: Path) -> None:
    values = np.random.default_rng(0).random((4, 4, 5), np.float32)
    names = ("B", "550", "R", "400", "G")
    pixels, found, _ = images.read_exr("a.exr", exr(tmp_path / "a.exr", values, names))
    assert found[:3] == ("R", "G", "B")
    for slot, name in enumerate(found):
        np.testing.assert_array_equal(pixels[..., slot], values[..., names.index(name)])
    assert set(images.exr_channels("a.exr", (tmp_path / "a.exr").read_bytes())) == set(names)


def test_a_part_of_a_picture_lies_in_its_place_and_the_rest_is_not_measured(tmp_path: Path) -> None:
    spec = oiio.ImageSpec(3, 2, 1, oiio.FLOAT)
    spec.x, spec.y = 4, 1
    spec.full_x, spec.full_y, spec.full_width, spec.full_height = 0, 0, 6, 5
    spec.channelnames = ("Y",)
    out = oiio.ImageOutput.create(str(tmp_path / "a.exr"))
    assert out.open(str(tmp_path / "a.exr"), spec)
    assert out.write_image(np.arange(6, dtype=np.float32).reshape(2, 3, 1))
    out.close()
    pixels, _, _ = images.read_exr("a.exr", (tmp_path / "a.exr").read_bytes())
    expected = np.full((5, 6, 1), np.nan, np.float32)
    expected[1:3, 4:6, 0] = [[0, 1], [3, 4]]
    np.testing.assert_array_equal(pixels, expected)


def test_exrs_that_are_cut_or_none_are_refused(tmp_path: Path) -> None:
    data = exr(tmp_path / "a.exr", np.ones((64, 64, 3), np.float32), ("R", "G", "B"))
    for size in (0, 3, 4, 20, 200, len(data) // 2, len(data) - 5):
        with pytest.raises(FormatError, match="EXR"):
            images.read_exr("a.exr", data[:size])


def test_an_exr_that_declares_a_gigantic_window_is_refused_at_once(tmp_path: Path) -> None:
    data = exr(tmp_path / "a.exr", np.ones((4, 4, 3), np.float32), ("R", "G", "B"))
    at = data.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    for corner in ((2**20, 2**20), (2**30, 2**30), (2**31 - 2, 3), (3, 2**31 - 2)):
        crafted = data[: at + 8] + struct.pack("<ii", *corner) + data[at + 16 :]
        start = time.monotonic()
        with pytest.raises(FormatError, match=r"EXR|declares"):
            images.read_exr("a.exr", crafted)
        assert time.monotonic() - start < 2


def test_a_jpeg_that_is_cut_short_is_refused() -> None:
    rng = np.random.default_rng(0)
    data = images.encode_jpeg(rng.random((64, 64, 3), np.float32))
    images.read("a.jpg", data, transfer="srgb")
    for size in (len(data) - 2, len(data) // 2, 700):
        with pytest.raises(FormatError, match=r"cut short|not a readable image"):
            images.read("a.jpg", data[:size], transfer="srgb")


def test_what_lies_between_or_behind_the_segments_of_a_jpeg_changes_nothing() -> None:
    data = images.encode_jpeg(np.random.default_rng(0).random((32, 32, 3), np.float32))
    plain = images.read("a.jpg", data, transfer="srgb")
    at = data.index(b"\xff\xdb")
    note = b"\xff\xfe\x00\x08\xff\xd9\xff\xd8ab"
    for other in (
        data[:at] + bytes(5) + data[at:],
        data[:at] + note + data[at:],
        data + b"MotionPhoto_Data" + bytes(range(256)) * 30,
        data + data[: len(data) // 2],
    ):
        np.testing.assert_array_equal(images.read("a.jpg", other, transfer="srgb"), plain)


def test_a_png_that_is_cut_short_or_has_a_flipped_bit_is_refused() -> None:
    data = images.encode_png(np.random.default_rng(0).random((32, 32, 3), np.float32))
    images.read("a.png", data, transfer="srgb")
    for size in (len(data) - 1, len(data) - 12, len(data) // 2, 40):
        with pytest.raises(FormatError, match=r"cut short|not a readable image"):
            images.read("a.png", data[:size], transfer="srgb")
    flipped = bytearray(data)
    flipped[len(data) // 2] ^= 4
    with pytest.raises(FormatError, match="chunk b'IDAT' of the PNG is damaged; copy it again"):
        images.read("a.png", bytes(flipped), transfer="srgb")


def test_sizes_that_only_a_crafted_header_declares_are_refused_at_once() -> None:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return (
            struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        )

    for side in (2**31 - 1, 60000):
        start = time.monotonic()
        crafted = (
            b"\x89PNG\r\n\x1a\n"
            + chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0))
            + chunk(b"IDAT", zlib.compress(bytes(100)))
            + chunk(b"IEND", b"")
        )
        with pytest.raises(FormatError, match="declares"):
            images.read("a.png", crafted, transfer="srgb")
        assert time.monotonic() - start < 2
    with pytest.raises(FormatError, match="declares 70000 x 1 x 3 values"):
        radiance.check_size("a", 70000, 1)


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.tif", "a.bmp", "a.exr", "a.hdr"])
@pytest.mark.parametrize("data", [b"", b"\0", b"hello world, no image at all", bytes(5000)])
def test_what_is_no_image_is_refused(name: str, data: bytes) -> None:
    with pytest.raises(
        FormatError, match=r"not a readable image|not an EXR|not a Radiance picture"
    ):
        images.read(name, data, transfer="srgb")


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "the file is empty; copy it again"),
        (bytes(900), "nothing but 900 zeros"),
        (b"RIFF\x24\0\0\0WEBPVP8L", "a WebP picture.*; save it as PNG or TIFF"),
        (b"GIF89a\1\0\1\0", "a GIF"),
        (b"\0\0\0\x18ftypheic\0\0", "a HEIF picture"),
        (b"\0\0\0\x18ftypcrx \0\0", "RAW file.*; develop it"),
        (b"\x76\x2f\x31\x01\2\0\0\0", r"OpenEXR.*; let its name end in \.exr"),
        (b"version https://git-lfs.github.com/spec/v1\n", "Git LFS.*git lfs pull"),
        (b"<!DOCTYPE html><title>404", "a web page.*; fetch the picture"),
        (b"nothing that is known", "neither PNG, JPEG, BMP nor TIFF"),
    ],
)
def test_what_is_no_picture_of_ours_is_named(data: bytes, said: str) -> None:
    with pytest.raises(FormatError, match=said):
        headers.size_of("a.png", data)


@pytest.mark.parametrize("kind", ["png", "jpeg", "bmp", "tiff"])
def test_the_declared_size_is_what_an_independent_reader_finds(kind: str) -> None:
    buffer = BytesIO()
    Image.fromarray(picture(9, 14)).save(buffer, kind)
    assert headers.size_of("a", buffer.getvalue()) == (9, 14)
    for size in (1, 7, 20):
        with pytest.raises(FormatError, match=r"the header is damaged|neither PNG"):
            headers.size_of("a", buffer.getvalue()[:size])


def test_big_tiffs_and_both_byte_orders_declare_their_size() -> None:
    for order, mark in (("<", b"II"), (">", b"MM")):
        short = struct.pack(order + "HHIHxx", 256, 3, 1, 14) + struct.pack(
            order + "HHII", 257, 4, 1, 9
        )
        small = mark + struct.pack(order + "HIH", 42, 8, 2) + short
        assert headers.size_of("a", small) == (9, 14)
        long = struct.pack(order + "HHQQ", 256, 16, 1, 14) + struct.pack(
            order + "HHQI", 257, 4, 1, 9
        )
        big = mark + struct.pack(order + "HHHQQ", 43, 8, 0, 16, 2) + long
        assert headers.size_of("a", big) == (9, 14)


def test_pixels_of_another_kind_are_refused() -> None:
    data = cv2.imencode(".tif", np.zeros((3, 3), np.int32))[1].tobytes()
    with pytest.raises(FormatError, match="pixels are signed numbers of 32 bits; expected codes"):
        images.read("a.tif", data, transfer="srgb")


def test_float_tiffs_are_linear() -> None:
    values = np.random.default_rng(0).normal(size=(3, 4, 3)).astype(np.float32)
    data = cv2.imencode(".tif", np.ascontiguousarray(values[..., ::-1]))[1].tobytes()
    np.testing.assert_array_equal(images.read("a.tif", data, transfer="srgb"), values)


def test_encoders_clamp_and_write_what_was_not_measured_as_black() -> None:
    values = np.array([[[2.0, -1.0, np.nan]]], np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pixels = images.read("a.png", images.encode_png(values), transfer="linear")
    np.testing.assert_array_equal(pixels, [[[1, 0, 0]]])


def test_a_folder_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="cannot be written"):
        images.write_exr(tmp_path / "no" / "a.exr", np.ones((2, 2, 1), np.float32), ("Y",))
