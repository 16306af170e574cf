"""From any readable source to one native store, with a record of where it came from."""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import platform
import shutil
import tempfile
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, final

from btfkit import io
from btfkit.btf import BTF
from btfkit.errors import FormatError
from btfkit.files import refuse_existing
from btfkit.io import listing
from btfkit.io.store import reader as store
from btfkit.io.store import writer
from btfkit.io.store.places import place_of
from btfkit.jsonvalues import plain
from btfkit.remote import Location, Remote, located

# Files up to this size are hashed whole; of larger ones the two ends and the size.
_HASH_WHOLE = 1 << 30


@final
@dataclass(frozen=True)
class Part:
    """Which part of a source is read; nothing else is decoded.

    Attributes:
        rows, cols: window in texels.
        lights, views: over the distinct directions in the order of first appearance.
    """

    rows: slice = field(default_factory=lambda: slice(None))
    cols: slice = field(default_factory=lambda: slice(None))
    lights: slice = field(default_factory=lambda: slice(None))
    views: slice = field(default_factory=lambda: slice(None))

    def of(self, btf: BTF) -> BTF:
        """This part of `btf`, lazily."""
        if self.lights != slice(None) or self.views != slice(None):
            btf = btf.select(lights=self.lights, views=self.views)
        return btf.crop(self.rows, self.cols)


# What a source's name loses.
_SUFFIXES = (
    ".btf.zarr", ".btf", ".zip", ".json", ".csv", ".lp", ".bin", ".binary", ".hdf5", ".h5",
)  # fmt: skip


def store_name(source: str | os.PathLike[str] | Remote) -> Path:
    """The store that a source becomes by default: `folder` -> `folder.btf.zarr`, here."""
    where = located(source)
    name = where.resolve().name if isinstance(where, Path) else where.name
    for suffix in _SUFFIXES:
        if name.lower().endswith(suffix) and len(name) > len(suffix):
            name = name[: -len(suffix)]
            break
    return Path(f"{name}.btf.zarr")


def ingest(
    source: str | os.PathLike[str] | Remote,
    out: str | os.PathLike[str] | Remote | None = None,
    *,
    format: str | None = None,
    options: Mapping[str, Any] | None = None,
    part: Part | None = None,
    dtype: str | None = None,
    jobs: int | None = None,
    force: bool = False,
    progress: Callable[[int, int], None] | None = None,
    phase: Callable[[str], None] | None = None,
) -> Location:
    """Read a source in any known format and write a native store.

    Args:
        source: folder, zip, file or manifest.
        out: the store, a path or a URL that fsspec knows; None takes `store_name(source)`.
        format: a name of `io.FORMATS`; None detects it.
        options: what the format leaves open, as its reader names it; None values are left out.
        part: which part is read.
        dtype: as in `io.store.writer.write`, as are the next three.
        jobs: threads.
        force: whether an existing store is replaced.
        progress: called with the textures written and all.
        phase: called with the name of each part as it begins: opening, hashing, reading and
            writing (each texture is decoded once and written at once).

    Returns:
        The path, or URL, of the store.

    Raises:
        FormatError: damaged or unknown source.
        FileExistsError: `out` exists and `force` is False.
    """
    final = located(out) if out is not None else store_name(source)
    where = located(source)
    here = isinstance(final, Path) and isinstance(where, Path)
    if here and final.exists() and where.exists() and os.path.samefile(str(final), str(where)):
        raise ValueError(f"{final} is the source itself; name another store to write")
    # Before anything is read; the writer looks again.
    place_of(final, force=force)
    record = recorded(source, format=format, options=options, part=part, phase=phase)
    if phase:
        phase("reading and writing")
    writer.write(record, final, dtype=dtype, jobs=jobs, force=force, progress=progress)
    return checked(final, source, record.shape)


def ingest_on_found_relief(
    source: str | os.PathLike[str] | Remote,
    out: str | os.PathLike[str] | Remote | None = None,
    *,
    options: Mapping[str, Any] | None = None,
    part: Part | None = None,
    seed: int = 0,
    phase: Callable[[str], None] | None = None,
    progress: Callable[[int, int], None] | None = None,
    **writing: Any,
) -> tuple[Location, Path]:
    """A sequence twice: the relief that the first store implies registers the views of the second.

    Relief moves texels of tilted views against each other as a shift would; on the relief they are
    compared without parallax. Views of the first are registered as they are: what that takes out
    is the parallax of the mean height, which a relief does not have.

    Args:
        source, out, part, writing: as `ingest`'s.
        options: as `ingest`'s, without `relief`. seed: of the fit of the relief.
        phase, progress: as `ingest`'s.

    Returns:
        The store, and the relief file beside it.

    Raises:
        BtfkitError: as `ingest` and `find_relief`; what is no sequence has no relief to find.
    """
    from btfkit.fitting.heightfield import find_relief
    from btfkit.relief import file as relief_file

    final = located(out) if out is not None else store_name(source)
    force = bool(writing.get("force", False))
    name = (writing.pop("format", None)) or io.detect(source)
    if name != "sequence" or not isinstance(final, Path):
        raise ValueError(
            f"--relief auto: {source} is read as {name} into {final}; it takes a sequence "
            "of frames and a store on this machine"
        )
    told = phase or (lambda part: None)
    relief = refuse_existing(final.with_name(f"{final.name.removesuffix('.btf.zarr')}.relief.exr"),
                             force=force)  # fmt: skip
    given = {**(options or {}), "register": True}
    place_of(final, force=force)
    with tempfile.TemporaryDirectory(dir=final.absolute().parent, prefix=".first-") as folder:
        first = Path(folder) / "first.btf.zarr"
        ingest(source, first, format=name, options=given, part=part, phase=phase,
               progress=progress, **{**writing, "force": False})  # fmt: skip
        told("finding the relief")
        found = find_relief(io.open(first), seed=seed, progress=progress).relief
        relief_file.write(found.of_three(), relief, unit="mm", force=force)
    given["relief"] = relief
    return ingest(source, final, format=name, options=given, part=part, phase=phase,
                  progress=progress, **writing), relief  # fmt: skip


