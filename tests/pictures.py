"""Pictures of any layout by independent writers, with the linear BT.709 values that they stand for."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from io import BytesIO

import colour as science
import numpy as np
import tifffile
from hypothesis import strategies as st
from PIL import Image

SIZE = (6, 9)
# EXIF 2.3, tag 0112H: where the first row and the first column of the stored data belong.
SHOWN: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    1: lambda p: p,
    2: lambda p: p[:, ::-1],
    3: lambda p: p[::-1, ::-1],
    4: lambda p: p[::-1],
    5: lambda p: p.swapaxes(0, 1),
    6: lambda p: p.swapaxes(0, 1)[:, ::-1],
    7: lambda p: p.swapaxes(0, 1)[::-1, ::-1],
    8: lambda p: p.swapaxes(0, 1)[::-1],
}
# What codes mean where no file says it: readers differ, tests set it.
ASSUMED = "srgb"
SPACES = {"Display P3": "Display P3", "Adobe RGB": "Adobe RGB (1998)", "BT.2020": "ITU-R BT.2020"}


@dataclass(frozen=True)
class Made:
    """A file and what it stands for.

    Attributes:
        suffix, data: of the file.
        truth: (h, w, 1 or 3) upright linear BT.709; NaN where nothing is known.
        off: the greatest error that the encoding makes.
        about: how it was made, for messages.
    """

    suffix: str
    data: bytes
    truth: np.ndarray
    off: float
    about: str


def codes(rng: np.random.Generator, channels: int, dtype: str, top: int) -> np.ndarray:
    """(h, w, c) numbers with both ends among them."""
    found = rng.integers(0, top, (*SIZE, channels), endpoint=True)
    found[0, 0], found[1, 0] = 0, top
    return found.astype(dtype)


def from_srgb(x: np.ndarray) -> np.ndarray:
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def assumed(x: np.ndarray) -> np.ndarray:
    return {"srgb": from_srgb, "linear": lambda x: x, "2.2": lambda x: x**2.2}[ASSUMED](x)


def to_bt709(linear: np.ndarray, space: str | None) -> np.ndarray:
    """By colour-science, whose matrices and adaptation are its own."""
    if space is None or linear.shape[-1] == 1:
        return linear
    spaces = science.RGB_COLOURSPACES
    matrix = science.matrix_RGB_to_RGB(spaces[SPACES[space]], spaces["sRGB"], "Bradford")
    return linear @ matrix.T


def profile(space: str | None, exponent: float, *, grey: bool = False) -> bytes:
    """An ICC profile of version 2 with a matrix and a power, or grey."""

    def fixed(values: Sequence[float]) -> bytes:
        return b"".join(struct.pack(">i", round(v * 65536)) for v in values)

    def xyz(values: Sequence[float]) -> bytes:
        return b"XYZ \0\0\0\0" + fixed(values)

    curve = b"curv\0\0\0\0" + struct.pack(">IH", 1, round(exponent * 256)) + b"\0\0"
    name = (space or "none").encode() + b"\0"
    said = b"desc\0\0\0\0" + struct.pack(">I", len(name)) + name + bytes(78)
    tags = [(b"desc", said + bytes(-len(said) % 4)), (b"wtpt", xyz((0.9642, 1, 0.8249)))]
    if grey:
        tags.append((b"kTRC", curve))
    else:
        own = science.RGB_COLOURSPACES[SPACES.get(space or "", "sRGB")]
        white = science.xy_to_XYZ(own.whitepoint)
        adapted = science.adaptation.matrix_chromatic_adaptation_VonKries(
            white, np.array([0.9642, 1, 0.8249]), "Bradford"
        )
        columns = adapted @ own.matrix_RGB_to_XYZ
        for i, key in enumerate((b"r", b"g", b"b")):
            tags += [(key + b"XYZ", xyz(columns[:, i])), (key + b"TRC", curve)]
    at = 132 + 12 * len(tags)
    table = body = b""
    for key, value in tags:
        table += key + struct.pack(">II", at + len(body), len(value))
        body += value
    kind = b"GRAY" if grey else b"RGB "
    head = struct.pack(">I", at + len(body)) + bytes(4) + struct.pack(">I", 0x02100000) + b"mntr"
    head += kind + b"XYZ " + bytes(12) + b"acsp" + bytes(28) + fixed((0.9642, 1, 0.8249))
    return head.ljust(128, b"\0") + struct.pack(">I", len(tags)) + table + body


@st.composite
def tiffs(draw: st.DrawFn) -> Made:
    """Bits, sample formats, planes, alpha, inversion, palettes, tiles, byte order, pages."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    kind = draw(st.sampled_from(["rgb", "rgb", "minisblack", "miniswhite", "palette"]))
    dtype = draw(st.sampled_from(["u1", "u2", "f2", "f4", "f8"]))
    if kind in ("miniswhite", "palette"):
        dtype = draw(st.sampled_from(["u1", "u2"])) if kind == "miniswhite" else "u1"
    channels = 3 if kind == "rgb" else 1
    floats = dtype[0] == "f"
    top = 1 if floats else 256 ** int(dtype[1]) - 1
    values = (
        rng.random((*SIZE, channels)).astype(dtype) if floats else codes(rng, channels, dtype, top)
    )
    share = values / top
    exponent, space = 0.0, None
    options: dict[str, object] = {"photometric": kind, "metadata": None}
    if kind == "palette":
        table = rng.integers(0, 65535, (3, 256), endpoint=True).astype("u2")
        table[:, :3] = [[0], [65535], [300]]
        options["colormap"] = table
        share = (table / 65535).T[values[..., 0]]
    if kind == "miniswhite":
        share = 1 - share
    if draw(st.booleans()) and kind in ("rgb", "minisblack"):
        space = draw(st.sampled_from([None, *SPACES])) if kind == "rgb" else None
        # Curves on floats are for codes in 0..1, which these are.
        exponent = draw(st.sampled_from([1.0, 1.8, 2.2]))
        options["iccprofile"] = profile(space, exponent, grey=kind == "minisblack")
    alpha = draw(st.sampled_from([None, "unassalpha", "assocalpha"])) if kind != "palette" else None
    stored = values
    if alpha and kind != "miniswhite":
        cover = rng.integers(0, top, SIZE, endpoint=True) if not floats else rng.random(SIZE)
        cover = np.asarray(cover).astype(dtype)
        cover[0, 0], cover[1, 1] = 0, top
        if alpha == "assocalpha":
            cover[2:] = top
            stored = share * (cover / top)[..., None] * top
            stored = stored.astype(dtype) if floats else np.rint(stored).astype(dtype)
            with np.errstate(invalid="ignore", divide="ignore"):
                share = np.where(
                    cover[..., None] > 0, stored / top / (cover / top)[..., None], np.nan
                )
            share = share if floats else np.rint(np.clip(share, 0, 1) * top) / top
            share = np.where(floats, share, np.minimum(share, 1))
        stored = np.concatenate([stored, cover[..., None]], axis=-1)
        options["extrasamples"] = [alpha]
        share = np.minimum(share, 1) if exponent not in (0.0, 1.0) else share
    if stored.shape[2] > 1 and draw(st.booleans()):
        options["planarconfig"] = "separate"
        stored = np.moveaxis(stored, -1, 0)
    elif stored.shape[2] > 1:
        options["planarconfig"] = "contig"
    else:
        stored = stored[..., 0]
    if draw(st.booleans()) and dtype != "f8":
        options["tile"] = (16, 16)
    if draw(st.booleans()) and dtype != "f2":
        options["compression"] = "zlib"
        options["predictor"] = draw(st.booleans()) and not floats
    turned = draw(st.integers(1, 8))
    options["extratags"] = [(274, 3, 1, turned, True)]
    order, big = draw(st.sampled_from("<>")), draw(st.booleans())
    file = BytesIO()
    with tifffile.TiffWriter(file, byteorder=order, bigtiff=big) as writer:
        pages = draw(st.sampled_from(["one", "preview first", "preview last"]))
        preview = np.zeros((2, 3), "u1")
        if pages == "preview first":
            writer.write(preview, photometric="minisblack", subfiletype=1, metadata=None)
        writer.write(stored, **options)
        if pages == "preview last":
            writer.write(preview, photometric="minisblack", subfiletype=1, metadata=None)
    share = share.astype("f8")
    linear = (share if floats else assumed(share)) if not exponent else share**exponent
    truth = SHOWN[turned](to_bt709(linear, space))
    about = f"{kind} {dtype} {space} {exponent} {alpha} {options.get('planarconfig')} turned {turned} {pages}"
    # float32; matrices of ICC profiles have 16 bits behind the point. What is divided by alpha may
    # be rounded to the next code on either side, where curves and primaries are steepest.
    off = 4 / top if alpha == "assocalpha" and not floats else 5e-4
    off = 2e-3 if alpha == "assocalpha" and dtype == "f2" else off
    return Made(".tif", file.getvalue(), truth, max(off, 5e-4), about)


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def _packed(rows: np.ndarray, bits: int) -> bytes:
    """Rows of samples (h, w c) of 1 to 16 bits, each row filled up to whole bytes, filter 0."""
    if bits == 16:
        return b"".join(b"\0" + row.astype(">u2").tobytes() for row in rows)
    spread = (rows[..., None] >> np.arange(bits - 1, -1, -1)) & 1
    return b"".join(b"\0" + np.packbits(row.reshape(-1)).tobytes() for row in spread.astype("u1"))


