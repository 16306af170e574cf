"""Plots of a report as PNG: errors on discs, maps by texel, polar plots."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Floats = NDArray[Any]
_DPI = 96


def data_uri(png: bytes) -> str:
    """A PNG as an address that holds it."""
    return "data:image/png;base64," + base64.b64encode(png).decode()


def png_of(codes: NDArray[np.uint8]) -> bytes:
    """PNG bytes of 8-bit pixels (h, w) or (h, w, 3)."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(codes).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def by_angle(light: Floats, view: Floats, psnr: Floats, *, what: str = "pairs") -> bytes:
    """PSNR of pairs (n,) over the discs of light and view, the worst on top, and by angle.

    Args:
        what: each of them is called.
    """
    order = np.argsort(-psnr)

    def draw(figure: Figure) -> None:
        for column, (name, ways) in enumerate((("light", light), ("view", view))):
            axes: Any = figure.add_subplot(1, 4, column + 1, projection="polar")
            theta = np.degrees(np.arccos(np.clip(ways[order, 2], -1, 1)))
            phi = np.arctan2(ways[order, 1], ways[order, 0])
            dots = axes.scatter(phi, theta, c=psnr[order], s=16, cmap="viridis")
            axes.set_rlim(0, 90)
            axes.set_title(f"{name}: PSNR of {what}, dB", fontsize=9)
            axes.tick_params(labelsize=7)
            figure.colorbar(dots, ax=axes, shrink=0.7, pad=0.12).ax.tick_params(labelsize=7)
            flat = figure.add_subplot(1, 4, column + 3)
            theta = np.degrees(np.arccos(np.clip(ways[:, 2], -1, 1)))
            flat.plot(theta, psnr, ".", markersize=4, alpha=0.5)
            flat.plot(*_binned(theta, psnr), "k-", linewidth=1.2)
            flat.set_xlabel(f"{name} from above, degrees", fontsize=8)
            flat.set_title("PSNR, dB; line: of means", fontsize=9)
            flat.tick_params(labelsize=7)

    return drawn(draw, (13, 3.2))


def by_texel(rmse: Floats, *, said: str = "RMSE over the pairs, texel by texel") -> bytes:
    """Root mean square error of each texel (h, w), with its scale, under a title."""
    return _mapped(rmse, said, "magma", rmse.shape)


def heights(tiles: Floats, size: tuple[int, int]) -> bytes:
    """Heights in tile widths, of a texture of `size` (h, w) texels."""
    return _mapped(tiles, "heights, tile widths", "viridis", size)


def polar(lights_deg: Floats, lines: Sequence[tuple[str, Floats, Floats, Floats]]) -> bytes:
    """Reflectance of single texels by the light's angle in one plane.

    Args:
        lights_deg: (k,) angles of the model's curve, negative on the far side.
        lines: of each texel its name, the model's curve (k,), and the measured angles and values.
    """

    def draw(figure: Figure) -> None:
        for column, (name, curve, angles, values) in enumerate(lines):
            axes: Any = figure.add_subplot(1, len(lines), column + 1, projection="polar")
            axes.plot(np.radians(lights_deg), curve, linewidth=1.4)
            axes.plot(np.radians(angles), values, "k.", markersize=5)
            axes.set_theta_zero_location("N")
            axes.set_theta_direction(-1)
            axes.set_thetamin(-90)
            axes.set_thetamax(90)
            axes.set_title(name, fontsize=9)
            axes.tick_params(labelsize=7)

    return drawn(draw, (3.1 * len(lines), 2.4))


def drawn(draw: Callable[[Figure], None], inches: tuple[float, float]) -> bytes:
    """PNG bytes of a figure."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=inches, dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    draw(figure)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _mapped(values: Floats, title: str, colours: str, size: tuple[int, ...]) -> bytes:
    h, w = size
    wide = 4.6 * min(w / h, 1.8)

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        shown = axes.imshow(values, cmap=colours, interpolation="nearest", extent=(0, w, h, 0),
                            vmax=float(np.nanquantile(values, 0.995)))  # fmt: skip
        axes.set_title(title, fontsize=9)
        axes.tick_params(labelsize=7)
        figure.colorbar(shown, ax=axes, shrink=0.8).ax.tick_params(labelsize=7)

    return drawn(draw, (wide + 1, 4.2))


def _binned(theta: Floats, psnr: Floats) -> tuple[Floats, Floats]:
    """Middles of bins of 10 degrees that hold pairs, and the PSNR of their mean error."""
    which = np.minimum(theta // 10, 8).astype(int)
    mse = np.power(10.0, -np.minimum(psnr, 200) / 10)
    used = np.unique(which)
    return 10.0 * used + 5, np.array([-10 * np.log10(mse[which == k].mean()) for k in used])
