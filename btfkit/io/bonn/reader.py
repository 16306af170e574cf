"""Bonn's binary `.btf` (UBO2014 and the other compressed BTFs of the University of Bonn).

FMF, DFMF, PVF and BDI. The file is mapped, not read: opening takes milliseconds whatever its
size, and factors are multiplied out for what is asked. Layout: docs/formats-bonn.md.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit import directions
from btfkit.btf import BTF, COLOUR, RGB
from btfkit.errors import FormatError
from btfkit.io import named
from btfkit.io.bonn import body, header
from btfkit.io.bonn import colour as bonn_colour
from btfkit.io.bonn.body import Layout
from btfkit.io.bonn.textures import (
    BonnTextures,
    ChannelTextures,
    Grid,
    ValueTextures,
    ViewTextures,
    WholeTextures,
)
from btfkit.io.spectral import COLOUR as SPECTRAL

ORIENTATIONS = ("standard", "flipped")
_TEXTURES: dict[str, type[BonnTextures]] = {
    "fmf0": WholeTextures,
    "fmf1": WholeTextures,
    "dfmf": ChannelTextures,
    "pvf": ViewTextures,
}
# A longer description of the measurement is left in the file.
_LONGEST_XML = 1 << 16


def detect(path: Path) -> bool:
    """Whether a file starts with one of Bonn's magics, or is named *.btf."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        start = file.read(header.LONGEST)
    return bool(header.magics(start)) or path.suffix.lower() == ".btf"


def read(
    path: Path,
    *,
    cosine: str | None = None,
    orientation: str | None = None,
    rgb_scale: str | None = None,
) -> BTF:
    """A Bonn `.btf`; images are decoded when they are asked for.

    Args:
        path: the file.
        cosine: whether the values hold the cosine of the light: "in" or "out". The file's flag
            decides; where it has none, "in" is assumed.
        orientation: "standard" (assumed: the first stored row is the top) or "flipped".
        rgb_scale: "ignore" (assumed) or "apply" the scale of the channels that the file states.

    Raises:
        FormatError: not such a file, cut off, or sizes that contradict each other.
        ValueError: an option without sense.
    """
    layout = _layout(path)
    flag = None if layout.meta.cosine is None else ("in" if layout.meta.cosine else "out")
    values, record = named.assumptions(
        cosine=(cosine, flag or "in"),
        orientation=(orientation, "standard"),
        rgb_scale=(rgb_scale, "ignore"),
    )
    if flag:
        # The file says it: nothing is assumed.
        record["assumed"].pop("cosine", None)
    for option, known in (("orientation", ORIENTATIONS), ("rgb_scale", ("ignore", "apply"))):
        if values[option] not in known:
            raise ValueError(f"{option} {values[option]!r}; expected {' or '.join(known)}")
    light, view = _pairs(path, layout)
    channels = layout.meta.channels
    textures = _textures(path, layout, _grid(layout, values, light))
    try:
        return BTF(
            textures=textures,
            light=light,
            view=view,
            channels=RGB if len(channels) == 3 else channels,
            colour=COLOUR if len(channels) == 3 else SPECTRAL,
            texel_mm=1 / layout.meta.ppmm if layout.meta.ppmm else None,
            validity=_validity(layout, values["orientation"]),
            provenance={"source": str(path), "format": "bonn", **_described(layout), **record},
        )
    except ValueError as error:
        raise FormatError(path, str(error)) from error


def height_map(path: Path) -> NDArray[np.float32] | None:
    """(h, w) heights that an FMF file holds beside its factors, as stored; None without.

    Their unit is not documented. Rows follow the stored order.
    """
    return _layout(Path(path)).heights


def _layout(path: Path) -> Layout:
    if path.stat().st_size == 0:
        raise FormatError(path, "is empty", remedy="download or copy the file again")
    # An array that knows nothing of its file: slices of a memmap are ten times slower to make.
    data = np.asarray(np.memmap(path, np.uint8, "r"))
    layout = body.parse(path, data)
    if layout.end < len(data):
        warnings.warn(
            f"{path}: {len(data) - layout.end} bytes follow the end of the BTF at byte "
            f"{layout.end} and are ignored",
            stacklevel=3,
        )
    return layout


def _pairs(path: Path, layout: Layout) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """(n, 3) light and view of every pair: light fastest."""
    light = directions.from_angles(*np.moveaxis(layout.directions.light, -1, 0))
    view = directions.from_angles(*layout.directions.view.T)
    if not layout.directions.same_lights:
        warnings.warn(
            f"{path}: views have different lists of lights; each is taken with its own",
            stacklevel=3,
        )
    lists = light[:1] if layout.directions.same_lights else light
    for what, table in [("views", view), *(("lights of a view", table) for table in lists)]:
        if len(np.unique(table.astype(np.float32), axis=0)) < len(table):
            raise FormatError(path, f"two {what} have the same direction; expected each once")
    view = np.repeat(view, light.shape[1], axis=0)
    return light.reshape(-1, 3), view


def _grid(layout: Layout, values: dict[str, Any], light: NDArray[np.floating]) -> Grid:
    factor = named.cosine_factor(values["cosine"], light)
    scale = np.ones(len(light), np.float32)
    if factor is not None:
        scale = np.maximum(light[:, 2], 0).astype(np.float32)
    rows = np.arange(layout.height)
    tint = None
    if values["rgb_scale"] == "apply":
        if len(layout.meta.channels) != 3:
            raise ValueError(
                f"rgb_scale apply: the file has {len(layout.meta.channels)} channels; expected 3"
            )
        tint = np.array(layout.meta.rgb_scale, np.float32)
    return Grid(
        np.arange(layout.pairs),
        rows[::-1] if values["orientation"] == "flipped" else rows,
        np.arange(layout.width),
        scale,
        tint,
    )


def _textures(path: Path, layout: Layout, grid: Grid) -> BonnTextures:
    if layout.chunks is not None:
        return ValueTextures(path, layout, grid, layout.chunks)
    return _TEXTURES[layout.kind](layout, grid)


def _validity(layout: Layout, orientation: str) -> NDArray[np.bool_] | None:
    if layout.chunks is None or layout.chunks.mask.all():
        return None
    mask = layout.chunks.mask
    return (mask[::-1] if orientation == "flipped" else mask)[None]


def _described(layout: Layout) -> dict[str, Any]:
    """What the file says of itself, for the provenance."""
    meta = layout.meta
    said = {
        "kind": layout.kind,
        "version": meta.version,
        "setup": meta.setup,
        "sensor": meta.sensor,
        "light_source": meta.light_source,
        "ppmm": meta.ppmm,
        "rgb_scale_stored": [float(s) if np.isfinite(s) else None for s in meta.rgb_scale],
        "cosine_in_data": meta.cosine,
        "dynamic_range_reduction": layout.log,
        "components": [factors.left.shape[1] for factors in layout.factors],
        "rotations": len(layout.rotations),
    }
    if layout.kind == "dfmf":
        said["colour_model"] = bonn_colour.NAMES[layout.colour_model]
    if layout.heights is not None:
        said["height_map"] = list(layout.heights.shape)
    if meta.xml and len(meta.xml) <= _LONGEST_XML:
        said["measurement_xml"] = meta.xml
    return said
