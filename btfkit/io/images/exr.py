"""OpenEXR: channels by the roles that their names say, in all parts, with declared primaries."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from btfkit.errors import FormatError
from btfkit.io.images import exif
from btfkit.io.images.codes import said
from btfkit.io.images.image import Array, Image
from btfkit.io.images.libraries import openimageio
from btfkit.io.images.profiles import BT709, Chromaticities, Declared, from_primaries, to_xyz
from btfkit.io.images.radiance import check_size

T = TypeVar("T")
_RGB = {"R": 0, "G": 1, "B": 2}
# Layers that hold the finished picture, by the customs of renderers.
_FINISHED = {"combined", "beauty", "rgba", "rgb", "color", "colour"}
_CHROMA = ("Y", "RY", "BY")
_MOST_PARTS = 256
# Of the attributes: how the first part stores its pixels.
_DEPTH = "btfkit:pixels"


def exr_channels(name: str, data: bytes) -> tuple[str, ...]:
    """Channel names of an EXR as they stand in its headers, which alone are decoded."""
    return _with_exr(name, data, lambda source: _names(_parts(name, source)))


def read_exr(name: str, data: bytes) -> tuple[Array, tuple[str, ...], dict[str, Any]]:
    """An EXR: (h, w, c) float32, channel names (R, G, B first), and its attributes.

    Channels of several parts are put together; where parts have the same ones, each is named
    PART.CHANNEL. Values are as stored.

    Raises:
        FormatError: not an EXR, damaged, deep, with parts of several sizes, or absurdly large.
    """

    def decode(source: Any) -> tuple[Array, tuple[str, ...], dict[str, Any]]:
        specs = _parts(name, source)
        names = _names(specs)
        first = specs[0]
        sizes = [(spec.full_height, spec.full_width) for spec in specs]
        if len(set(sizes)) > 1:
            listing = ", ".join(f"{_label(s, i)}: {h} x {w}" for i, (s, (h, w)) in
                                enumerate(zip(specs, sizes, strict=True)))  # fmt: skip
            raise FormatError(
                name, f"holds pictures of several sizes ({listing}); expected one",
                remedy="save the one that is meant by itself",
            )  # fmt: skip
        check_size(name, first.full_height, first.full_width, len(names))
        values = [_pixels(name, source, i, spec, len(data)) for i, spec in enumerate(specs)]
        attributes = {attribute.name: attribute.value for attribute in first.extra_attribs}
        attributes[_DEPTH] = str(first.format)
        together = values[0] if len(values) == 1 else np.concatenate(values, axis=-1)
        turned = attributes.get("Orientation", 1)
        if turned in range(2, 9):
            together = exif.upright(together, turned)
        return together, names, attributes

    values, names, attributes = _with_exr(name, data, decode)
    order = sorted(range(len(names)), key=lambda i: (_RGB.get(names[i], 3), i))
    return np.ascontiguousarray(values[..., order]), tuple(names[i] for i in order), attributes


def decode(name: str, data: bytes) -> Image:
    """The colour of an EXR: (h, w, 3 or 1), linear BT.709 where there are three.

    R, G, B of the base layer, or of the only layer that has them, or of the one called combined,
    beauty or rgba; else luminance, with chroma where there is some; else the only channel.

    Raises:
        FormatError: as `read_exr`, or no colour, or several; the message lists the channels.
    """
    file = read_exr(name, data)
    return of_channels(name, file, colours(name, file[1]))


def of_channels(
    name: str,
    file: tuple[Array, tuple[str, ...], Mapping[str, Any]],
    taken: Sequence[str],
    *,
    variance: bool = False,
) -> Image:
    """Some channels of an EXR; those of colour in linear BT.709.

    Args:
        name: for messages.
        file: as `read_exr` gives it.
        taken: channels, in the order in which they are wanted.
        variance: whether values are variances: of a mixture its squared weights count.
    """
    values, names, attributes = file
    coloured = is_rgb(taken) or _is_chroma(taken)
    declared = declared_by(name, attributes) if coloured else None
    picked = values[..., [names.index(channel) for channel in taken]]
    if _is_chroma(taken):
        picked = _from_chroma(picked, attributes)
    if declared is not None and declared.matrix is not None:
        weights = declared.matrix**2 if variance else declared.matrix
        picked = np.asarray(picked @ weights.T.astype(np.float32), np.float32)
    covered = coloured or tuple(taken) == ("Y",)
    alpha = next((n for n in names if covered and n == _prefix(taken[0]) + "A"), None)
    beside = tuple(n for n in names if n not in taken and n != alpha)
    cover = None if alpha is None else values[..., names.index(alpha)]
    depth = np.dtype(np.float16 if attributes[_DEPTH] == "half" else np.float32)
    return Image(np.ascontiguousarray(picked), cover, depth, declared, beside, _doubt(cover))


def is_rgb(channels: Sequence[str]) -> bool:
    """Whether channels are R, G and B of some layer."""
    return [name.rsplit(".", 1)[-1].upper() for name in channels] == ["R", "G", "B"]


def _is_chroma(channels: Sequence[str]) -> bool:
    return tuple(channels) == _CHROMA


def _doubt(cover: Array | None) -> str:
    """EXRs should hold colours multiplied by alpha; those of measurements often do not."""
    below = 0 if cover is None else int(np.count_nonzero(cover < 1))
    return f"alpha is below 1 in {below} texels; colours are taken as stored" if below else ""


def colours(name: str, names: Sequence[str]) -> tuple[str, ...]:
    """The channels that are the colour of a picture, R, G, B or Y, RY, BY or one.

    Raises:
        FormatError: none, or several layers of them.
    """
    layers = {
        prefix: tuple(found)
        for prefix in dict.fromkeys(_prefix(each) for each in names)
        if len(found := _triple(prefix, names, "RGB")) == 3
    }
    finished = [p for p in layers if p.rstrip(".").rsplit(".", 1)[-1].lower() in _FINISHED]
    for choice in ([p for p in layers if not p], list(layers), finished):
        if len(choice) == 1:
            return layers[choice[0]]
    listing = ", ".join(names[:12])
    if layers:
        raise FormatError(
            name, f"several layers hold colour (channels {listing}); expected R, G and B once",
            remedy="save the layer that is meant by itself, or name its channels in a manifest",
        )  # fmt: skip
    if "Y" in names and "X" not in names:
        return _CHROMA if set(_CHROMA) <= set(names) else ("Y",)
    if len(names) == 1 and names[0] not in ("A", "Z"):
        return (names[0],)
    raise FormatError(
        name, f"channels {listing}; expected R, G, B, or Y",
        remedy="give its channels the names of their roles",
    )  # fmt: skip


def declared_by(name: str, attributes: Mapping[str, Any]) -> Declared | None:
    """The primaries that attributes declare; None where they are silent.

    Raises:
        FormatError: chromaticities that are none, or a space that is neither linear nor data.
    """
    given = attributes.get("chromaticities")
    if given is None:
        return None
    try:
        values = tuple(float(value) for value in given)
        chromaticities: Chromaticities = values  # type: ignore[assignment]
        if len(values) != 8:
            raise ValueError("not eight")
        matrix = from_primaries(chromaticities)
        return Declared("EXR chromaticities", None, matrix, chromaticities=chromaticities)
    except (TypeError, ValueError) as error:
        raise FormatError(
            name, f"chromaticities {str(given)[:80]} are none", remedy="save it without them"
        ) from error


def _from_chroma(values: Array, attributes: Mapping[str, Any]) -> Array:
    """R, G, B of luminance and chroma. Source: OpenEXR, ImfRgbaYca.h."""
    weight = to_xyz(attributes.get("chromaticities", BT709))[1]
    y, ry, by = np.moveaxis(values, -1, 0)
    r, b = (ry + 1) * y, (by + 1) * y
    g = (y - weight[0] * r - weight[2] * b) / weight[1]
    return np.stack([r, g, b], axis=-1).astype(np.float32)


def _prefix(channel: str) -> str:
    """`ViewLayer.Combined.` of `ViewLayer.Combined.R`, nothing of `R`."""
    return channel[: channel.rfind(".") + 1]


def _triple(prefix: str, names: Sequence[str], roles: str) -> list[str]:
    """The channels of one layer that have these roles, in their order."""
    found = (
        next((prefix + r for r in (role, role.lower()) if prefix + r in names), None)
        for role in roles
    )
    return [channel for channel in found if channel is not None]


def _parts(name: str, source: Any) -> list[Any]:
    """The header of each part."""
    specs = [source.spec()]
    while len(specs) < _MOST_PARTS and source.seek_subimage(len(specs), 0):
        specs.append(source.spec())
    source.seek_subimage(0, 0)
    if any(spec.deep for spec in specs):
        raise FormatError(name, "the EXR is deep; expected flat pixels")
    # The library says once more what it found where there was no further part.
    source.geterror()
    return specs


def _names(specs: Sequence[Any]) -> tuple[str, ...]:
    """Channel names of all parts, each once."""
    own = [channel for spec in specs for channel in spec.channelnames]
    if len(set(own)) == len(own):
        return tuple(own)
    return tuple(
        channel if channel.startswith(f"{_label(spec, i)}.") else f"{_label(spec, i)}.{channel}"
        for i, spec in enumerate(specs)
        for channel in spec.channelnames
    )


def _label(spec: Any, index: int) -> str:
    return str(
        spec.getattribute("oiio:subimagename") or spec.getattribute("name") or f"part{index}"
    )


def _pixels(name: str, source: Any, part: int, spec: Any, coded: int) -> Array:
    oiio = openimageio()
    check_size(name, spec.height, spec.width, spec.nchannels, coded=coded)
    source.seek_subimage(part, 0)
    pixels = source.read_image(oiio.FLOAT)
    fault = _said(source.geterror)
    if pixels is None or fault:
        raise FormatError(name, f"the EXR cannot be decoded ({fault})", remedy="copy it again")
    return _in_display_window(name, np.asarray(pixels, np.float32), spec, coded)


def _said(ask: Callable[[], str]) -> str:
    """What OpenImageIO says, of the file instead of the copy that it was given."""
    copy = re.escape(os.path.join(tempfile.gettempdir(), tempfile.gettempprefix()))
    return said(lambda: re.sub(rf"{copy}\w+(\.exr)?", "the file", ask()))


def _with_exr(name: str, data: bytes, use: Callable[[Any], T]) -> T:
    """What `use` makes of the opened EXR."""
    oiio = openimageio()
    if data[:4] != b"v/1\x01":
        raise FormatError(name, "not an EXR: the magic number is missing")
    # OpenImageIO's Python face opens names only.
    with tempfile.NamedTemporaryFile(suffix=".exr") as file:
        file.write(data)
        file.flush()
        source = oiio.ImageInput.open(file.name)
        if source is None:
            raise FormatError(
                name, f"the EXR cannot be opened ({_said(oiio.geterror)})",
                remedy="save it with whole, flat channels R, G and B",
            )  # fmt: skip
        try:
            return use(source)
        except UnicodeDecodeError as error:
            raise FormatError(name, "a name in the EXR is not UTF-8") from error
        finally:
            source.close()


def _in_display_window(name: str, pixels: Array, spec: Any, coded: int) -> Array:
    """The whole picture of an EXR that stores a part of it; NaN where it stores nothing."""
    data_window = (spec.y, spec.x, spec.height, spec.width)
    display = (spec.full_y, spec.full_x, spec.full_height, spec.full_width)
    values = pixels.reshape(spec.height, spec.width, -1)
    if data_window == display:
        return values
    check_size(name, spec.full_height, spec.full_width, spec.nchannels, coded=coded)
    row, col = spec.y - spec.full_y, spec.x - spec.full_x
    out = np.full((spec.full_height, spec.full_width, spec.nchannels), np.nan, np.float32)
    top, left = max(row, 0), max(col, 0)
    bottom, right = (
        max(spec.full_height - row, 0),
        max(spec.full_width - col, 0),
    )
    inside = values[top - row : bottom, left - col : right]
    if inside.size:
        out[top : top + inside.shape[0], left : left + inside.shape[1]] = inside
    return out
