"""The directories of a TIFF: which of its pictures is the photograph, and how its samples lie.

Source: TIFF 6.0, 1992; BigTIFF; Adobe's Technical Note 2 (sample formats) and DNG 1.7.
"""

from __future__ import annotations

import math
import re

import numpy as np
from numpy.typing import NDArray

from btfkit.errors import FormatError
from btfkit.io.images import icc
from btfkit.io.images.header import Header
from btfkit.io.images.profiles import D65, Chromaticities, Declared, from_primaries
from btfkit.tifftags import Directory, below, chain_of

_WIDTH, _HEIGHT, _BITS, _PHOTOMETRIC, _DESCRIPTION = 256, 257, 258, 262, 270
_ORIENTATION, _SAMPLES, _EXTRA, _FORMAT = 274, 277, 338, 339
_SUBFILE, _OLD_SUBFILE, _ICC, _DEPTH, _DNG = 254, 255, 34675, 32997, 50706
_WHITE, _PRIMARIES, _COLOUR_MAP, _TILE_WIDTH = 318, 319, 320, 322
_REDUCED_OR_MASK = 1 | 4
_GREY_INVERTED, _GREY, _RGB, _PALETTE, _YCBCR = 0, 1, 2, 3, 6
_RAW = {32803: "a colour filter array", 34892: "linear sensor values"}
_OTHERS = {
    4: "a transparency mask", 5: "inks (CMYK)", 8: "CIE L*a*b*", 9: "ICC L*a*b*", 10: "ITU L*a*b*",
    32844: "LogL", 32845: "LogLuv", 51177: "depth",
}  # fmt: skip
# What changes the meaning of values, and is not read.
_NOT_READ = {
    291: "a grey response curve", 301: "a transfer function", 342: "a transfer range",
}  # fmt: skip
_CODES, _SIGNED, _FLOATS = 1, 2, 3
_SHAPE = re.compile(rb'^\{"shape": \[([\d, ]{1,200})\]')
_IMAGEJ = re.compile(rb"^ImageJ=.*?^images=(\d{1,9})$", re.MULTILINE | re.DOTALL)


def size(data: bytes) -> tuple[int, int]:
    """(h, w) of the largest picture. Raises struct.error or ValueError where it is damaged."""
    sizes = [d.size for d in chain_of(data) if _WIDTH in d and _HEIGHT in d]
    return max(sizes, key=math.prod)


def describe(name: str, data: bytes) -> Header:
    """What the directory of the photograph says.

    Raises:
        FormatError: a camera's RAW file, several pictures, or samples that are not understood.
    """
    chain = chain_of(data)
    page = _photograph(name, data, chain)
    directory = chain[page]
    h, w = directory.size
    bits, floats = _samples(name, directory)
    if directory.number(_PHOTOMETRIC, -1) == _PALETTE:
        bits = 16
    colours, alpha, premultiplied = _channels(name, directory)
    _check_stack(name, directory, h * w * (colours + alpha))
    _check_strips(name, directory)
    for tag, what in _NOT_READ.items():
        if tag in directory and _ICC not in directory:
            raise FormatError(name, f"declares {what}, which is not read", remedy="save it as PNG")
    orientation = directory.number(_ORIENTATION, 1)
    return Header(
        h, w, colours=colours, bits=bits, floats=floats, alpha=alpha, premultiplied=premultiplied,
        orientation=orientation if orientation in range(1, 9) else 1,
        declared=_declared(name, directory, colours), page=page,
    )  # fmt: skip


def palette(data: bytes, page: int) -> tuple[bytes, NDArray[np.uint16]] | None:
    """The file with its indices as grey, and the (k, 3) colours they stand for; None without them.

    Libraries cut the colours to 8 bits.
    """
    directory = chain_of(data)[page]
    if directory.number(_PHOTOMETRIC, -1) != _PALETTE:
        return None
    colours = np.array(directory.values(_COLOUR_MAP), np.uint16).reshape(3, -1).T
    if colours.max(initial=0) < 256:
        # Many writers put 8 bits where 16 belong.
        colours = colours * np.uint16(257)
    return directory.patched(_PHOTOMETRIC, _GREY), colours


def inverted(data: bytes, page: int) -> bool:
    """Whether 0 is white."""
    return chain_of(data)[page].number(_PHOTOMETRIC, _GREY) == _GREY_INVERTED


def _photograph(name: str, data: bytes, chain: list[Directory]) -> int:
    """The one picture that is neither a preview nor a mask."""
    inner = [each for directory in chain for each in below(data, directory)]
    raw = [d for d in (*chain, *inner) if d.number(_PHOTOMETRIC, -1) in _RAW]
    if raw or any(_DNG in d for d in chain) or data[8:10] == b"CR":
        what = _RAW[raw[0].number(_PHOTOMETRIC, -1)] if raw else "a RAW file of a camera"
        raise FormatError(
            name, f"holds {what}, and a preview of it; expected a developed photograph",
            remedy="develop it to a linear TIFF of 16 bits",
        )  # fmt: skip
    full = [page for page, directory in enumerate(chain) if not _secondary(directory)]
    if not full and len(chain) == 1:
        full = [0]
    largest = max((math.prod(d.size) for d in inner if not _secondary(d)), default=0)
    if len(full) == 1 and largest <= math.prod(chain[full[0]].size):
        return full[0]
    listing = [f"{i}: {h} x {w}" for i, (h, w) in enumerate(d.size for d in (*chain, *inner))]
    raise FormatError(
        name,
        f"holds {len(listing)} pictures ({', '.join(listing[:8])}); expected one",
        remedy="save the one that is meant by itself",
    )


