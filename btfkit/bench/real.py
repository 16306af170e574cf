"""The scoreboard of measured materials: errors by the angle to the nearest pair trained on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from btfkit import io, metrics
from btfkit.bench import strata, tables
from btfkit.errors import BtfkitError
from btfkit.files import whole

Row = Mapping[str, Any]
# Polar angles of the view at which errors are told apart, degrees.
_TILTS = (0.0, 20.0, 40.0, 55.0, 70.0)
PAGE, PICTURES = "real.md", ("real-angle.png", "real-view.png")


def sources_in(folder: Path) -> tuple[list[Path], dict[str, str]]:
    """What of a folder can be read as a BTF, and why the rest cannot, by name.

    Raises:
        BtfkitError: no such folder, or nothing in it can be read.
    """
    if not folder.is_dir():
        raise BtfkitError(f"{folder} is no folder", remedy="name one that holds stores or sources")
    found, declined = [], {}
    for path in sorted(folder.iterdir()):
        if path.name.startswith("."):
            continue
        try:
            io.detect(path)
        except BtfkitError as error:
            declined[path.name] = str(error)
        else:
            found.append(path)
    if not found:
        raise BtfkitError(
            f"{folder} holds nothing that is read as a BTF "
            f"({'; '.join(declined.values()) or 'it is empty'})",
            remedy="ingest something into it",
        )
    return found, declined


def write(folder: Path, results: Mapping[str, Any]) -> None:
    """Write `real.md` and its two figures into a folder of results."""
    rows = [row for row in results["cells"] if row.get("each")]
    for name, key, edges, title in (
        (PICTURES[0], "angle_deg", strata.EDGES, "degrees to the nearest pair trained on"),
        (PICTURES[1], "view_deg", _TILTS, "polar angle of the view, degrees"),
    ):
        with whole(folder / name, force=True) as partial:
            _draw(rows, partial, key, edges, title)
    with whole(folder / PAGE, force=True) as partial:
        partial.write_text(page(results), encoding="utf-8")


def page(results: Mapping[str, Any]) -> str:
    """The tables: a material each, models by strata, then by view and with gains."""
    machine = results["machine"]
    parts = [
        "# Measured materials\n",
        f"{machine['processor']}, {machine['cores']} cores, {machine['threads']} threads. "
        "PSNR of log(1 + x) of held-out pictures, dB, by the angle to the nearest pair trained "
        "on: the larger of the angles between the lights and between the views.\n",
    ]
    cells = results["cells"]
    for material in dict.fromkeys(row["material"] for row in cells):
        here = [row for row in cells if row["material"] == material]
        good = [row for row in here if row.get("each")]
        parts.append(f"## {material}\n")
        if good:
            parts += [_about(good[0]), _table_of(good), _gains(good)]
        parts += [_found(row) for row in good if "gains" in row]
        for row in here:
            if "failed" in row:
                parts.append(f"`{row['label']}`: {row['failed']}\n")
    return "\n".join(parts)


def _about(row: Row) -> str:
    case, counts = row["case"], _counts(row["each"])
    said = ", ".join(f"{count} at {strata.named(k)}" for k, count in counts.items())
    rows, cols = case["size"]
    return f"{case['pairs']} pairs of {cols} × {rows} trained on; pictures held out: {said}.\n"


def _counts(each: Sequence[Row]) -> dict[int, int]:
    numbers = strata.stratum(np.array([one["angle_deg"] for one in each]))
    return {int(k): int((numbers == k).sum()) for k in np.unique(numbers)}


def _table_of(rows: Sequence[Row]) -> str:
    """A line a cell: time, bytes, errors by stratum and by view."""
    some = rows[0]["each"]
    by_angle = _groups(some, "angle_deg", strata.EDGES)
    by_view = _groups(some, "view_deg", _TILTS)
    head = ["model", "CPU s", "kB", "all", *(strata.named(k) for k in by_angle)]
    if len(by_view) > 1:
        head += [f"view {_TILTS[k]:g}°+" for k in by_view]
    head += ["dB", "SSIM", "FLIP"]
    lines = []
    for row in rows:
        each = row["each"]
        line = [f"`{row['label']}`", *_cost(row)]
        line.append(_psnr(each))
        line += [_psnr(part) for part in _groups(each, "angle_deg", strata.EDGES).values()]
        if len(by_view) > 1:
            line += [_psnr(part) for part in _groups(each, "view_deg", _TILTS).values()]
        line += [_psnr(each, "mse"), _mean(each, "ssim_srgb"), _mean(each, "flip")]
        lines.append(line)
    return tables.table(head, lines)


def _cost(row: Row) -> tuple[str, str]:
    """CPU seconds and kilobytes; answers from elsewhere come without."""
    if row.get("elsewhere"):
        return "", ""
    return f"{row['cpu_seconds']:.1f}", f"{row['bytes'] / 1e3:.0f}"


def _gains(rows: Sequence[Row]) -> str:
    """The same errors with each held-out pair's gain taken out, beside those without."""
    head = ["model", "log1p dB", "with gains", "SSIM", "with gains", "FLIP", "with gains"]
    lines = []
    for row in rows:
        each = row["each"]
        line = [f"`{row['label']}`", _psnr(each), _psnr(each, "mse_log1p_gains")]
        for key in ("ssim_srgb", "flip"):
            line += [_mean(each, key), _mean(each, f"{key}_gains")]
        lines.append(line)
    return (
        "A gain for each held-out pair and channel taken out, estimated on one half of its texels "
        "and scored on the other:\n\n" + tables.table(head, lines)
    )


