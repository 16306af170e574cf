"""The benchmark's two pictures: error against bytes, and error against training time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

Row = Mapping[str, Any]


def rate_distortion(rows: Sequence[Row], path: Path) -> None:
    """log1p PSNR of every model of every material against its bytes; the longest budgets.

    Sizes of a closed form are one curve; variants of a trained model are points of their own.
    """
    _draw(
        _longest(rows), path, x="bytes", x_label="bytes", title="Error against size",
        curves=lambda row: row["budget_cpu_s"] is None,
    )  # fmt: skip


def time_to_error(rows: Sequence[Row], path: Path) -> None:
    """log1p PSNR against CPU seconds: one point a budget, and the course of the longest run."""
    plain = [row for row in rows if not row["settings"] or row["budget_cpu_s"] is None]
    _draw(
        plain, path, x="cpu_seconds", x_label="CPU seconds of training",
        title="Error against time", curves=lambda row: row["budget_cpu_s"] is not None,
        courses=True,
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
    curves: Any,
    courses: bool = False,
) -> None:
    """One panel a material; points of a model are joined where `curves` says so of its rows."""
    from matplotlib.figure import Figure

    # Answers from elsewhere come without bytes and times.
    rows = [row for row in rows if x in row]
    materials = sorted({row["material"] for row in rows})
    models = sorted({row["model"] for row in rows})
    # Ten hues and as many marks tell the models apart, in print too.
    marks = "osD^v<>Phd"
    figure = Figure(figsize=(4.6 * max(len(materials), 1), 4.8), layout="constrained")
    axes = figure.subplots(1, max(len(materials), 1), squeeze=False)[0]
    entries: dict[str, Any] = {}
    for axis, material in zip(axes, materials, strict=False):
        here = sorted((r for r in rows if r["material"] == material), key=lambda r: r["model"])
        for model, group in groupby(here, key=lambda row: row["model"]):
            own = list(group)
            points = sorted((float(r[x]), float(r["psnr_log1p"])) for r in own)
            index = models.index(model)
            (entries[model],) = axis.plot(
                *zip(*points, strict=True), color=f"C{index}", marker=marks[index % len(marks)],
                linestyle="-" if curves(own[0]) else "none",
            )  # fmt: skip
            if courses:
                _course(own, axis, f"C{index}")
        axis.set_xscale("log")
        axis.set_title(material)
        axis.set_xlabel(x_label)
        axis.grid(visible=True, which="both", alpha=0.3)
    if entries:
        axes[0].set_ylabel("PSNR of log(1 + x), dB, held out")
        names = sorted(entries)
        figure.legend(
            [entries[name] for name in names], names, loc="outside lower center",
            ncols=min(len(names), 5),
        )  # fmt: skip
    figure.suptitle(title)
    figure.savefig(path, dpi=110)


def _course(rows: Sequence[Row], axis: Any, colour: str) -> None:
    """The looks while the longest run of one model went on, thin."""
    longest = max(rows, key=lambda row: row["budget_cpu_s"] or 0)
    if longest["curve"]:
        points = [(look["cpu_s"], float(look["psnr_log1p"])) for look in longest["curve"]]
        axis.plot(*zip(*points, strict=True), ":", color=colour, linewidth=1)