@st.composite
def pngs(draw: st.DrawFn) -> Made:
    """All colour types and depths, and all chunks that speak of colour; written byte by byte."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    sort, bits = draw(st.sampled_from([
        (0, 1), (0, 2), (0, 4), (0, 8), (0, 16), (2, 8), (2, 16), (3, 2), (3, 8), (4, 8), (4, 16), (6, 8), (6, 16),
    ]))  # fmt: skip
    samples = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[sort]
    top = (1 << bits) - 1
    values = codes(rng, samples, "i4", top)
    chunks = b""
    if sort == 3:
        palette = rng.integers(0, 255, (top + 1, 3), endpoint=True).astype("u1")
        share = palette[values[..., 0]] / 255
    else:
        share = values[..., : 3 if sort in (2, 6) else 1] / top
    colours = share.shape[-1]
    said = draw(
        st.sampled_from(["nothing", "sRGB", "gAMA", "gAMA cHRM", "iCCP", "cICP", "cICP iCCP"])
    )
    space, linear = None, assumed(share)
    if "iCCP" in said:
        space = draw(st.sampled_from([None, *SPACES])) if colours == 3 else None
        body = zlib.compress(profile(space, 1.8, grey=colours == 1))
        chunks += _chunk(b"iCCP", b"x\0\0" + body)
        linear = share**1.8
    if said == "sRGB":
        chunks += _chunk(b"sRGB", b"\0")
        linear = from_srgb(share)
    if "gAMA" in said:
        chunks += _chunk(b"gAMA", struct.pack(">I", 50000))
        linear = share**2
    if "cHRM" in said:
        own = science.RGB_COLOURSPACES["ITU-R BT.2020"]
        xy = np.concatenate([own.whitepoint, own.primaries.reshape(-1)])
        chunks += _chunk(b"cHRM", struct.pack(">8I", *np.rint(xy * 1e5).astype(int)))
        space = "BT.2020"
    if "cICP" in said:
        # BT.2020 primaries, linear: before any profile.
        chunks += _chunk(b"cICP", bytes([9, 8, 0, 1]))
        linear, space = share, "BT.2020"
    turned = draw(st.integers(1, 8))
    exif = b"MM\0*\0\0\0\x08\0\1" + struct.pack(">HHIHH", 274, 3, 1, turned, 0) + bytes(4)
    chunks += _chunk(b"eXIf", exif)
    if sort == 3:
        chunks += _chunk(b"PLTE", palette.tobytes())
    head = struct.pack(">IIBBBBB", SIZE[1], SIZE[0], bits, sort, 0, 0, 0)
    body = zlib.compress(_packed(values.reshape(SIZE[0], -1), bits))
    data = (
        b"\x89PNG\r\n\x1a\n"
        + _chunk(b"IHDR", head)
        + chunks
        + _chunk(b"IDAT", body)
        + _chunk(b"IEND", b"")
    )
    truth = SHOWN[turned](to_bt709(linear, space if colours == 3 else None))
    if sort == 4:
        truth = np.repeat(truth, 3, axis=-1)
    about = f"type {sort}, {bits} bits, {said} {space}, turned {turned}"
    # Matrices of four digits in colour-science, of 16 bits in profiles.
    return Made(".png", data, truth, 5e-4, about)


@st.composite
def jpegs(draw: st.DrawFn) -> Made:
    """Smooth pictures with profiles, orientations and whatever phones append; by Pillow."""
    mode = draw(st.sampled_from(["L", "RGB"]))
    size = (4 * SIZE[0], 4 * SIZE[1])
    row, col = np.indices(size) / np.reshape(size, (2, 1, 1))
    smooth = np.stack([row, col, 1 - (row + col) / 2], axis=-1)[..., : 1 if mode == "L" else 3]
    values = np.rint(255 * (0.1 + 0.8 * smooth)).astype("u1")
    space = draw(st.sampled_from([None, *SPACES])) if mode == "RGB" else None
    exponent = draw(st.sampled_from([None, 1.0, 2.2]))
    icc = None if exponent is None else profile(space, exponent, grey=mode == "L")
    turned = draw(st.integers(1, 8))
    exif = Image.Exif()
    exif[274] = turned
    file = BytesIO()
    picture = Image.fromarray(values[..., 0] if mode == "L" else values)
    picture.save(
        file, "JPEG", quality=100, subsampling=0, exif=exif, icc_profile=icc,
        progressive=draw(st.booleans()),
    )  # fmt: skip
    share = values / 255
    linear = assumed(share) if exponent is None else share**exponent
    truth = SHOWN[turned](to_bt709(linear, space if icc else None))
    trailer = draw(
        st.sampled_from([b"", b"\xff\xd9", b"MotionPhoto_Data" + bytes(range(256)) * 40])
    )
    # Quality 100 rounds twice, 2 codes; the steepest curve is the power of 2.2, and the widest
    # primaries weigh a channel 1.7 times.
    return Made(
        ".jpg",
        file.getvalue() + trailer,
        truth,
        2 / 255 * 2.2 * 1.7,
        f"{mode} {space} {exponent} {turned}",
    )


@st.composite
def exrs(draw: st.DrawFn) -> Made:
    """Names, kinds of pixels, order of lines, windows and chromaticities; written byte by byte."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    layer = draw(st.sampled_from(["", "ViewLayer.Combined.", "beauty."]))
    grey = draw(st.booleans()) and not layer
    roles = ["Y"] if grey else ["R", "G", "B"]
    extra = draw(st.sets(st.sampled_from(["A", "Z", "N.X", "N.Y", "N.Z", "diffuse.R", "id"])))
    if not grey and draw(st.booleans()):
        extra |= {"ViewLayer.DiffCol.R", "ViewLayer.DiffCol.G", "ViewLayer.DiffCol.B"}
    names = sorted({*(layer + role for role in roles), *extra})
    half = draw(st.booleans())
    planes = {n: rng.normal(size=SIZE).astype("f2" if half else "f4") for n in names}
    space = draw(st.sampled_from([None, *SPACES]))

    def attribute(name: bytes, kind: bytes, body: bytes) -> bytes:
        return name + b"\0" + kind + b"\0" + struct.pack("<I", len(body)) + body

    listing = b"".join(
        n.encode() + b"\0" + struct.pack("<IBxxxII", 1 if half else 2, 0, 1, 1) for n in names
    )
    h, w = SIZE
    window = struct.pack("<4i", 0, 0, w - 1, h - 1)
    up = draw(st.booleans())
    head = attribute(b"channels", b"chlist", listing + b"\0") + attribute(
        b"compression", b"compression", b"\0"
    )
    head += attribute(b"dataWindow", b"box2i", window) + attribute(
        b"displayWindow", b"box2i", window
    )
    head += attribute(b"lineOrder", b"lineOrder", bytes([up])) + attribute(
        b"pixelAspectRatio", b"float", struct.pack("<f", 1)
    )
    head += attribute(b"screenWindowCenter", b"v2f", bytes(8)) + attribute(
        b"screenWindowWidth", b"float", struct.pack("<f", 1)
    )
    if space:
        own = science.RGB_COLOURSPACES[SPACES[space]]
        xy = (*own.primaries.reshape(-1), *own.whitepoint)
        head += attribute(b"chromaticities", b"chromaticities", struct.pack("<8f", *xy))
    start = 8 + len(head) + 1
    lines = [b"".join(planes[n][y].tobytes() for n in names) for y in range(h)]
    size = 8 + len(lines[0])
    order = range(h - 1, -1, -1) if up else range(h)
    places = {y: start + 8 * h + size * i for i, y in enumerate(order)}
    data = b"v/1\x01" + struct.pack("<I", 2) + head + b"\0"
    data += b"".join(struct.pack("<Q", places[y]) for y in range(h))
    data += b"".join(struct.pack("<iI", y, len(lines[y])) + lines[y] for y in order)
    linear = np.stack([planes[layer + role] for role in roles], axis=-1).astype("f8")
    truth = to_bt709(linear, space)
    return Made(".exr", data, truth, 2e-3, f"{names} {space} half {half}")


