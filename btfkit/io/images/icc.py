"""ICC profiles: matrices with curves, and grey. Tables are refused by name.

Source: ICC.1:2010-12 (profile version 4.3), sections 7, 8.3, 8.4, 10.5, 10.15.
"""

from __future__ import annotations

import functools
import struct

import numpy as np
from numpy.typing import NDArray

from btfkit.errors import FormatError
from btfkit.io.images.profiles import Curve, Declared, Floats, from_d50, gamma

_MOST_BYTES, _MOST_TAGS = 1 << 24, 1000
_REMEDY = "convert it to sRGB or linear BT.709"
_SPACES = {b"RGB ": 3, b"GRAY": 1}
# Parameters of each kind of parametric curve.
_PARAMETERS = (1, 3, 4, 5, 7)


def parse(name: str, profile: bytes, *, colours: int) -> Declared:
    """What a profile says of a picture's numbers.

    Args:
        name: of the picture, for messages.
        profile: as embedded.
        colours: of the picture: 1, 3, or 4 for inks.

    Raises:
        FormatError: damaged, for other colours, or a kind that is not understood.
    """
    try:
        declared, channels = _parsed(profile)
    except (struct.error, ValueError, IndexError, UnicodeDecodeError) as error:
        said = str(error) if isinstance(error, _NotUnderstoodError) else "damaged"
        raise FormatError(name, f"its ICC profile is {said}", remedy=_REMEDY) from error
    if channels != colours and not (colours == 1 and _neutral(declared)):
        raise FormatError(
            name, f"{declared.name} is for {channels} channels, the image has {colours}",
            remedy=_REMEDY,
        )  # fmt: skip
    if colours == 1 and channels == 3:
        # Grey through equal curves stays on the axis from black to white.
        curves = (declared.curves or ())[:1]
        return Declared(declared.name, curves, None, declared.profile)
    return declared


class _NotUnderstoodError(ValueError):
    """A profile that is whole and of a kind that is not read."""


@functools.lru_cache(maxsize=64)
def _parsed(profile: bytes) -> tuple[Declared, int]:
    if profile[36:40] != b"acsp" or len(profile) > _MOST_BYTES:
        raise ValueError
    tags = _tags(profile)
    label = f"ICC profile {_label(tags.get(b'desc', b''))!r}"
    space = profile[16:20]
    if space not in _SPACES:
        raise _NotUnderstoodError(
            f"for {space.decode('latin-1').strip()}; expected RGB or grey with matrix and curves"
        )
    if space == b"GRAY":
        if b"kTRC" not in tags:
            raise _NotUnderstoodError(f"{label[12:]}, grey without a curve; expected one")
        return Declared(label, (_curve(tags[b"kTRC"]),), None, profile), 1
    missing = {b"rXYZ", b"gXYZ", b"bXYZ", b"rTRC", b"gTRC", b"bTRC"} - tags.keys()
    if missing:
        kind = "a table of colours" if b"A2B0" in tags else "without matrix and curves"
        raise _NotUnderstoodError(f"{label[12:]}, {kind}; expected matrix and curves")
    columns = np.column_stack([_xyz(tags[key]) for key in (b"rXYZ", b"gXYZ", b"bXYZ")])
    if abs(np.linalg.det(columns)) < 1e-6:
        raise ValueError
    curves = tuple(_curve(tags[key]) for key in (b"rTRC", b"gTRC", b"bTRC"))
    if tags[b"rTRC"] == tags[b"gTRC"] == tags[b"bTRC"]:
        curves = curves[:1]
    return Declared(label, curves, from_d50(columns), profile), 3


def _tags(profile: bytes) -> dict[bytes, bytes]:
    (count,) = struct.unpack_from(">I", profile, 128)
    if count > _MOST_TAGS:
        raise ValueError
    tags = {}
    for i in range(count):
        key, at, size = struct.unpack_from(">4sII", profile, 132 + 12 * i)
        if at + size > len(profile):
            raise ValueError
        tags[key] = profile[at : at + size]
    return tags


def _xyz(tag: bytes) -> NDArray[np.float64]:
    if tag[:4] != b"XYZ ":
        raise ValueError
    return np.array(struct.unpack_from(">3i", tag, 8)) / 65536


def _curve(tag: bytes) -> Curve:
    kind, count = tag[:4], struct.unpack_from(">I", tag, 8)[0]
    if kind == b"curv":
        if count == 0:
            return gamma(1.0)
        if count == 1:
            return gamma(struct.unpack_from(">H", tag, 12)[0] / 256)
        table = np.frombuffer(tag, ">u2", count, 12) / 65535
        return lambda x: np.interp(x, np.linspace(0, 1, count), table)
    if kind == b"para":
        form = struct.unpack_from(">H", tag, 8)[0]
        if form >= len(_PARAMETERS):
            raise _NotUnderstoodError(f"with a parametric curve of kind {form}; expected 0 to 4")
        given = struct.unpack_from(f">{_PARAMETERS[form]}i", tag, 12)
        return _parametric(form, [value / 65536 for value in given])
    raise _NotUnderstoodError(f"with a curve of type {kind!r}; expected curv or para")


def _parametric(form: int, given: list[float]) -> Curve:
    """ICC.1, table 65: y = (a x + b)^g + e from d on, c x + f below it."""
    g, a, b, c, d, e, f = [*given, *[0.0] * (7 - len(given))]
    if form == 0:
        return gamma(g)
    if form in (1, 2):
        # Both start where a x + b is 0; kind 2 adds its fourth number everywhere.
        c, d, e, f = 0.0, -b / a if a else 0.0, c if form == 2 else 0.0, c if form == 2 else 0.0

    def curve(x: Floats) -> Floats:
        power = np.maximum(a * x + b, 0) ** g + e
        return np.where(x >= d, power, c * x + f)

    return curve


def _neutral(declared: Declared) -> bool:
    return declared.curves is not None and len(declared.curves) == 1


def _label(tag: bytes) -> str:
    """The name of a profile: a text of version 2, or the first of version 4's."""
    if tag[:4] == b"desc" and len(tag) >= 12:
        (size,) = struct.unpack_from(">I", tag, 8)
        return tag[12 : 12 + min(size, 80)].split(b"\0")[0].decode("latin-1")
    if tag[:4] == b"mluc" and len(tag) >= 28:
        size, at = struct.unpack_from(">II", tag, 20)
        return tag[at : at + min(size, 160)].decode("utf-16-be", "replace")
    return "without a name"