def _secondary(directory: Directory) -> bool:
    """Whether a directory says that it is a preview or a mask of another."""
    reduced = directory.number(_SUBFILE, 0) & _REDUCED_OR_MASK
    return bool(reduced) or directory.number(_OLD_SUBFILE, 1) == 2


def _samples(name: str, directory: Directory) -> tuple[int, bool]:
    """Bits of a sample as they are decoded, and whether they are floats."""
    bits, forms = set(directory.values(_BITS) or (1,)), set(directory.values(_FORMAT) or (_CODES,))
    if len(bits) > 1 or len(forms) > 1:
        raise FormatError(
            name, f"its samples have {sorted(bits)} bits and formats {sorted(forms)}; expected one"
        )
    stored, form = bits.pop(), forms.pop()
    if form == _CODES and stored in (1, 2, 4, 8):
        return 8, False
    if form == _CODES and stored in (10, 12, 14, 16):
        return 16, False
    if form == _FLOATS and stored == 64 and _TILE_WIDTH in directory:
        raise FormatError(
            name, "holds floats of 64 bits in tiles, which OpenImageIO takes for others",
            remedy="save it in strips, or as floats of 32 bits",
        )  # fmt: skip
    if form == _FLOATS and stored in (16, 32, 64):
        return int(stored), True
    kind = {_CODES: "whole numbers", _SIGNED: "signed numbers", _FLOATS: "floats"}.get(
        form, f"samples of format {form}"
    )
    raise FormatError(
        name, f"pixels are {kind} of {stored} bits; expected codes of 8 or 16 bits, or floats of "
        "16, 32 or 64", remedy="save it as one of these",
    )  # fmt: skip


def _channels(name: str, directory: Directory) -> tuple[int, bool, bool]:
    """Colours, whether alpha follows, and whether colours were multiplied by it."""
    photometric = directory.number(_PHOTOMETRIC, -1)
    colours = {_GREY_INVERTED: 1, _GREY: 1, _RGB: 3, _PALETTE: 1, _YCBCR: 3}.get(photometric)
    if colours is None:
        what = _OTHERS.get(photometric, f"photometric interpretation {photometric}")
        raise FormatError(name, f"holds {what}; expected grey or RGB", remedy="convert it to RGB")
    more = directory.number(_SAMPLES, 1) - colours
    roles = (*directory.values(_EXTRA), *[0] * 8)[: max(more, 0)]
    if more not in (0, 1) or (photometric == _PALETTE and more):
        raise FormatError(
            name,
            f"has {colours + more} samples a pixel, {max(more, 0)} of them beside "
            f"{'grey' if colours == 1 else 'RGB'}; expected at most alpha",
            remedy="save its colours alone, or an EXR with named channels",
        )
    return 3 if photometric == _PALETTE else colours, more == 1, roles == (1,)


def _check_stack(name: str, directory: Directory, values: int) -> None:
    """Refuse volumes that one directory stands for: their other pictures would be lost."""
    said = b"".join(directory.values(_DESCRIPTION)) if _DESCRIPTION in directory else b""
    shape, stack = _SHAPE.match(said), _IMAGEJ.search(said)
    planes = directory.number(_DEPTH, 1)
    if stack is not None:
        planes = max(planes, int(stack[1]))
    if shape is not None:
        planes = max(planes, math.prod(int(n) for n in shape[1].split(b",") if n.strip()) // values)
    if planes > 1:
        raise FormatError(
            name, f"holds a stack of {planes} pictures; expected one", remedy="save each by itself"
        )


def _check_strips(name: str, directory: Directory) -> None:
    """Refuse fewer strips than rows need: decoders leave the others as they please."""
    if fault := directory.fault_of_strips():
        raise FormatError(name, fault, remedy="copy it again")


def _declared(name: str, directory: Directory, colours: int) -> Declared | None:
    if _ICC in directory:
        profile = b"".join(
            part if isinstance(part, bytes) else bytes([part]) for part in directory.values(_ICC)
        )
        return icc.parse(name, profile, colours=colours)
    if _PRIMARIES not in directory or colours == 1:
        return None
    red_to_blue = directory.fractions(_PRIMARIES)
    white = directory.fractions(_WHITE) or list(D65)
    if len(red_to_blue) != 6 or len(white) != 2:
        raise ValueError("no chromaticities")
    values = (*red_to_blue, *white)
    chromaticities: Chromaticities = values  # type: ignore[assignment]
    return Declared("TIFF chromaticities", None, from_primaries(chromaticities))
