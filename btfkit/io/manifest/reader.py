"""Pose manifests: any images, and a JSON or CSV file that says how each was lit and seen.

    {"version": 1, "units": "mm", "texel_mm": 0.1,
     "images": [{"file": "a.exr", "light": {"dir": [0, 0, 1]}, "view": {"pos": [0, 0, 900]}}]}

    file,tl,pl,tv,pv
    a.png,30,90,0,0

No standard exists; this one is described in docs/formats.md.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from btfkit.btf import BTF, QUANTITY
from btfkit.errors import FormatError
from btfkit.files import whole_folder
from btfkit.io import archive as archives
from btfkit.io import images, listing
from btfkit.io.archive import Archive
from btfkit.io.manifest import assembly, poses
from btfkit.textures import Array, as_textures

NAMES = ("manifest.json", "manifest.csv")


def detect(path: Path) -> bool:
    """Whether it is a manifest, or a folder or zip with a manifest.json or manifest.csv."""
    if path.is_file() and path.suffix.lower() == ".json":
        with path.open("rb") as file:
            start = file.read(archives.MOST_TEXT)
            return start.lstrip()[:1] == b"{" and b'"images"' in start
    if path.is_file() and path.suffix.lower() == ".csv":
        with path.open("rb") as file:
            start = file.read(4096)
        try:
            return bool(poses.csv_columns(listing.decoded(start, "replace")))
        except ValueError:
            return False
    names = listing.names_of(path)
    return any(listing.folder_with(names, name) is not None for name in NAMES)


def read(
    path: Path,
    *,
    transfer: str | None = None,
    cosine: str | None = None,
    texel_mm: float | None = None,
) -> BTF:
    """The BTF that a manifest describes; textures are decoded when they are asked for.

    Args:
        path: manifest file beside its images, or a folder or zip with one.
        transfer: of 8- and 16-bit images, before what the manifest says; sRGB is assumed.
        cosine: "in" or "out", before what the manifest says; "in" is assumed.
        texel_mm: before what the manifest says.

    Raises:
        FormatError: damaged, a pair twice, a file outside the folder, or none there.
    """
    holder, file = _found(path)
    text = holder.text(file)
    base = str(PurePosixPath(file).parent)
    head: dict[str, Any] = {}
    if file.lower().endswith(".csv"):
        entries = poses.from_csv(str(path), text)
    else:
        head, entries = poses.from_json(str(path), text)
    return assembly.assemble(
        path,
        holder,
        base,
        assembly.Head.of(
            path, head, {"transfer": transfer, "cosine": cosine, "texel_mm": texel_mm}
        ),
        entries,
    )


def write(
    btf: BTF,
    path: str | os.PathLike[str],
    *,
    dtype: str = "float32",
    force: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write a folder of EXRs and a manifest.json that `read` turns into the same BTF.

    Args:
        btf: any; what is not valid or not measured becomes NaN.
        path: folder to write.
        dtype: of the pixels: "float32" (lossless) or "float16".
        force: whether an existing folder is replaced.
        progress: called with (images written, n).

    Raises:
        ValueError: no such dtype, a value beyond float16, or channel names that an EXR cannot have.
    """
    if dtype not in ("float32", "float16"):
        raise ValueError(f"dtype {dtype!r}; expected float32 or float16")
    if len(set(btf.channels)) < len(btf.channels) or not all(btf.channels):
        raise ValueError(f"channels {btf.channels}; an EXR needs a name of its own for each")
    variance = None if btf.variance is None else as_textures(btf.variance)
    entries = []
    with whole_folder(path, force=force) as folder:
        (folder / "images").mkdir()
        if variance is not None:
            (folder / "variance").mkdir()
        for pair in range(len(btf)):
            entry = _entry(btf, pair)
            _write_pixels(folder / entry["file"], btf.texture(pair), btf, dtype)
            if variance is not None:
                entry["variance"] = f"variance/{pair:05d}.exr"
                _write_pixels(folder / entry["variance"], variance[pair], btf, "float32")
            entries.append(entry)
            if progress:
                progress(pair + 1, len(btf))
        text = json.dumps({**_head(btf), "images": entries}, indent=1, allow_nan=False)
        (folder / NAMES[0]).write_text(text, encoding="utf-8")


def _head(btf: BTF) -> dict[str, Any]:
    return {
        "version": 1,
        "units": "mm",
        "frame": "surface",
        "quantity": QUANTITY,
        "cosine": "in",
        "channels": list(btf.channels),
        "colour": btf.colour,
        "texel_mm": btf.texel_mm,
        "wrap": btf.wrap,
        "licence": btf.licence,
        "provenance": dict(btf.provenance),
        "history": list(btf.history),
    }


def _entry(btf: BTF, pair: int) -> dict[str, Any]:
    entry: dict[str, Any] = {"file": f"images/{pair:05d}.exr"}
    for name, to, at in (
        ("light", btf.light, btf.light_position),
        ("view", btf.view, btf.view_position),
    ):
        entry[name] = {"dir": to[pair].tolist()}
        if at is not None:
            entry[name]["pos"] = at[pair].tolist()
    if btf.footprint is not None:
        entry["footprint"] = float(btf.footprint[pair])
    return entry


def _write_pixels(file: Path, texture: Array, btf: BTF, dtype: str) -> None:
    if dtype == "float16" and np.nanmax(np.abs(texture), initial=0) > np.finfo(np.float16).max:
        raise ValueError(f"{file.name} has values beyond 65504; dtype float32 keeps them")
    images.write_exr(file, texture.astype(dtype), btf.channels)


def _found(path: Path) -> tuple[Archive, str]:
    """The archive and the manifest member in it."""
    if path.is_file() and path.suffix.lower() in (".json", ".csv"):
        return Archive(path.parent), path.name
    holder = Archive(path)
    for name in NAMES:
        base = listing.folder_with(holder.names, name)
        if base is not None:
            return holder, str(PurePosixPath(base) / name)
    raise FormatError(path, f"holds no {' or '.join(NAMES)}")
