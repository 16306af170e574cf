"""What a SOURCE on the command line is: a BTF, a relief or a query file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from btfkit.btf import BTF
    from btfkit.materials.base import Material
    from btfkit.queries import QuerySet
    from btfkit.relief.relief import Relief


def read_source(path: Path) -> BTF | QuerySet | Relief:
    """Whatever a model can be fitted to or tested on."""
    import btfkit
    from btfkit.io import queryfile

    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder")
    if queryfile.detect(path) or path.suffix.lower() == ".npz":
        return queryfile.read(path)
    if path.suffix.lower() == ".exr":
        from btfkit.relief.file import read

        return read(path)
    return btfkit.open(path)


def material_of(path: Path) -> Material:
    """A model file's material, or a BTF as the material that interpolates it."""
    import btfkit

    if path.suffix == ".safetensors":
        return btfkit.load(path)
    from btfkit.materials.measured.interpolation import Interpolation

    return Interpolation.of(btfkit.open(path))
