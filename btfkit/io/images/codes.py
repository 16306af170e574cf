"""PNG, JPEG, BMP and TIFF: code values and floats to linear BT.709.

Pixels are decoded by libraries; what they give is compared with what the header declares.
"""

from __future__ import annotations

import functools
import tempfile
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit import colour
from btfkit.errors import FormatError
from btfkit.io.images import exif, headers, tiff
from btfkit.io.images.header import Header
from btfkit.io.images.image import Array, Image
from btfkit.io.images.libraries import opencv, openimageio
from btfkit.io.images.profiles import Declared
from btfkit.io.images.radiance import check_size


def decode(name: str, data: bytes, *, transfer: str, assumed: bool) -> Image:
    """One picture.

    Args:
        name: for messages.
        data: the bytes of the file.
        transfer: what integer codes mean: srgb, linear or an exponent.
        assumed: whether `transfer` only fills in where the file declares nothing; else it counts
            whatever curve the file declares. Declared primaries are converted in both cases.

    Raises:
        FormatError: no such picture, damaged, or declaring what is not understood.
    """
    check_size(name, *headers.size_of(name, data), coded=len(data))
    header = headers.describe(name, data)
    is_tiff = headers.module_of(name, data) is tiff
    pixels = _by_openimageio(name, data, header) if is_tiff else _by_opencv(name, data, header)
    if header.orientation != 1:
        pixels = exif.upright(pixels, header.orientation)
    colours = pixels[..., :-1] if header.alpha else pixels
    alpha = pixels[..., -1] if header.alpha else None
    linear = _linear(name, np.ascontiguousarray(colours), header, transfer, assumed)
    if alpha is not None and header.premultiplied:
        linear = _divided(name, colours, alpha, header, transfer, assumed)
    depth = np.dtype(colours.dtype)
    return Image(linear, alpha, depth, header.declared, doubt=header.doubt)


def _linear(name: str, values: NDArray[Any], header: Header, transfer: str, assumed: bool) -> Array:
    """(h, w, c) linear BT.709 of codes or floats."""
    declared = header.declared
    if values.dtype.kind == "f":
        return _from_floats(name, values.astype(np.float32), declared)
    bits = 8 * values.dtype.itemsize
    if declared is None or (assumed and declared.srgb and declared.curves):
        return _looked_up(values, colour.table("srgb" if declared else transfer, bits))
    if assumed and declared.curves is not None:
        tables = _tables(declared, bits)
    else:
        tables = (colour.table(transfer, bits),)
    if len(tables) == 1:
        linear = _looked_up(values, tables[0])
    else:
        planes = [_looked_up(values[..., i : i + 1], t) for i, t in enumerate(tables)]
        linear = np.concatenate(planes, axis=-1)
    return _converted(linear, declared)


def _converted(linear: Array, declared: Declared) -> Array:
    if declared.matrix is None or linear.shape[2] != 3:
        return linear
    return np.asarray(opencv().transform(linear, declared.matrix.astype(np.float32)), np.float32)


def _from_floats(name: str, values: Array, declared: Declared | None) -> Array:
    """Floats are linear, unless a profile says otherwise and they are codes in 0..1."""
    if declared is None:
        return np.ascontiguousarray(values)
    if not declared.is_linear:
        # What was divided by alpha may be a step of half above.
        if ((values < 0) | (values > 1 + 2**-10)).any():
            raise FormatError(
                name, f"floats beyond 0..1 behind the curve of {declared.name}",
                remedy="save them as linear, with a linear profile or none",
            )  # fmt: skip
        return np.asarray(declared.decoded(np.minimum(values, np.float32(1))), np.float32)
    return _converted(np.ascontiguousarray(values), declared)


@functools.lru_cache(maxsize=16)
def _tables(declared: Declared, bits: int) -> tuple[Array, ...]:
    codes = np.arange(1 << bits) / ((1 << bits) - 1)
    return tuple(np.asarray(curve(codes), np.float32) for curve in declared.curves or ())


def _looked_up(codes: NDArray[Any], table: Array) -> Array:
    """`table[codes]`: 8 bits at once, 16 row by row, as an index of eight bytes a value is made."""
    if codes.dtype == np.uint8:
        values = opencv().LUT(np.ascontiguousarray(codes), table)
        return np.asarray(values, np.float32).reshape(codes.shape)
    out = np.empty(codes.shape, np.float32)
    for row, line in zip(out, codes, strict=True):
        row[...] = table[line]
    return out


