"""Readers and writers, one module a format, and the native store.

A reader is a module with two functions: `detect(path) -> bool`, which reads no more than
names and magics, and `read(path, *, ...) -> BTF`, whose textures are decoded when asked for.
"""

from __future__ import annotations

import importlib
import inspect
import os
from pathlib import Path
from types import ModuleType
from typing import Any

from btfkit.btf import BTF
from btfkit.errors import FormatError, unknown
from btfkit.remote import Remote, located
from btfkit.sequence import refuse_unended

# The order is the order of detection: the more specific first.
FORMATS: dict[str, str] = {
    "zarr": "btfkit.io.store.reader",
    "sequence": "btfkit.calibration.captured",
    "axf": "btfkit.io.axf",
    "manifest": "btfkit.io.manifest.reader",
    "spectral": "btfkit.io.spectral",
    "ubo2003": "btfkit.io.ubo2003",
    "utia": "btfkit.io.utia",
    "materialgan": "btfkit.io.materialgan",
    "diligent": "btfkit.io.diligent",
    "lp": "btfkit.io.lp",
    "merl": "btfkit.io.merl",
    "rgl": "btfkit.io.rgl",
    "bonn": "btfkit.io.bonn.reader",
    "utia_brdf": "btfkit.io.utia_brdf",
    "hdf5": "btfkit.io.hdf5",
    "ptm": "btfkit.io.ptm",
    "hsh": "btfkit.io.hsh",
    "bme": "btfkit.io.bme",
}


def format_module(name: str) -> ModuleType:
    """The reader module of a format name; ValueError lists the names there are."""
    if name not in FORMATS:
        raise ValueError(unknown("format", name, FORMATS))
    return importlib.import_module(FORMATS[name])


def detect(path: str | os.PathLike[str] | Remote) -> str:
    """Name of the format that a path looks like.

    Raises:
        FileNotFoundError: there is nothing at `path`.
        FormatError: no reader knows it; the message lists the formats.
    """
    source = located(path)
    if isinstance(source, Remote):
        return _remote(source)
    if not source.exists():
        raise FileNotFoundError(f"{source}: no such file or folder")
    if not (source.is_dir() or source.is_file()):
        # A pipe or a device: who reads it may wait for ever.
        raise FormatError(source, "is neither a file nor a folder")
    for name in FORMATS:
        if format_module(name).detect(source):
            return name
    if source.is_dir() and not any(source.iterdir()):
        raise FormatError(source, "the folder is empty")
    refuse_unended(source)
    what = f"no reader knows this {'folder' if source.is_dir() else 'file'}"
    remedy = f"formats are {', '.join(FORMATS)}; btfkit ingest --format names one"
    photographs = _photographs(source)
    if photographs:
        what += f" of {photographs} pictures: nothing says where light and view were"
        remedy += (
            "; write a manifest.csv (file, light and view angles: docs/formats.md, pose manifests) "
            "or, of one view, an RTI .lp beside them"
        )
    if away := _links_away(source):
        what += f"; {away[0]} is a link that leaves the folder, and is not followed"
        remedy = f"put what it leads to in its place, or name that itself; {remedy}"
    raise FormatError(source, what, remedy=remedy)


def _remote(source: Remote) -> str:
    """The one format that is read from an object store."""
    if not source.exists("zarr.json"):
        raise FileNotFoundError(f"{source}: there is no Zarr group")
    from btfkit.io.store.reader import is_store

    if not is_store(source):
        raise FormatError(
            str(source), "no store of btfkit, or one that is not finished",
            remedy="other formats are read from disk: fetch it first",
        )  # fmt: skip
    return "zarr"


def _links_away(source: Path) -> list[str]:
    """Names in a folder that are links to somewhere outside of it."""
    if not source.is_dir():
        return []
    home = source.resolve()
    links = sorted(path for path in source.iterdir() if path.is_symlink())
    return [path.name for path in links if not path.resolve().is_relative_to(home)]


def _photographs(source: Path) -> int:
    """How many pictures lie in a folder, and in no folder of it."""
    from btfkit.io.images import is_image

    if not source.is_dir():
        return 0
    return sum(is_image(path.name) and path.is_file() for path in source.iterdir())


def options_of(name: str) -> tuple[str, ...]:
    """The keyword options that the reader of a format takes."""
    parameters = inspect.signature(format_module(name).read).parameters.values()
    return tuple(p.name for p in parameters if p.kind is p.KEYWORD_ONLY)


def open(
    path: str | os.PathLike[str] | Remote, *, format: str | None = None, **options: Any
) -> BTF:
    """A BTF from anything readable; textures are decoded when they are asked for.

    Args:
        path: store, folder, zip, manifest or file; or the URL of a store (s3://...).
        format: a name of `FORMATS`, where detection should not decide.
        **options: what the format leaves open, as its reader names them.

    Raises:
        FileNotFoundError: there is nothing at `path`.
        FormatError: damaged, or no reader knows it.
        ValueError: an option that the format does not have.
    """
    where = located(path)
    name = detect(where) if isinstance(where, Remote) or not format else format
    if format and name != format:
        raise ValueError(f"{where} is read as a native store alone, not as {format}")
    module = format_module(name)
    given = {key: value for key, value in options.items() if value is not None}
    unknown = sorted(given.keys() - set(options_of(name)))
    if unknown:
        known = ", ".join(options_of(name)) or "none"
        raise ValueError(f"format {name} has no option {', '.join(unknown)}; it has {known}")
    btf: BTF = module.read(where, **given)
    return btf
