"""What a path is, in one table: a model, queries, a relief, a picture, or a BTF in any format."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from btfkit import io
from btfkit.btf import BTF
from btfkit.errors import FormatError
from btfkit.io import images
from btfkit.remote import Location

if TYPE_CHECKING:
    from btfkit.materials.base import Material
    from btfkit.queries import QuerySet
    from btfkit.relief.relief import Relief

Kind = Literal["model", "queries", "relief", "picture", "btf"]
# The files that their suffix tells; any other file or folder is a BTF if a reader knows it.
_BY_SUFFIX: dict[str, Kind] = {
    ".safetensors": "model",
    ".npz": "queries",
    ".exr": "relief",
    **dict.fromkeys(images.SUFFIXES - {".exr"}, "picture"),
}
_READERS: dict[Kind, str] = {
    "model": "btfkit.materials.file:load",
    "queries": "btfkit.io.queryfile:read",
    "relief": "btfkit.relief.file:read",
    "btf": "btfkit.io:open",
}
_NAMES: dict[Kind, str] = {
    "model": "a fitted model",
    "queries": "a query file",
    "relief": "a relief",
    "picture": "a picture",
    "btf": "a BTF",
}


def kind_of(path: Location) -> Kind:
    """What a path is; of a BTF, `io.detect` tells the format.

    An EXR is a relief here: where a picture is asked for, it is one too.

    Raises:
        FileNotFoundError: there is nothing at `path`.
        FormatError: nothing that any reader knows.
    """
    if not isinstance(path, Path):
        io.detect(path)
        return "btf"
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder")
    kind = _BY_SUFFIX.get(path.suffix.lower()) if path.is_file() else None
    if kind is None:
        io.detect(path)
        return "btf"
    return kind


def read(path: Location) -> BTF | QuerySet | Relief | Material:
    """What lies at a path; textures are decoded when they are asked for.

    Raises:
        FileNotFoundError: there is nothing at `path`.
        FormatError: damaged, a picture, or nothing that any reader knows.
    """
    kind = kind_of(path)
    if kind not in _READERS:
        raise FormatError(str(path), f"is {_NAMES[kind]}; expected {_listed(*_READERS)}")
    module, function = _READERS[kind].split(":")
    found: BTF | QuerySet | Relief | Material
    found = getattr(importlib.import_module(module), function)(path)
    return found


def measured(path: Location) -> BTF | QuerySet | Relief:
    """Whatever a model can be fitted to or tested on.

    Raises:
        FileNotFoundError, FormatError: as `read`; a model is refused too.
    """
    from btfkit.materials.base import Material

    found = read(path)
    if isinstance(found, Material):
        expected = _listed("btf", "queries", "relief")
        raise FormatError(str(path), f"is {_NAMES['model']}; expected {expected}")
    return found


def material(path: Location, *, curved: bool = False) -> Material:
    """What answers queries: a model, a BTF interpolated, a relief traced.

    Args:
        path: of the model, BTF or relief.
        curved: whether it will lie on a shape, of which a relief, and the relief of a model with
            outlines, must not jut out.

    Raises:
        FileNotFoundError, FormatError: as `read`; queries are refused too.
    """
    from btfkit.materials.base import Material
    from btfkit.relief.relief import Relief

    found = read(path)
    if isinstance(found, Material):
        return _under_surface(found) if curved else found
    if isinstance(found, BTF):
        from btfkit.materials.measured.interpolation import Interpolation

        return Interpolation.of(found)
    if isinstance(found, Relief):
        from btfkit.relief.material import TracedRelief

        return TracedRelief(found.under_surface()[0] if curved else found)
    expected = _listed("model", "btf", "relief")
    raise FormatError(str(path), f"is {_NAMES['queries']}; expected {expected}")


def _under_surface(model: Material) -> Material:
    from btfkit.materials.sbtf.material import SBTF

    if isinstance(model, SBTF) and model.stands_above:
        return model.under_surface()[0]
    return model


def _listed(*kinds: Kind) -> str:
    *first, last = [_NAMES[kind] for kind in kinds]
    return f"{', '.join(first)} or {last}"
