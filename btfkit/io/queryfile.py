"""Query files: `.npz` of float32 arrays, never pickled."""

from __future__ import annotations

import json
import math
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit.errors import FormatError
from btfkit.files import whole
from btfkit.queries import QuerySet

_ARRAYS = ("uv", "light", "view", "footprint", "curvature", "rgb", "opacity", "weight")
# Queries hardly compress: a file that unpacks to gigabytes and 20 times its size is hostile.
_MOST_BYTES, _MOST_RATIO = 1 << 30, 20


def detect(path: Path) -> bool:
    """Whether `path` is an .npz with the arrays of a query file; reads names only."""
    if path.suffix.lower() != ".npz" or not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return {"uv.npy", "light.npy", "view.npy"} <= set(archive.namelist())


def read(path: Path) -> QuerySet:
    """The queries in a file, with the answers it holds.

    Raises:
        FileNotFoundError: there is no such file.
        FormatError: damaged, pickled, or arrays that do not fit each other.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            declared = sum(member.file_size for member in archive.infolist())
            if declared > max(_MOST_BYTES, _MOST_RATIO * path.stat().st_size):
                raise FormatError(path, f"says it unpacks to {declared} bytes")
            for member in archive.infolist():
                _check_member(path, archive, member)
        with np.load(path, allow_pickle=False) as file:
            found = {name: file[name] for name in file.files}
    except (FileNotFoundError, FormatError):
        raise
    except Exception as error:  # zipfile, zlib, and numpy's tokenizer of headers
        raise FormatError(
            path,
            f"not a readable query file ({str(error)[:200]})",
            remedy="write it with numpy.savez",
        ) from error
    missing = [name for name in ("uv", "light", "view") if name not in found]
    if missing:
        raise FormatError(path, f"no array {', '.join(missing)}; it has {', '.join(found)}")
    return _queries(path, found)


def _check_member(path: Path, archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> None:
    """FormatError for a member that numpy would take memory for before it finds it cut."""
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        header = np.lib.format.read_array_header_1_0
        if version != (1, 0):
            header = np.lib.format.read_array_header_2_0
        shape, _, dtype = header(file)
    # A side as well: of no values there may be two thousand million rows.
    size = max(math.prod(shape) * dtype.itemsize, *shape, 0)
    if size > member.file_size or min(shape, default=0) < 0:
        raise FormatError(path, f"{member.filename} says {shape} of {dtype}, and holds less")


def _queries(path: Path, found: dict[str, NDArray[Any]]) -> QuerySet:
    arrays: dict[str, Any] = {name: found[name] for name in _ARRAYS if name in found}
    wrong = [name for name, array in arrays.items() if array.dtype.kind not in "fiu"]
    if wrong:
        raise FormatError(path, f"{wrong[0]} is {arrays[wrong[0]].dtype}; expected float32")
    try:
        if "size" in found:
            h, w = (int(value) for value in found["size"].reshape(-1))
            arrays["size"] = (h, w)
        if "rgb" in arrays:
            arrays["channels"] = _channels(found, arrays["rgb"].shape[-1])
        if "provenance" in found:
            arrays["provenance"] = json.loads(str(found["provenance"]))
        return QuerySet(**arrays)
    except ValueError as error:
        raise FormatError(path, str(error)) from error
    except SystemError as error:
        # What numpy says of text that is no Unicode.
        raise FormatError(path, f"holds text that cannot be read ({error})") from error


def _channels(found: dict[str, NDArray[Any]], count: int) -> tuple[str, ...]:
    if "channels" in found:
        names = found["channels"]
        if names.shape != (count,):
            raise ValueError(f"channels of shape {names.shape} for rgb of {count}")
        return tuple(str(name) for name in names)
    return ("R", "G", "B") if count == 3 else tuple(f"C{index}" for index in range(count))


def write(queries: QuerySet, path: str | os.PathLike[str], *, force: bool = False) -> None:
    """Write a query file; it appears whole under its name or not at all.

    Raises:
        FileExistsError: `path` exists and `force` is False.
    """
    arrays = {name: getattr(queries, name) for name in _ARRAYS}
    given: dict[str, Any] = {name: value for name, value in arrays.items() if value is not None}
    if queries.size is not None:
        given["size"] = np.asarray(queries.size, np.int64)
    if queries.rgb is not None:
        given["channels"] = np.asarray(queries.channels)
    if queries.provenance:
        given["provenance"] = np.asarray(json.dumps(dict(queries.provenance)))
    with whole(path, force=force) as partial:
        np.savez(partial, **given)
