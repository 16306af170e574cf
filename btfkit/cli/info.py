"""`btfkit info`: what a file is, or what this installation has."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
import numpy as np

from btfkit.cli.bar import Bar
from btfkit.cli.options import LocationType
from btfkit.cli.outcome import Outcome, verb
from btfkit.jsonvalues import plain
from btfkit.remote import Location

_LIBRARIES = (
    "torch",
    "kornia",
    "opencv-contrib-python-headless",
    "scikit-image",
    "colour-science",
    "OpenImageIO",
    "pyusb",
    "zarr",
    "numpy",
)


@verb("info", example="btfkit info wool.btf.zarr")
@click.argument("path", required=False, type=LocationType())
def info_verb(bar: Bar, *, path: Location | None) -> Outcome:
    """What PATH is: sizes, directions, quantity, colour, provenance, licence.

    Without PATH: versions, devices, formats, models and the kernels in use.
    """
    data = installation() if path is None else described(path)
    return Outcome(_listing(plain(data)), data)


def installation() -> dict[str, Any]:
    """Versions, processors, formats, models and kernels of this installation."""
    from btfkit import native
    from btfkit.fitting import MODELS
    from btfkit.io import FORMATS

    return {
        "btfkit": importlib.metadata.version("btfkit"),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "processors": os.cpu_count(),
        "threads": native.threads(),
        "cuda": _cuda(),
        "devices": _devices(),
        "kernels": native.in_use(),
        "formats": list(FORMATS),
        "models": list(MODELS),
        "libraries": {name: _version(name) for name in _LIBRARIES},
    }


def described(path: Location) -> dict[str, Any]:
    """What a store, a readable source, a model, a relief or a query file says of itself."""
    from btfkit import sources
    from btfkit.btf import BTF
    from btfkit.queries import QuerySet

    kind = sources.kind_of(path)
    if kind == "model" and isinstance(path, Path):
        from btfkit.coverage import UNKNOWN
        from btfkit.materials.explained import explained
        from btfkit.materials.file import header_of

        header, material = header_of(path), sources.material(path)
        coverage = material.header.coverage
        return {
            "kind": kind,
            "bytes": path.stat().st_size,
            "coverage": UNKNOWN if coverage is None else coverage.described(),
            "made_of": explained(material),
            **header,
        }
    found = sources.measured(path)
    if isinstance(found, BTF):
        return {"kind": kind, "path": path, **_of_btf(found, _masked(path))}
    if isinstance(found, QuerySet):
        return {"kind": kind, "path": path, **_of_queries(found)}
    h, w = found.height.shape
    return {
        "kind": kind,
        "path": path,
        "size": (h, w),
        "height": (float(np.nanmin(found.height)), float(np.nanmax(found.height))),
        "texel_mm": found.texel_mm,
        "wrap": found.wrap,
    }


def _masked(path: Location) -> int | None:
    """Texels of a store that hold no value; None of what is no store."""
    from btfkit.io.store import reader

    stored = reader.detect(path) if isinstance(path, Path) else reader.is_store(path)
    return reader.masked_texels(path) if stored else None


def _of_btf(btf: Any, masked: int | None) -> dict[str, Any]:
    from btfkit import directions
    from btfkit.btf import QUANTITY

    lights, _ = directions.unique(btf.light)
    views, _ = directions.unique(btf.view)
    return {
        "shape": btf.shape,
        "lights": len(lights),
        "views": len(views),
        "steepest_light_deg": float(np.degrees(np.arccos(lights[:, 2].min()))),
        "steepest_view_deg": float(np.degrees(np.arccos(views[:, 2].min()))),
        "near_field": btf.light_position is not None or btf.view_position is not None,
        "quantity": QUANTITY,
        "colour": btf.colour,
        "channels": btf.channels,
        "texel_mm": btf.texel_mm,
        "wrap": btf.wrap,
        "maps": _maps_of(btf, masked),
        "licence": btf.licence,
        "provenance": dict(btf.provenance),
        "history": btf.history,
    }


def _maps_of(btf: Any, masked: int | None) -> dict[str, Any]:
    """What is known of single texels, without reading any."""
    n, h, w, _ = btf.shape
    found: dict[str, Any] = {}
    if btf.validity is not None:
        found["validity"] = {"valid": float(btf.validity.mean())}
    elif masked is not None:
        found["validity"] = {"valid": 1 - masked / (n * h * w)}
    if btf.variance is not None:
        found["variance"] = "of every value"
    if btf.coverage is not None:
        found["coverage"] = "of every texel"
    if btf.footprint is not None:
        seen = btf.footprint[np.isfinite(btf.footprint)]
        least, most = (float(f(seen)) if seen.size else None for f in (np.min, np.max))
        found["footprint"] = {"least_texels": least, "most_texels": most}
    if btf.blurs is not None:
        found["blur"] = f"of every texel, {len(btf.blurs.maps)} maps"
    return found


def _of_queries(queries: Any) -> dict[str, Any]:
    valid = queries.valid()
    return {
        "rows": len(queries),
        "masked": int((~valid).sum()),
        "answers": queries.rgb is not None,
        "opacity": queries.opacity is not None,
        "footprints": queries.footprint is not None,
        "curvatures": queries.curvature is not None,
        "size": queries.size,
        "channels": queries.channels,
    }


def _version(library: str) -> str:
    try:
        return importlib.metadata.version(library)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _cuda() -> str:
    from btfkit.fitting import cuda_device

    return cuda_device()


def _devices() -> list[str]:
    """Rigs that `btfkit capture --device` can drive: those on the bus, and the twin."""
    from btfkit.devices import DRIVERS, driver
    from btfkit.errors import DeviceError

    found: list[str] = []
    for name in DRIVERS:
        try:
            found += [f"{name}:{rig.serial} ({rig.name})" for rig in driver(name).find()]
        except DeviceError as error:
            found.append(f"{name}: {error}")
    return found


def _listing(data: Mapping[str, Any], indent: str = "") -> str:
    lines = []
    for key, value in data.items():
        if isinstance(value, Mapping) and value:
            lines += [f"{indent}{key}", _listing(value, indent + "  ")]
        else:
            shown = ", ".join(map(str, value)) if isinstance(value, list) else value
            lines.append(f"{indent}{key:<20} {shown}")
    return "\n".join(lines)
