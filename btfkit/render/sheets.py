"""Several pictures in one: side by side with their difference, and direction pairs in a table."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit import colour, metrics
from btfkit.directions import from_angles
from btfkit.materials.base import Material
from btfkit.render.preview import Rendering

Codes = NDArray[np.uint8]
_MARGIN, _LINE, _INK, _PAPER = 6, 14, (225, 225, 225), 40
# Lights and views of a contact sheet reach that far from above.
_STEEPEST_DEG = 75.0
_GOLDEN = math.pi * (3 - math.sqrt(5))


def codes_of(linear: NDArray[Any]) -> Codes:
    """8-bit sRGB of linear RGB, clamped."""
    return np.rint(255 * colour.to_srgb(np.clip(linear, 0, 1))).astype(np.uint8)


def compared(one: Rendering, other: Rendering) -> dict[str, float]:
    """Figures of the difference of two pictures of one size, over pixels that either covers.

    Returns:
        psnr (linear, peak 1), mae, largest (absolute difference of a channel), mean_ratio (mean
        of the second over that of the first), cover (mean absolute difference of cover).
    """
    seen = (one.cover > 0) | (other.cover > 0)
    if not seen.any():
        raise ValueError("neither picture shows anything to compare")
    gap = (other.radiance - one.radiance)[seen].astype(float)
    mean = float(one.radiance[seen].mean())
    return {
        "psnr": metrics.psnr(float(np.square(gap).mean())),
        "mae": float(np.abs(gap).mean()),
        "largest": float(np.abs(gap).max()),
        "mean_ratio": float(other.radiance[seen].mean()) / mean if mean else math.nan,
        "cover": float(np.abs(one.cover - other.cover).mean()),
    }


def side_by_side(
    shown: tuple[NDArray[Any], NDArray[Any]], names: tuple[str, str], figures: dict[str, float]
) -> Codes:
    """Two pictures (h, w, 3), linear RGB, and 4 x their difference about grey, with figures."""
    gap = 0.5 + 4 * (
        colour.to_srgb(np.clip(shown[1], 0, 1)) - colour.to_srgb(np.clip(shown[0], 0, 1))
    )
    panes = [*map(codes_of, shown), np.rint(255 * np.clip(gap, 0, 1)).astype(np.uint8)]
    psnr = figures["psnr"]
    said = (
        f"PSNR {psnr:.2f} dB, mean difference {figures['mae']:.4f}, "
        f"largest {figures['largest']:.3f}, means {figures['mean_ratio']:.3f} : 1"
    )
    return table([panes], (*names, "difference x 4"), (), below=said)


def direction_pairs(
    material: Material,
    to_rgb: NDArray[np.float32],
    *,
    count: int,
    side: int = 96,
    exposure: float = 0.0,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Codes, list[tuple[float, float]]]:
    """A table of `count` views by `count` lights: what the material answers on its own texels.

    Args:
        material: what answers. to_rgb: (c, 3) matrix to linear RGB.
        side: pixels of the longer side of a cell. exposure: stops.

    Returns:
        The table, and THETA, PHI of its directions in degrees: rows are views, columns lights.
    """
    k = np.arange(count)
    # Evenly over the cap of directions; the first is straight above.
    least = math.cos(math.radians(_STEEPEST_DEG))
    theta = np.arccos(1 - (1 - least) * k / max(count - 1, 1))
    phi = k * _GOLDEN % (2 * np.pi)
    ways = from_angles(theta, phi)
    h, w = material.header.grid
    shrink = max(h, w) / min(max(h, w), side)
    rows, columns = max(round(h / shrink), 1), max(round(w / shrink), 1)
    u, v = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    uv = np.stack([u, v], axis=-1)
    blur = 0.5 * shrink if material.has_levels else 0.5
    cells = []
    for row, view in enumerate(ways):
        cells.append(
            [codes_of(material.evaluate(uv, light, view, blur).reflectance @ to_rgb * 2.0**exposure)
             for light in ways]
        )  # fmt: skip
        if progress:
            progress(row + 1, count)
    angles = [(float(a), float(b)) for a, b in np.degrees(np.stack([theta, phi], axis=1))]
    named = [f"{a:.0f}\N{DEGREE SIGN}, {b:.0f}\N{DEGREE SIGN}" for a, b in angles]
    return table(
        cells, [f"light {name}" for name in named], [f"view {name}" for name in named]
    ), angles


def table(
    cells: Sequence[Sequence[Codes]], above: Sequence[str], left: Sequence[str], *, below: str = ""
) -> Codes:
    """Cells (h, w, 3) of one size in rows, with a text above each column and in each row."""
    from PIL import Image, ImageDraw

    h, w = cells[0][0].shape[:2]
    height = _MARGIN + _LINE + len(cells) * (h + _MARGIN + (_LINE if left else 0)) + (
        _LINE + _MARGIN if below else 0
    )  # fmt: skip
    width = _MARGIN + len(cells[0]) * (w + _MARGIN)
    sheet = Image.new("RGB", (width, height), (_PAPER,) * 3)
    draw = ImageDraw.Draw(sheet)
    for column, name in enumerate(above):
        draw.text((_MARGIN + column * (w + _MARGIN), 2), _short(name, w), fill=_INK)
    y = _MARGIN + _LINE
    for row, line in enumerate(cells):
        for column, cell in enumerate(line):
            sheet.paste(Image.fromarray(cell), (_MARGIN + column * (w + _MARGIN), y))
        y += h
        if left:
            draw.text((_MARGIN, y), left[row], fill=_INK)
            y += _LINE
        y += _MARGIN
    if below:
        draw.text((_MARGIN, y), below, fill=_INK)
    return np.asarray(sheet)


def _short(text: str, width: int) -> str:
    """As much of a text as fits in about so many pixels of the built-in font."""
    most = max(width // 6, 4)
    return text if len(text) <= most else text[: most - 2] + ".."
