"""The benchmark in words: tables for people."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from btfkit.bench.machine import same

Row = Mapping[str, Any]


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
    for title, key in (
        ("Kernels, one thread", "kernels"),
        ("The loop beside its kernel", "loop"),
        ("What each skip saves", "skips"),
        ("Region of interest", "regions"),
    ):
        if key in results:
            parts += [f"## {title}\n", generic(results[key])]
    parts += ["## Targets\n", generic(results["targets"])]
    return "\n".join(part for part in parts if part) + "\n"


def others(rows: Sequence[Row], machine: Row) -> str:
    """Which cells come from elsewhere than the machine that is named; empty where none does."""
    kinds: dict[str, int] = {}
    for row in rows:
        place = row.get("machine")
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
    names = (
        "model", "CPU s", "wall s", "steps", "log1p dB", "dB", "sRGB dB", "SSIM", "FLIP",
        "weights", "kB", "Mquery/CPU s", "% peak", "MB more",
    )  # fmt: skip
    lines = []
    for row in rows:
        if "failed" in row:
            lines.append([row["label"], row["failed"][:80], *[""] * (len(names) - 2)])
            continue
        lines.append(
            [
                row["label"], _in("{:.1f}", row["cpu_seconds"]), _in("{:.1f}", row["seconds"]),
                row["steps"], _in("{:.2f}", row["psnr_log1p"]), _in("{:.2f}", row["psnr"]),
                _in("{:.2f}", row.get("psnr_srgb")), _in("{:.3f}", row.get("ssim_srgb")),
                _in("{:.3f}", row.get("flip")), row["parameters"],
                _in("{:.0f}", row["bytes"], 1e-3), _in("{:.2f}", row["queries_per_cpu_s"], 1e-6),
                _in("{:.0f}", row["share_of_peak"], 100),
                _in("{:.0f}", row["peak_memory_bytes"], 1e-6),
            ]
        )  # fmt: skip
    return _table(names, lines)


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
    return _table([title, *map(str, every)], lines)


def generic(rows: Sequence[Row]) -> str:
    """A table of dicts that share their keys."""
    if not rows:
        return "nothing to compare\n"
    names = list(rows[0])
    return _table(names, [[_short(row[name]) for name in names] for row in rows])


def _table(names: Sequence[Any], lines: Iterable[Sequence[Any]]) -> str:
    rows = [list(map(str, names)), ["---"] * len(names), *(list(map(str, line)) for line in lines)]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows) + "\n"


def _in(form: str, value: Any, times: float = 1) -> str:
    """A number as text, nothing where there is none; infinity may come as text from JSON."""
    return "" if value is None else form.format(float(value) * times)


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
