r"""Files of named arrays ("tensor_file") as the RGL material database keeps its BRDFs in.

    "tensor_file\0", u8 1, u8 0, u32 number of fields; of each field u16 length of its name, name,
    u16 axes, u8 kind, u64 offset from the start of the file, u64 of each axis; arrays, in C order

Little-endian. Source: Dupuy and Jakob, "An Adaptive Parameterization for Efficient Material
Acquisition and Rendering", 2018, and the reader that comes with its database.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit.errors import FormatError

MAGIC = b"tensor_file\0"
_VERSION = (1, 0)
_KINDS = {
    1: "u1", 2: "i1", 3: "<u2", 4: "<i2", 5: "<u4", 6: "<i4", 7: "<u8", 8: "<i8",
    9: "<f2", 10: "<f4", 11: "<f8",
}  # fmt: skip
_MOST_FIELDS, _MOST_AXES = 256, 16


def read(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of a file by name, mapped, not read.

    Raises:
        FormatError: no such file, of another version, or an array outside of it.
    """
    size = path.stat().st_size
    with path.open("rb") as file:

        def taken(form: str) -> tuple[Any, ...]:
            data = file.read(struct.calcsize(form))
            if len(data) < struct.calcsize(form):
                raise FormatError(path, f"ends within its header, at {size} bytes",
                                  remedy="copy it again")  # fmt: skip
            return struct.unpack(form, data)

        if file.read(len(MAGIC)) != MAGIC:
            raise FormatError(path, "is no tensor file: it does not begin with tensor_file")
        version = taken("<BB")
        if version != _VERSION:
            raise FormatError(
                path, f"tensor file of version {version[0]}.{version[1]}; expected 1.0"
            )
        (count,) = taken("<I")
        if not 0 < count <= _MOST_FIELDS:
            raise FormatError(path, f"{count} fields; expected 1 to {_MOST_FIELDS}")
        heads = []
        for _ in range(count):
            (length,) = taken("<H")
            name = file.read(length).decode("utf-8", "replace")
            axes, kind, offset = taken("<HBQ")
            if axes > _MOST_AXES or kind not in _KINDS:
                raise FormatError(
                    path, f"field {name!r} has {axes} axes of kind {kind}; expected up to "
                    f"{_MOST_AXES} of kinds 1 to 11",
                )  # fmt: skip
            heads.append((name, kind, offset, taken(f"<{axes}Q")))
        after = file.tell()
    found: dict[str, NDArray[Any]] = {}
    for name, kind, offset, shape in heads:
        dtype = np.dtype(_KINDS[kind])
        number = math.prod(shape)
        if name in found:
            raise FormatError(path, f"field {name!r} is there twice")
        if number < 1 or offset < after or offset + number * dtype.itemsize > size:
            raise FormatError(
                path, f"field {name!r} of shape {shape} does not lie in its {size} bytes",
                remedy="copy it again",
            )  # fmt: skip
        found[name] = np.memmap(path, dtype, "r", offset, tuple(shape))
    return found


def packed(fields: Mapping[str, NDArray[Any]]) -> bytes:
    """The bytes of a file with these arrays."""
    kinds = {np.dtype(form): kind for kind, form in _KINDS.items()}
    arrays = {name: np.ascontiguousarray(array) for name, array in fields.items()}
    length = len(MAGIC) + 6
    length += sum(2 + len(n.encode()) + 11 + 8 * a.ndim for n, a in arrays.items())
    head = MAGIC + struct.pack("<BBI", *_VERSION, len(arrays))
    body = b""
    for name, array in arrays.items():
        padding = -(length + len(body)) % 8
        body += bytes(padding)
        head += struct.pack("<H", len(name.encode())) + name.encode()
        head += struct.pack("<HBQ", array.ndim, kinds[array.dtype], length + len(body))
        head += struct.pack(f"<{array.ndim}Q", *array.shape)
        body += array.tobytes()
    return head + body
