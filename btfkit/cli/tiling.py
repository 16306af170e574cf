"""What `btfkit tile` does with each kind of file: read, tile, write in the same kind."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from btfkit import io, sources
from btfkit.errors import BtfkitError, FormatError
from btfkit.files import refuse_existing, whole
from btfkit.io.store import reader
from btfkit.synthesis import Tiling

Progress = Callable[[int, int], None]
_KINDS = "an image, a BTF store (*.btf.zarr) or a NeuBTF model (*.safetensors)"


def tile_file(
    source: str | os.PathLike[str],
    out: str | os.PathLike[str] | None = None,
    *,
    drift: bool = True,
    force: bool = False,
    progress: Progress | None = None,
) -> tuple[Tiling, Path]:
    """Write the tileable version of a file in its own kind.

    Args:
        source: an image, a native store or a NeuBTF model.
        out: to write; None takes the name of `source` with .tile before its suffix, here.
        drift: whether what drifts across a picture or a store is taken away.
        force: whether an existing `out` is replaced.
        progress: called with (done, total).

    Returns:
        how it was made to tile, and the path written.

    Raises:
        FileNotFoundError: there is nothing at `source`.
        BtfkitError: another kind of file; the message says what to do with it.
        FormatError: damaged.
        FileExistsError: `out` exists and `force` is False.
    """
    path = Path(source)
    try:
        kind = sources.kind_of(path)
    except FormatError:
        kind = None
    store = kind == "btf" and reader.detect(path)
    final = refuse_existing(
        out if out is not None else tile_name(path), force=force, folder=store, store=store
    )
    if store:
        return _tile_store(path, final, drift, force, progress), final
    if kind == "model":
        return _tile_model(path, final, force), final
    if kind in ("picture", "relief"):
        return _tile_picture(path, final, drift, force), final
    raise _declined(path, kind)


def tile_name(source: Path) -> Path:
    """`brick.png` -> `brick.tile.png`, `a.btf.zarr` -> `a.tile.btf.zarr`, in this folder."""
    name = source.resolve().name
    for suffix in (".btf.zarr", ".neubtf.safetensors", ".safetensors", Path(name).suffix):
        if suffix and name.endswith(suffix):
            end = ".exr" if suffix.lower() == ".hdr" else suffix
            return Path(f"{name.removesuffix(suffix)}.tile{end}")
    return Path(f"{name}.tile")


def _declined(path: Path, kind: sources.Kind | None) -> BtfkitError:
    found, remedy = f"{path}: this {'folder' if path.is_dir() else 'file'}", None
    if kind == "btf":
        found = f"{path}: a BTF as {io.detect(path)}"
        remedy = f"make it a store first: btfkit ingest {path}"
    return BtfkitError(f"{found} cannot be tiled; expected {_KINDS}", remedy=remedy)


def _tile_store(
    path: Path, final: Path, drift: bool, force: bool, progress: Callable[[int, int], None] | None
) -> Tiling:
    from btfkit.io.store import writer
    from btfkit.synthesis import tile_btf

    btf = reader.read(path)
    textures = btf.textures
    dtype = str(textures.dtype) if isinstance(textures, reader.StoreTextures) else None
    tile, tiling = tile_btf(btf, drift=drift)
    try:
        writer.write(tile, final, dtype=dtype, force=force, progress=progress)
    except writer.HalfRangeError:
        # Taking drift away can lift a value over the end of float16.
        writer.write(tile, final, dtype="float32", force=force, progress=progress)
    return tiling


def _tile_model(path: Path, final: Path, force: bool) -> Tiling:
    from btfkit.materials import file
    from btfkit.materials.neubtf.material import NeuBTF
    from btfkit.materials.neubtf.paper import NeuBTFPaper
    from btfkit.synthesis import tile_neubtf

    material = file.load(path)
    if not isinstance(material, (NeuBTF, NeuBTFPaper)):
        raise BtfkitError(
            f"{path} is a {material.model} model; of models only a NeuBTF can be tiled",
            remedy="tile the BTF store that it was fitted to, and fit that",
        )
    tile, tiling = tile_neubtf(material)
    # Without the encoder: it reads guidance images as before, and stays with the model it is of.
    file.save(tile, final, force=force)
    return tiling


def _tile_picture(path: Path, final: Path, drift: bool, force: bool) -> Tiling:
    from btfkit.cli.pictures import WRITTEN, read_picture
    from btfkit.synthesis import tile_image

    if final.suffix.lower() not in WRITTEN:
        raise ValueError(f"{final}: pictures are written as {', '.join(WRITTEN)}")
    picture = read_picture(path)
    # Codes end at white; floats do not.
    peak = 1.0 if picture.depth.kind == "u" else None
    tile, tiling = tile_image(picture.linear, peak=peak, drift=drift)
    if tiling.drift is None and final.suffix.lower() == path.suffix.lower():
        # It tiles as it is: so do the bytes.
        with whole(final, force=force) as partial:
            partial.write_bytes(path.read_bytes())
        return tiling
    picture.tiled(tile, tiling.index).write(final, force=force)
    return tiling
