"""Pictures of a relief: hill shading, and a cut through its highest and lowest parts."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit import directions
from btfkit.files import whole
from btfkit.relief.relief import Relief

Floats = NDArray[Any]
_LIGHT_DEG = (55.0, 135.0)


def hill_shaded(relief: Relief) -> Floats:
    """(h, w) Lambertian brightness, 0..1, lit from the upper left."""
    light = directions.from_angles(*np.radians(_LIGHT_DEG))
    return np.clip(relief.normals() @ light, 0, 1)


def write_preview(relief: Relief, path: str | os.PathLike[str], *, force: bool = False) -> None:
    """A PNG of hill shading, heights and a cut along the most varied row."""
    with whole(path, force=force) as partial:
        partial.write_bytes(preview(relief))


def preview(relief: Relief) -> bytes:
    """The same as PNG bytes."""
    row = int(np.argmax(relief.height.std(axis=1)))
    scale, unit = scale_of(relief)
    heights = relief.height * scale
    cut = {"relief": heights[row]}
    return sheet(
        [("hill shading", hill_shaded(relief), "gray", None), ("height", heights, "viridis", unit)],
        cut, cut_label=f"row {row}, {unit}",
    )  # fmt: skip


def scale_of(relief: Relief) -> tuple[float, str]:
    """What heights in tile widths are multiplied by for people, and that unit."""
    w = relief.size[1]
    return (w * relief.texel_mm, "mm") if relief.texel_mm else (float(w), "texels")


def sheet(
    images: Sequence[tuple[str, Floats, str, str | None]],
    cut: Mapping[str, Floats] | None = None,
    *,
    cut_label: str = "",
) -> bytes:
    """PNG bytes: images side by side, each (title, (h, w) or (h, w, 3), colour map, unit).

    Args:
        images: with a unit they get a scale.
        cut: curves under them, by name. cut_label: what the curves show.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = 2 if cut else 1
    figure = Figure(figsize=(3.6 * len(images), 3.2 + 1.8 * (rows - 1)), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(rows, len(images), height_ratios=[3, 1.4][:rows])
    for k, (title, image, colours, unit) in enumerate(images):
        axes = figure.add_subplot(grid[0, k])
        finite = image[np.isfinite(image)]
        low, high = (finite.min(), finite.max()) if finite.size else (0.0, 1.0)
        shown = axes.imshow(image, cmap=colours, vmin=low, vmax=max(high, low + 1e-9))
        axes.set_title(title, fontsize=9)
        axes.set_axis_off()
        if unit:
            figure.colorbar(shown, ax=axes, label=unit, shrink=0.8)
    if cut:
        axes = figure.add_subplot(grid[1, :])
        for name, curve in cut.items():
            axes.plot(curve, label=name, linewidth=1)
        axes.set_ylabel(cut_label, fontsize=8)
        axes.set_xlabel("column", fontsize=8)
        if len(cut) > 1:
            axes.legend(fontsize=7, ncols=len(cut))
    room = io.BytesIO()
    figure.savefig(room, format="png", dpi=110)
    return room.getvalue()