@st.composite
def hdrs(draw: st.DrawFn) -> Made:
    """Resolution lines, exposures, colour corrections and primaries."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    h, w = SIZE
    rgbe = rng.integers(0, 255, (h, w, 4), endpoint=True)
    rgbe[..., 3] = rng.integers(120, 134, (h, w))
    values = (rgbe[..., :3] + 0.5) * 2.0 ** (rgbe[..., 3:] - 136.0)
    lines = []
    if draw(st.booleans()):
        lines += ["EXPOSURE=2.5", "EXPOSURE=0.5"]
        values = values / 1.25
    if draw(st.booleans()):
        lines.append("COLORCORR= 2 1 0.5")
        values = values / [2, 1, 0.5]
    space = draw(st.sampled_from([None, *SPACES]))
    if space:
        own = science.RGB_COLOURSPACES[SPACES[space]]
        lines.append(
            "PRIMARIES= "
            + " ".join(f"{v:.6f}" for v in (*own.primaries.reshape(-1), *own.whitepoint))
        )
    ordered, line = draw(st.sampled_from([
        (rgbe, f"-Y {h} +X {w}"), (rgbe[::-1], f"+Y {h} +X {w}"), (rgbe.swapaxes(0, 1), f"+X {w} -Y {h}"),
    ]))  # fmt: skip
    top = "\n".join(["#?RADIANCE", *draw(st.permutations(lines)), "FORMAT=32-bit_rle_rgbe"])
    data = f"{top}\n\n{line}\n".encode() + np.ascontiguousarray(ordered).astype("u1").tobytes()
    return Made(".hdr", data, to_bt709(values, space), 2e-3, f"{lines} {line}")


def bmps() -> st.SearchStrategy[Made]:
    """8-bit palettes and 24 bits; by Pillow."""

    def make(seed: int, mode: str) -> Made:
        values = codes(np.random.default_rng(seed), 3, "u1", 255)
        picture = Image.fromarray(values).quantize(64) if mode == "P" else Image.fromarray(values)
        file = BytesIO()
        picture.save(file, "BMP")
        share = np.asarray(picture.convert("RGB")) / 255
        return Made(".bmp", file.getvalue(), assumed(share), 2e-4, mode)

    return st.builds(make, st.integers(0, 2**32 - 1), st.sampled_from(["P", "RGB"]))


def any_picture() -> st.SearchStrategy[Made]:
    """A picture of any kind."""
    return st.one_of(tiffs(), pngs(), jpegs(), exrs(), hdrs(), bmps())


def white(size: tuple[int, int]) -> bytes:
    """A PNG (h, w) of the brightest code throughout."""
    file = BytesIO()
    Image.fromarray(np.full((*size, 3), 255, "u1")).save(file, "PNG")
    return file.getvalue()


def packed_tiff(
    values: np.ndarray, bits: int, photometric: int, table: np.ndarray | None = None
) -> bytes:
    """A TIFF of samples (h, w, c) of 1 to 14 bits, as scanners and machine vision write them.

    Args:
        values: whole numbers.
        bits: of a sample; rows are filled up to whole bytes.
        photometric: 0 white is zero, 1 black is zero, 2 RGB, 3 palette.
        table: (3, 2^bits) colours of a palette.
    """
    h, w, c = values.shape
    spread = (values.reshape(h, -1)[..., None] >> np.arange(bits - 1, -1, -1)) & 1
    body = b"".join(np.packbits(row.reshape(-1)).tobytes() for row in spread.astype("u1"))
    body += bytes(len(body) % 2)
    entries = [(256, 4, w), (257, 4, h), (259, 3, 1), (262, 3, photometric), (273, 4, 8), (277, 3, c), (278, 4, h), (279, 4, len(body))]  # fmt: skip
    longer = {258: struct.pack(f"<{c}H", *[bits] * c)}
    if table is not None:
        longer[320] = table.astype("<u2").tobytes()
    at = 8 + len(body)
    beyond = at + 2 + 12 * (len(entries) + len(longer)) + 4
    rows = {tag: struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in entries}
    tail = b""
    for tag, data in longer.items():
        where = struct.pack("<I", beyond + len(tail)) if len(data) > 4 else data.ljust(4, b"\0")
        rows[tag] = struct.pack("<HHI", tag, 3, len(data) // 2) + where
        tail += data if len(data) > 4 else b""
    directory = (
        struct.pack("<H", len(rows)) + b"".join(rows[tag] for tag in sorted(rows)) + bytes(4)
    )
    return b"II*\0" + struct.pack("<I", at) + body + directory + tail
