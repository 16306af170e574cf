"""The plots of a calibration report, each as the text of an SVG."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

Draw = Callable[[Any], None]


def svg(draw: Draw, *, size: tuple[float, float] = (5.2, 3.2), polar: bool = False) -> str:
    """One plot as inline SVG: the same figures give the same text."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context({"svg.hashsalt": "btfkit", "svg.fonttype": "none", "font.size": 9}):
        figure = Figure(figsize=size, layout="constrained")
        axis = figure.add_subplot(projection="polar" if polar else None)
        draw(axis)
        if not polar:
            axis.grid(visible=True, alpha=0.3)
        out = io.StringIO()
        figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None})
    text = out.getvalue()
    return re.sub(r"^.*?(?=<svg)", "", text, flags=re.DOTALL)


def sky_png(directions: Any) -> bytes:
    """PNG of directions (n, 3) seen from above, coloured by their order."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.2, 2.8), dpi=72, layout="constrained")
    FigureCanvasAgg(figure)
    sky(directions, np.arange(len(directions)), "frame")(figure.add_subplot(projection="polar"))
    out = io.BytesIO()
    figure.savefig(out, format="png", metadata={"Software": None})
    return out.getvalue()


def transfer(data: Mapping[str, Any]) -> Draw:
    """Variance over signal, and the line through it."""

    def draw(axis: Any) -> None:
        signal, variance = np.array(data["signal"]), np.array(data["variance"])
        used = np.array(data["used"], bool)
        line = np.geomspace(max(signal.min(), 0.5), signal.max(), 100)
        model = data["read_counts"] ** 2 + 1 / 12 + line / data["gain_e_per_count"]
        axis.loglog(line, model, color="C7")
        axis.loglog(signal[used], variance[used], ".", color="C0")
        axis.loglog(signal[~used], variance[~used], "x", color="C3", label="left out")
        axis.set_xlabel("signal, counts")
        axis.set_ylabel("variance, counts²")
        if (~used).any():
            axis.legend()

    return draw


def linearity(data: Mapping[str, Any]) -> Draw:
    """Deviation from proportion over the range."""

    def draw(axis: Any) -> None:
        level, off = np.array(data["level"]), 100 * np.array(data["deviation"])
        axis.plot(100 * level, off, ".-")
        axis.axhline(0, color="C7", linewidth=0.8)
        axis.set_xlabel("share of the full range, %")
        axis.set_ylabel("off proportion, %")

    return draw


def lamp(data: Mapping[str, Any]) -> Draw:
    """Brightness of the lamp over the run."""

    def draw(axis: Any) -> None:
        time = np.array([np.nan if t is None else t for t in data["time_s"]], float)
        level = np.array(data["level"], float)
        if len(time) != len(level) or not np.isfinite(time).all():
            time = np.arange(len(level), dtype=float)
            axis.set_xlabel("frame")
        else:
            axis.set_xlabel("time, s")
        axis.plot(time, 100 * (level - 1), ".-", linewidth=0.7, markersize=3)
        axis.set_ylabel("lamp, % off its median")

    return draw


def bars(names: Sequence[str], values: Sequence[float], label: str) -> Draw:
    """One bar a name."""

    def draw(axis: Any) -> None:
        axis.bar(np.arange(len(values)), values, color="C0")
        axis.axhline(0, color="C7", linewidth=0.8)
        axis.set_ylabel(label)
        axis.set_xticks(np.arange(len(names)), names, rotation=90, fontsize=6)

    return draw


def sky(directions: Any, values: Any, label: str) -> Draw:
    """Directions seen from above, coloured by a value.

    Args:
        directions: (n, 3) unit vectors. values: (n,). label: what the values are.
    """

    def draw(axis: Any) -> None:
        unit = np.asarray(directions, float)
        theta = np.degrees(np.arccos(np.clip(unit[:, 2], -1, 1)))
        shown = axis.scatter(np.arctan2(unit[:, 1], unit[:, 0]), theta, c=np.asarray(values), s=14)
        axis.set_rmax(max(90.0, float(theta.max(initial=0))))
        axis.set_rticks([30, 60, 90])
        axis.figure.colorbar(shown, ax=axis, label=label, shrink=0.7)

    return draw