def recorded(
    source: str | os.PathLike[str] | Remote,
    *,
    format: str | None = None,
    options: Mapping[str, Any] | None = None,
    part: Part | None = None,
    phase: Callable[[str], None] | None = None,
) -> BTF:
    """The BTF of a source with the record of where it came from; no texture is decoded yet.

    Warns of a source without a light above the surface, and of a window beyond its textures.

    Args and errors: as of `ingest`.
    """
    told = phase or (lambda name: None)
    told("opening")
    name = format or io.detect(source)
    given = {key: value for key, value in (options or {}).items() if value is not None}
    settled = {"texel_mm": given.pop("texel_mm")} if _outside(name, given, "texel_mm") else {}
    btf = replace(io.open(source, format=name, **given), **settled)
    taken = part or Part()
    _warn_of_lights_below(source, btf)
    whole, btf = btf, taken.of(btf)
    _warn_of_cut_window(source, taken, whole)
    told("hashing")
    provenance = {
        **btf.provenance,
        "source": str(source),
        "format": name,
        "hash": source_hash(located(source)),
        "options": plain({**given, **settled, **_part_record(taken)}),
        "versions": {
            "btfkit": importlib.metadata.version("btfkit"),
            "python": platform.python_version(),
        },
    }
    return replace(btf, provenance=provenance, history=(*btf.history, f"ingested from {name}"))


def checked(
    final: Location, source: str | os.PathLike[str] | Remote, shape: tuple[int, int, int, int]
) -> Location:
    """A store that was just written, once it holds a finite texel; warns of masked ones.

    Raises:
        FormatError: it holds none, and is removed.
    """
    masked = store.masked_texels(final)
    n, h, w, _ = shape
    if masked == n * h * w:
        if isinstance(final, Path):
            shutil.rmtree(final)
        else:
            final.remove()
        raise FormatError(
            str(source), f"none of {masked} texels is finite", remedy="look at its images"
        )
    if masked:
        warnings.warn(
            f"{source}: {masked} of {n * h * w} texels are not finite; they are masked",
            stacklevel=2,
        )
    return final


def source_hash(source: Location) -> dict[str, Any]:
    """SHA-256 that tells a source from another, and what it was taken of.

    A file is hashed whole up to 1 GiB, beyond that by its ends and size; a folder by the names and
    sizes of its files, without hidden ones and stores: the output may grow in it; a remote store by
    what its attributes say.
    """
    digest = hashlib.sha256()
    if isinstance(source, Remote):
        digest.update(source.read("zarr.json"))
        return {"sha256": digest.hexdigest(), "of": "attributes"}
    if source.is_dir():
        files = sorted(listing.names_of(source))
        for name in files:
            entry = f"{name}\0{(source / name).stat().st_size}\n"
            digest.update(entry.encode("utf-8", "surrogateescape"))
        return {"sha256": digest.hexdigest(), "of": "names and sizes", "files": len(files)}
    size = source.stat().st_size
    with source.open("rb") as file:
        if size <= _HASH_WHOLE:
            for block in iter(lambda: file.read(1 << 20), b""):
                digest.update(block)
            return {"sha256": digest.hexdigest(), "of": "contents", "bytes": size}
        digest.update(file.read(1 << 26))
        file.seek(-(1 << 26), os.SEEK_END)
        digest.update(file.read())
        digest.update(str(size).encode())
    return {"sha256": digest.hexdigest(), "of": "first and last 64 MiB, size", "bytes": size}


def _warn_of_lights_below(source: str | os.PathLike[str] | Remote, btf: BTF) -> None:
    if not (btf.light[:, 2] > 0).any():
        warnings.warn(
            f"{source}: none of {len(btf)} pairs is lit from above the horizon (z > 0); z points "
            "away from the surface and directions towards the light: check their signs",
            stacklevel=3,
        )


def _warn_of_cut_window(source: str | os.PathLike[str] | Remote, part: Part, whole: BTF) -> None:
    _, h, w, _ = whole.shape
    for name, asked, size in (("rows", part.rows, h), ("columns", part.cols, w)):
        if asked.stop is not None and asked.stop > size:
            start, stop, _ = asked.indices(size)
            warnings.warn(
                f"{source}: {name} {start}:{asked.stop} of a {h} x {w} texture are cut to "
                f"{start}:{stop}",
                stacklevel=3,
            )


def _outside(format: str, given: Mapping[str, Any], option: str) -> bool:
    """Whether an option is given that every BTF has and this format's reader does not take."""
    return option in given and option not in io.options_of(format)


def _part_record(part: Part) -> dict[str, list[int | None]]:
    slices = {"rows": part.rows, "cols": part.cols, "lights": part.lights, "views": part.views}
    return {
        name: [chosen.start, chosen.stop, chosen.step]
        for name, chosen in slices.items()
        if chosen != slice(None)
    }
