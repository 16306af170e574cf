"""Material files: safetensors whose header says what the numbers mean."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from btfkit.coverage import Coverage
from btfkit.errors import FormatError
from btfkit.files import whole
from btfkit.jsonvalues import tuples
from btfkit.materials import MODELS, material_class, present_name
from btfkit.materials.base import Header, Material
from btfkit.materials.lobes import LobeTable

VERSION = 1
# Arrays that only the fitting side reads (a NeuBTF's encoder) carry this prefix.
TRAINING = "training."
# The finest level of the sampling lobes, (h, w, 5) float16, where they were stored.
LOBES = "lobes.table"
# Which lights and views were measured.
COVERAGE = "coverage."


def save(
    material: Material,
    path: str | os.PathLike[str],
    *,
    training: Mapping[str, NDArray[Any]] | None = None,
    lobes: bool = False,
    force: bool = False,
) -> None:
    """Write a material; the file appears whole under its name or not at all.

    Args:
        material: what to write.
        path: file to write, `*.safetensors`.
        training: further arrays that only fitting and propagation read, by name.
        lobes: whether sampling lobes are stored, too, so that readers need not fit them.
        force: whether an existing file is replaced.

    Raises:
        FileExistsError: `path` exists and `force` is False.
    """
    header = material.header.fields()
    metadata = {
        "btfkit": str(VERSION),
        "model": material.model,
        "spec": json.dumps(asdict(material.spec)),
        **{name: json.dumps(value) for name, value in header.items()},
    }
    arrays = {name: np.ascontiguousarray(value) for name, value in material.weights.items()}
    if material.header.coverage is not None:
        for name, value in material.header.coverage.arrays().items():
            arrays[COVERAGE + name] = value
    for name, value in (training or {}).items():
        arrays[TRAINING + name] = np.ascontiguousarray(value)
    if lobes:
        arrays[LOBES] = material.lobes.levels[0].astype(np.float16)
    with whole(path, force=force) as partial:
        partial.write_bytes(_packed(arrays, metadata))


def _packed(arrays: Mapping[str, NDArray[Any]], metadata: Mapping[str, str]) -> bytes:
    """Bytes of a safetensors file, in one order: the library's own writer shuffles its metadata."""
    header: dict[str, Any] = {"__metadata__": dict(sorted(metadata.items()))}
    parts: list[bytes] = []
    offset = 0
    for name in sorted(arrays, key=lambda name: (-arrays[name].itemsize, name)):
        data = arrays[name].tobytes()
        header[name] = {
            "dtype": _DTYPES[arrays[name].dtype.str],
            "shape": list(arrays[name].shape),
            "data_offsets": [offset, offset + len(data)],
        }
        parts.append(data)
        offset += len(data)
    encoded = json.dumps(header, separators=(",", ":")).encode()
    # The header is padded with spaces, so that the arrays start aligned.
    encoded += b" " * (-len(encoded) % 8)
    return struct.pack("<Q", len(encoded)) + encoded + b"".join(parts)


_DTYPES = {
    "<f8": "F64", "<f4": "F32", "<f2": "F16", "<i8": "I64", "<i4": "I32", "<i2": "I16",
    "|i1": "I8", "|u1": "U8", "|b1": "BOOL",
}  # fmt: skip


_FIELDS = tuple(name for name in Header.__dataclass_fields__ if name != "coverage")


def load(path: str | os.PathLike[str]) -> Material:
    """The material in a file; needs no torch.

    Raises:
        FormatError: the file is damaged, of a newer version, or of an unknown model.
    """
    arrays, metadata = _read(path, want=lambda name: not name.startswith(TRAINING))
    try:
        described = json.loads(metadata["spec"])
        model = present_name(metadata["model"], described)
        if model not in MODELS:
            known = ", ".join(sorted(MODELS))
            raise FormatError(path, f"model {model!r}; this version knows {known}")
        kind = material_class(model)
        spec = kind.spec_type(**tuples(described))
        fields = {name: json.loads(metadata[name]) for name in _FIELDS}
        table = arrays.pop(LOBES, None)
        weights = {n: a for n, a in arrays.items() if not n.startswith(COVERAGE)}
        header = replace(Header(**tuples(fields)), coverage=_coverage(arrays))
        material: Material = kind(spec, weights, header)
        if table is None:
            return material
        return material.with_lobes(LobeTable.of(table, grid=header.grid, wrap=header.wrap))
    except (AttributeError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise FormatError(path, f"the header does not describe a material: {error}") from error


def _coverage(arrays: Mapping[str, NDArray[Any]]) -> Coverage | None:
    own = {n.removeprefix(COVERAGE): a for n, a in arrays.items() if n.startswith(COVERAGE)}
    return Coverage.of_arrays(own) if own else None


def training_arrays(path: str | os.PathLike[str]) -> dict[str, NDArray[Any]]:
    """The arrays beside a material that only fitting and propagation read, by name."""
    arrays, _ = _read(path, want=lambda name: name.startswith(TRAINING))
    return {name.removeprefix(TRAINING): value for name, value in arrays.items()}


def header_of(path: str | os.PathLike[str]) -> dict[str, Any]:
    """What the header says, decoded, without reading an array; sizes by array name added."""
    with _opened(path) as file:
        metadata = _checked_metadata(path, file.metadata())
        shapes = {name: file.get_slice(name).get_shape() for name in file.keys()}  # noqa: SIM118
    decoded: dict[str, Any] = {"model": metadata["model"], "shapes": shapes}
    for name in ("spec", *_FIELDS):
        if name in metadata:
            try:
                decoded[name] = json.loads(metadata[name])
            except (ValueError, RecursionError) as error:
                raise FormatError(path, f"{name} is no JSON to be read: {error}") from error
    decoded["model"] = present_name(metadata["model"], decoded.get("spec", {}))
    return decoded


def _opened(path: str | os.PathLike[str]) -> Any:
    if Path(path).is_dir():
        remedy = "btfkit fit makes a material of a store"
        raise FormatError(path, "a folder; expected a material's file", remedy=remedy)
    if not Path(path).is_file():
        raise FileNotFoundError(f"{os.fspath(path)}: no such file")
    try:
        return safe_open(os.fspath(path), framework="numpy")
    except (SafetensorError, OSError, ValueError) as error:
        raise FormatError(
            path, f"not a readable safetensors file ({error})", remedy="fit or copy it again"
        ) from error


def _read(path: str | os.PathLike[str], *, want: Any) -> tuple[dict[str, Any], dict[str, str]]:
    with _opened(path) as file:
        metadata = _checked_metadata(path, file.metadata())
        try:
            arrays = {name: file.get_tensor(name) for name in file.keys() if want(name)}  # noqa: SIM118
        except (SafetensorError, OSError, ValueError, TypeError) as error:
            raise FormatError(path, f"an array cannot be read ({error})") from error
    bad = sorted(n for n, a in arrays.items() if a.dtype.kind == "f" and not np.isfinite(a).all())
    if bad:
        raise FormatError(path, f"{bad[0]} holds values that are not finite")
    return arrays, metadata


def _checked_metadata(
    path: str | os.PathLike[str], metadata: Mapping[str, str] | None
) -> dict[str, str]:
    if not metadata or "model" not in metadata or not metadata.get("btfkit", "").isdigit():
        raise FormatError(path, "a safetensors file, but not a btfkit material")
    if int(metadata["btfkit"]) > VERSION:
        raise FormatError(
            path, f"file version {metadata['btfkit']}; this version reads up to {VERSION}"
        )
    return dict(metadata)