def _divided(
    name: str,
    colours: NDArray[Any],
    alpha: NDArray[Any],
    header: Header,
    transfer: str,
    assumed: bool,
) -> Array:
    """Colours that were multiplied by alpha, by themselves; NaN where alpha is 0.

    They were multiplied as they are stored, so codes are divided before they are decoded.
    """
    top = float(np.iinfo(alpha.dtype).max) if alpha.dtype.kind == "u" else 1.0
    cover = np.asarray(alpha, np.float64)[..., None] / top
    own = np.where(cover > 0, colours / np.where(cover > 0, cover, 1), np.nan)
    if colours.dtype.kind == "f":
        return _from_floats(name, own.astype(np.float32), header.declared)
    codes = np.rint(np.clip(np.nan_to_num(own), 0, top)).astype(colours.dtype)
    linear = _linear(name, codes, header, transfer, assumed)
    return np.where(cover > 0, linear, np.float32(np.nan))


def _by_opencv(name: str, data: bytes, header: Header) -> NDArray[Any]:
    """(h, w, c) as stored, RGB, alpha last."""
    cv2 = opencv()
    depth = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
    flags = cv2.IMREAD_UNCHANGED if header.alpha else depth
    coded = np.frombuffer(data, np.uint8, len(data) if header.end is None else header.end)
    try:
        pixels = cv2.imdecode(coded, flags)
    except cv2.error as error:
        raise FormatError(name, f"not a readable image ({error})") from error
    if pixels is None:
        raise FormatError(name, "not a readable image", remedy="copy it again")
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    channels = pixels.shape[2]
    # OpenCV gives grey with alpha as three equal colours with alpha, and a palette of greys as one.
    given = channels - header.alpha
    if given not in (1, 3) or channels < 1 + header.alpha:
        raise _contradicted(name, pixels, header)
    _check_decoded(name, pixels, header)
    if channels == 3:
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB))
    if channels == 4:
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGRA2RGBA))
    return np.asarray(pixels)


def _by_openimageio(name: str, data: bytes, header: Header) -> NDArray[Any]:
    """(h, w, c) as stored, alpha last; palettes are looked up, white is the highest code."""
    indexed = tiff.palette(data, header.page)
    if indexed is not None:
        coded, colours = indexed
        plain = replace(header, colours=1, bits=8)
        indices = _read_page(name, coded, plain)[..., 0].astype(np.intp)
        # Indices of fewer bits are spread over eight.
        indices //= max(1, 255 // (len(colours) - 1))
        return np.asarray(colours[indices])
    return _read_page(name, data, header)


def _read_page(name: str, data: bytes, header: Header) -> NDArray[Any]:
    oiio = openimageio()
    asked = oiio.ImageSpec()
    asked.attribute("oiio:UnassociatedAlpha", 1)
    # OpenImageIO's Python face opens names only.
    with tempfile.NamedTemporaryFile(suffix=".tif") as file:
        file.write(data)
        file.flush()
        source = oiio.ImageInput.open(file.name, asked)
        if source is None:
            raise FormatError(name, f"not a readable image ({said(oiio.geterror)})")
        try:
            there = source.seek_subimage(header.page, 0)
            form = source.spec().format
            pixels = source.read_image(form) if there else None
            fault = said(source.geterror)
        finally:
            source.close()
    if pixels is None or fault:
        raise FormatError(name, f"not a readable image ({fault})", remedy="copy it again")
    values = np.asarray(pixels).reshape(*np.shape(pixels)[:2], -1)
    _check_decoded(name, values, header)
    if values.shape[2] != header.colours + header.alpha:
        raise _contradicted(name, values, header)
    # OpenImageIO turns 8 bits around by itself.
    if tiff.inverted(data, header.page) and values.dtype != np.uint8:
        if values.dtype.kind == "f":
            raise FormatError(
                name, "holds floats of which 0 is white; expected 0 to be black",
                remedy="save it the other way around",
            )  # fmt: skip
        values[..., 0] = np.iinfo(values.dtype).max - values[..., 0]
    return values


def _check_decoded(name: str, pixels: NDArray[Any], header: Header) -> None:
    """Refuse pixels that are not those that the header declares."""
    floats = pixels.dtype.kind == "f"
    same = pixels.shape[:2] == (header.h, header.w) and floats == header.floats
    if not same or 8 * pixels.dtype.itemsize != header.bits:
        raise _contradicted(name, pixels, header)


def _contradicted(name: str, pixels: NDArray[Any], header: Header) -> FormatError:
    kind = "float" if header.floats else "uint"
    return FormatError(
        name,
        f"declares {header.h} x {header.w} x {header.colours + header.alpha} {kind}{header.bits}, "
        f"and {' x '.join(map(str, pixels.shape))} {pixels.dtype} are decoded",
        remedy="save it as a PNG or TIFF of 8 or 16 bits",
    )


def said(fault: Any) -> str:
    """What a library says is wrong, in short: it cites a damaged file at length."""
    try:
        return " ".join(fault().split())[:200]
    except UnicodeDecodeError:
        return "it holds names that are not UTF-8"
