"""Pictures of the procedural materials for docs/relief.md; everything in them is synthetic.

    python examples/relief_sheet.py [FOLDER]

Writes relief-sheet.jpg (albedo, height, seen from above and from 60 degrees, light from the right)
and relief-cylinder.jpg (cobbles on a cylinder: what a silhouette is).
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from btfkit import colour, directions
from btfkit.relief import procedural, trace

TILE = 112
LIGHT = directions.from_angles(np.radians(55), 0.0).astype(np.float32)  # from +x, the right
ABOVE = directions.from_angles(0.0, 0.0).astype(np.float32)
OBLIQUE = directions.from_angles(np.radians(60), np.radians(90)).astype(np.float32)  # from the top
Picture = NDArray[np.uint8]


def encoded(linear: NDArray[np.floating]) -> Picture:
    """8-bit sRGB of linear values."""
    return np.rint(255 * colour.to_srgb(np.clip(linear, 0, 1))).astype(np.uint8)


def strip(name: str) -> Picture:
    """Albedo, height, and the material lit from the right, from above and from 60 degrees."""
    relief = procedural.make(name, TILE)
    height = (relief.height - relief.height.min()) / max(float(np.ptp(relief.height)), 1e-9)
    light, view = np.stack([LIGHT, LIGHT]), np.stack([ABOVE, OBLIQUE])
    lit = trace.traced_btf(relief, light, view, samples=16, bounces=2)
    # Metal sends its gloss elsewhere: brighter, so that it is seen.
    gain = 1.4 if name != "scratched" else 2.5
    return np.concatenate(
        [
            encoded(relief.albedo if name != "scratched" else relief.specular),
            np.rint(255 * np.repeat(height[..., None], 3, axis=2)).astype(np.uint8),
            encoded(gain * lit.texture(0)),
            encoded(gain * lit.texture(1)),
        ],
        axis=1,
    )


def sheet() -> Image.Image:
    """All materials, two in a row."""
    rows = []
    for name in procedural.CATALOGUE:
        canvas = Image.new("RGB", (4 * TILE + 8, TILE + 16), "white")
        canvas.paste(Image.fromarray(strip(name)), (0, 14))
        ImageDraw.Draw(canvas).text((2, 1), name, fill="black")
        rows.append(np.asarray(canvas))
    if len(rows) % 2:
        rows.append(np.full_like(rows[0], 255))
    return Image.fromarray(
        np.concatenate(
            [np.concatenate(pair, axis=1) for pair in zip(rows[::2], rows[1::2], strict=True)]
        )
    )


def cylinder(size: int = 320) -> Image.Image:
    """Cobbles under a cylinder whose axis runs up the picture, seen from the front."""
    relief, _ = procedural.make("cobbles", 256, relief_texels=26).under_surface()
    curvature = 1.6
    x, y = np.meshgrid((np.arange(size) + 0.5) / size * 2 - 1, np.arange(size) / size)
    angle = np.arcsin(np.clip(x, -1, 1))
    # The viewer stands far along +z of the picture; at each place that is a view of its own.
    view = directions.from_angles(np.abs(angle), np.where(angle < 0, 0.0, np.pi))
    light = np.array([0.75, 0.35, 0.56])  # in the picture: from the right, above, in front
    turned = np.stack(
        [
            light[0] * np.cos(angle) - light[2] * np.sin(angle),
            np.full_like(angle, light[1]),
            light[0] * np.sin(angle) + light[2] * np.cos(angle),
        ],
        axis=-1,
    )
    uv = np.stack([angle / curvature, y * 2 / curvature], axis=-1)
    rgb, opacity = trace.answer(relief, uv, turned, view, 0.5, curvature, samples=16, bounces=1)
    return Image.fromarray(encoded(1.4 * rgb * opacity[..., None] + (1 - opacity[..., None])))


def main() -> None:
    """Write both pictures."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "docs/images")
    sheet().save(folder / "relief-sheet.jpg", quality=86)
    cylinder().save(folder / "relief-cylinder.jpg", quality=88)


if __name__ == "__main__":
    main()
