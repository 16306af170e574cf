"""The benchmark's two pictures: error against bytes, and error against training time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

Row = Mapping[str, Any]


def rate_distortion(rows: Sequence[Row], path: Path) -> None:
    """log1p PSNR of every model of every material against its bytes; the longest budgets."""
    longest = _longest(rows)
    _draw(
        longest, path, x="bytes", x_label="bytes", title="Error against size",
        joined=lambda row: row["model"],
    )  # fmt: skip


def time_to_error(rows: Sequence[Row], path: Path) -> None:
    """log1p PSNR against CPU seconds: one point a budget, and the course of the longest run."""
    plain = [row for row in rows if not row["settings"] or row["budget_cpu_s"] is None]
    _draw(
        plain, path, x="cpu_seconds", x_label="CPU seconds of training",
        title="Error against time", joined=lambda row: row["model"], courses=True,
    )  # fmt: skip


def _longest(rows: Sequence[Row]) -> list[Row]:
    best: dict[tuple[str, str], Row] = {}
    for row in rows:
        key = (row["material"], row["label"])
        if key not in best or (row["budget_cpu_s"] or 0) > (best[key]["budget_cpu_s"] or 0):
            best[key] = row
    return list(best.values())


def _draw(
    rows: Sequence[Row],
    path: Path,
    *,
    x: str,
    x_label: str,
    title: str,
    joined: Any,
    courses: bool = False,
) -> None:
    from matplotlib.figure import Figure

    materials = sorted({row["material"] for row in rows})
    models = sorted({row["model"] for row in rows})
    # Ten hues and as many marks tell the models apart, in print too.
    marks = "osD^v<>Phd"
    figure = Figure(figsize=(4.6 * max(len(materials), 1), 4.8), layout="constrained")
    axes = figure.subplots(1, max(len(materials), 1), squeeze=False)[0]
    for axis, material in zip(axes, materials, strict=False):
        here = sorted((r for r in rows if r["material"] == material), key=joined)
        for model, group in groupby(here, key=joined):
            points = sorted((float(r[x]), float(r["psnr_log1p"])) for r in group)
            index = models.index(model)
            style = {"color": f"C{index}", "marker": marks[index % len(marks)]}
            # Sizes of a closed form are no course in time.
            timed = any(row["budget_cpu_s"] is not None for row in rows if row["model"] == model)
            line = "-" if len(points) > 1 and (timed or not courses) else ""
            axis.plot(*zip(*points, strict=True), line, label=model, **style)
            if courses:
                _course([r for r in here if joined(r) == model], axis, f"C{index}")
        axis.set_xscale("log")
        axis.set_title(material)
        axis.set_xlabel(x_label)
        axis.grid(visible=True, which="both", alpha=0.3)
    if len(axes):
        axes[0].set_ylabel("PSNR of log(1 + x), dB, held-out pictures")
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 5) or 1)
    figure.suptitle(title)
    figure.savefig(path, dpi=110)


def _course(rows: Sequence[Row], axis: Any, colour: str) -> None:
    """The looks while the longest run of one model went on, thin."""
    longest = max(rows, key=lambda row: row["budget_cpu_s"] or 0)
    if longest["curve"]:
        points = [(look["cpu_s"], look["psnr_log1p"]) for look in longest["curve"]]
        axis.plot(*zip(*points, strict=True), ":", color=colour, linewidth=1)
