"""The benchmark in words: tables for people."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from btfkit.bench.machine import same

Row = Mapping[str, Any]
# Columns of a table of cells: title, key, how it is written, and its unit as a factor.
_COLUMNS: tuple[tuple[str, str, str, float], ...] = (
    ("CPU s", "cpu_seconds", "{:.1f}", 1),
    ("wall s", "seconds", "{:.1f}", 1),
    ("steps", "steps", "{:.0f}", 1),
    ("log1p dB", "psnr_log1p", "{:.2f}", 1),
    ("dB", "psnr", "{:.2f}", 1),
    ("sRGB dB", "psnr_srgb", "{:.2f}", 1),
    ("SSIM", "ssim_srgb", "{:.3f}", 1),
    ("FLIP", "flip", "{:.3f}", 1),
    ("weights", "parameters", "{:.0f}", 1),
    ("kB", "bytes", "{:.0f}", 1e-3),
    ("Mquery/CPU s", "queries_per_cpu_s", "{:.2f}", 1e-6),
    ("% peak", "share_of_peak", "{:.0f}", 100),
    ("MB more", "peak_memory_bytes", "{:.0f}", 1e-6),
)
# What a paper's table has of them.
_PRINTED = ("CPU s", "log1p dB", "dB", "SSIM", "FLIP", "kB")


def markdown(results: Mapping[str, Any]) -> str:
    """Everything that bench.json holds, as a page."""
    machine = results["machine"]
    peak = machine["peak_gflops_one_thread"]
    rows = results["cells"]
    parts = [
        "# btfkit bench\n",
        f"{machine['processor']}, {machine['cores']} cores, {machine['threads']} threads; "
        f"{machine['system']}; "
        f"{machine['compiler']}; Python {machine['python']}; kernels {machine['variants']}; "
        + (f"measured peak {peak:.0f} GFLOP/s a thread.\n" if peak else "no kernels built.\n"),
        others(rows, machine),
    ]
    for material in dict.fromkeys(row["material"] for row in rows):
        here = [row for row in rows if row["material"] == material]
        parts += [f"## {material}\n", cells(here)]
        parts += [
            levels(here, "mse x 1e-3 by level", lambda level: f"{1e3 * level['mse']:.3f}"),
            levels(here, "log1p dB by level", lambda level: f"{float(level['psnr_log1p']):.2f}"),
        ]
    parts += stages(results.get("stages", {}))
    for title, key in (
        ("Kernels, one thread", "kernels"),
        ("The loop beside its kernel", "loop"),
        ("What each skip saves", "skips"),
        ("Region of interest", "regions"),
    ):
        if key in results:
            parts += [f"## {title}\n", generic(results[key])]
    return "\n".join(part for part in parts if part) + "\n"


def stages(found: Mapping[str, Sequence[Row]]) -> list[str]:
    """A table a stage."""
    titles = {
        "merge": "Merging: relative deviation by decade of electrons a second",
        "bundle": "Adjustment of a rig, by views",
        "rectify": "Rectification, signal to noise",
        "heightfield": "Heights of traced cobbles, errors in texels",
    }
    return [f"## {titles[name]}\n\n{generic(rows)}" for name, rows in found.items()]


def others(rows: Sequence[Row], machine: Row) -> str:
    """Which cells come from elsewhere than the machine that is named; empty where none does."""
    kinds: dict[str, int] = {}
    for row in rows:
        place = row.get("machine")
        if row.get("elsewhere"):
            continue
        if place is None:
            kind = "an unnamed machine"
        elif same(place, machine):
            continue
        else:
            kind = f"{place['processor']}, {place['cores']} cores, {place['threads']} threads"
        kinds[kind] = kinds.get(kind, 0) + 1
    if not kinds:
        return ""
    text = "; ".join(f"{count} of {len(rows)} cells on {kind}" for kind, count in kinds.items())
    return f"Measured elsewhere: {text}. Times and rates of those are not comparable.\n"


def cells(rows: Sequence[Row]) -> str:
    """One line a cell."""
    names = ("model", *(title for title, *_ in _COLUMNS))
    lines = []
    for row in rows:
        if "failed" in row:
            lines.append([row["label"], row["failed"][:80], *[""] * (len(names) - 2)])
            continue
        lines.append([row["label"], *(_in(form, row.get(key), times) for _, key, form, times
                                      in _COLUMNS)])  # fmt: skip
    return table(names, lines)


def brief(rows: Sequence[Row]) -> str:
    """A line a cell, for the end of a run: material, model, time and errors."""
    columns = [column for column in _COLUMNS if column[0] in _PRINTED]
    lines = [
        [row["material"], row["label"], *(_in(form, row.get(key), times) for _, key, form, times
                                          in columns)]
        for row in rows
    ]  # fmt: skip
    return table(("material", "model", *(title for title, *_ in columns)), lines)


def csv_of(rows: Sequence[Row]) -> str:
    """Every number of every cell, a line a cell, by the keys of bench.json."""
    scalars = [
        {key: value for key, value in row.items() if not isinstance(value, (dict, list))}
        for row in rows
    ]
    keys = list(dict.fromkeys(key for row in scalars for key in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, keys, lineterminator="\n")
    writer.writeheader()
    writer.writerows(scalars)
    return text.getvalue()


def latex(rows: Sequence[Row]) -> str:
    """A tabular a material, as papers print them (booktabs); best values in bold."""
    columns = [column for column in _COLUMNS if column[0] in _PRINTED]
    head = " & ".join(["method", *(_escaped(title) for title, *_ in columns)])
    parts = []
    for material in dict.fromkeys(row["material"] for row in rows):
        here = [row for row in rows if row["material"] == material and "failed" not in row]
        lines = [f"% {_escaped(material)}", f"\\begin{{tabular}}{{l{'r' * len(columns)}}}"]
        lines += ["\\toprule", f"{head} \\\\", "\\midrule"]
        for row in here:
            cells_ = [_printed(here, row, column) for column in columns]
            lines.append(" & ".join([_escaped(row["label"]), *cells_]) + " \\\\")
        parts.append("\n".join([*lines, "\\bottomrule", "\\end{tabular}"]))
    return "\n\n".join(parts) + "\n"


def _printed(rows: Sequence[Row], row: Row, column: tuple[str, str, str, float]) -> str:
    title, key, form, times = column
    text = _in(form, row.get(key), times)
    values = [float(each[key]) for each in rows if each.get(key) is not None]
    if not text or title in ("CPU s", "kB"):
        return text
    best = min(values) if title == "FLIP" else max(values)
    return f"\\textbf{{{text}}}" if float(row[key]) == best else text


def _escaped(text: str) -> str:
    """Text as LaTeX prints it."""
    for sign in "&%$#_{}":
        text = text.replace(sign, "\\" + sign)
    return text


def levels(rows: Sequence[Row], title: str, say: Any) -> str:
    """Error by level of detail, of the models that have levels, longest budgets.

    Args:
        title: of the first column. say: the text of one level's errors.
    """
    chosen = {row["label"]: row for row in rows if row.get("levels")}
    if not chosen:
        return ""
    every = sorted({level["level"] for row in chosen.values() for level in row["levels"]})
    lines = []
    for label, row in chosen.items():
        by_level = {level["level"]: say(level) for level in row["levels"]}
        lines.append([label, *(by_level.get(level, "") for level in every)])
    return table([title, *map(str, every)], lines)


def generic(rows: Sequence[Row]) -> str:
    """A table of dicts that share their keys."""
    if not rows:
        return "nothing to compare\n"
    names = list(rows[0])
    return table(names, [[_short(row[name]) for name in names] for row in rows])


def table(names: Sequence[Any], lines: Iterable[Sequence[Any]]) -> str:
    """A table as Markdown has it."""
    rows = [list(map(str, names)), ["---"] * len(names), *(list(map(str, line)) for line in lines)]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows) + "\n"


def _in(form: str, value: Any, times: float = 1) -> str:
    """A number as text, nothing where there is none; infinity may come as text from JSON."""
    return "" if value is None else form.format(float(value) * times)


def _short(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.3g}" if isinstance(value, float) else str(value)