def _found(row: Row) -> str:
    """What gains a fit found, in words."""
    found = row["gains"]
    spread, smooth = (
        ", ".join(f"{100 * part:.1f}" for part in found[key]) for key in ("deviation", "smooth")
    )
    error = "" if found["error"] is None else f", each known to {100 * found['error']:.1f} %"
    return (
        f"`{row['label']}`: the gains of {found['pairs']} pairs vary by {spread} %{error}; "
        f"{smooth} % change slowly with light and view and stay in the reflectance.\n"
    )


def _groups(each: Iterable[Row], key: str, edges: Sequence[float]) -> dict[int, list[Row]]:
    """Pictures by the class that a number of theirs lies in; classes without any left out."""
    found: dict[int, list[Row]] = {}
    for one in each:
        number = int(np.searchsorted(np.array(edges), one[key] + 1e-3, side="right")) - 1
        found.setdefault(number, []).append(one)
    return dict(sorted(found.items()))


def _psnr(each: Iterable[Row], key: str = "mse_log1p") -> str:
    return f"{metrics.psnr(float(np.mean([one[key] for one in each]))):.2f}"


def _mean(each: Iterable[Row], key: str) -> str:
    values = [one[key] for one in each if key in one]
    return f"{np.mean(values):.3f}" if values else ""


def _draw(rows: Sequence[Row], path: Path, key: str, edges: Sequence[float], title: str) -> None:
    """One panel a material with more than one class: PSNR of each model against the mean angle."""
    from matplotlib.figure import Figure

    chosen = _plain(rows)
    materials = [
        name
        for name in dict.fromkeys(row["material"] for row in chosen)
        if len(_groups(next(r["each"] for r in chosen if r["material"] == name), key, edges)) > 1
    ]
    count = max(len(materials), 1)
    figure = Figure(figsize=(4.4 * count, 4.8), layout="constrained")
    axes = figure.subplots(1, count, squeeze=False)[0]
    labels = list(dict.fromkeys(row["label"] for row in chosen))
    marks = "osD^v<>Phd"
    entries: dict[str, Any] = {}
    for axis, material in zip(axes, materials, strict=False):
        for row in (row for row in chosen if row["material"] == material):
            index = labels.index(row["label"])
            groups = _groups(row["each"], key, edges).values()
            where = [float(np.mean([one[key] for one in part])) for part in groups]
            (entries[row["label"]],) = axis.plot(
                where, [float(_psnr(part)) for part in groups], color=f"C{index}",
                marker=marks[index % len(marks)],
            )  # fmt: skip
        axis.set_title(material)
        axis.set_xlabel(title)
        axis.grid(visible=True, alpha=0.3)
    if entries:
        axes[0].set_ylabel("PSNR of log(1 + x), dB, held out")
        figure.legend(list(entries.values()), list(entries), loc="outside lower center", ncols=4)
    figure.savefig(path, dpi=110)


def _plain(rows: Sequence[Row]) -> list[Row]:
    """One cell a model and material: without settings where there is one, the longest budget."""

    def rank(row: Row) -> tuple[bool, float]:
        return not row["settings"], row["budget_cpu_s"] or row.get("bytes", 0)

    best: dict[tuple[str, str], Row] = {}
    for row in rows:
        at = (row["material"], row["model"])
        if at not in best or rank(row) > rank(best[at]):
            best[at] = row
    return list(best.values())
