"""The benchmark in words: tables for people, and how far its targets are met."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

Row = Mapping[str, Any]


def markdown(found: Mapping[str, Any]) -> str:
    """Everything that bench.json holds, as a page."""
    machine = found["machine"]
    peak = machine["peak_gflops_one_thread"]
    parts = [
        "# btfkit bench\n",
        f"{machine['processor']}, {machine['cores']} cores, {machine['threads']} threads; "
        f"{machine['system']}; "
        f"{machine['compiler']}; Python {machine['python']}; kernels {machine['variants']}; "
        + (f"measured peak {peak:.0f} GFLOP/s a thread.\n" if peak else "no kernels built.\n"),
    ]
    rows = found["cells"]
    for material in dict.fromkeys(row["material"] for row in rows):
        parts.append(f"## {material}\n")
        parts.append(cells([row for row in rows if row["material"] == material]))
        parts.append(levels([row for row in rows if row["material"] == material]))
    for title, key in (
        ("Kernels, one thread", "kernels"),
        ("The loop beside its kernel", "loop"),
        ("What each skip saves", "skips"),
        ("Region of interest", "regions"),
    ):
        if key in found:
            parts += [f"## {title}\n", generic(found[key])]
    parts += ["## Targets\n", generic(found["targets"])]
    return "\n".join(part for part in parts if part) + "\n"


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
        share, memory = row["share_of_peak"], row["peak_memory_bytes"]
        lines.append(
            [
                row["label"], f"{row['cpu_seconds']:.1f}", f"{row['seconds']:.1f}", row["steps"],
                f"{row['psnr_log1p']:.2f}", f"{row['psnr']:.2f}", f"{row['psnr_srgb']:.2f}",
                f"{row['ssim_srgb']:.3f}", f"{row['flip']:.3f}", row["parameters"],
                f"{row['bytes'] / 1e3:.0f}", f"{row['queries_per_cpu_s'] / 1e6:.2f}",
                "" if share is None else f"{100 * share:.0f}",
                "" if memory is None else f"{memory / 1e6:.0f}",
            ]
        )  # fmt: skip
    return _table(names, lines)


def levels(rows: Sequence[Row]) -> str:
    """Error by level of detail, of the models that have levels, longest budgets."""
    chosen = {row["label"]: row for row in rows if row.get("levels")}
    if not chosen:
        return ""
    count = max(len(row["levels"]) for row in chosen.values())
    names = ["mse x 1e-3 by level", *map(str, range(count))]
    lines = [
        [label, *(f"{1e3 * level['mse']:.3f}" for level in row["levels"])]
        for label, row in chosen.items()
    ]
    return _table(names, lines)


def generic(rows: Sequence[Row]) -> str:
    """A table of dicts that share their keys."""
    if not rows:
        return "nothing to compare\n"
    names = list(rows[0])
    return _table(names, [[_short(row[name]) for name in names] for row in rows])


def targets(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """NeuMIP against its published recipe, and with against without its offset stage."""
    found = []
    good = [row for row in rows if "failed" not in row]
    for material in dict.fromkeys(row["material"] for row in good):
        here = [row for row in good if row["material"] == material]
        ours = _runs(here, "neumip", {})
        paper = _runs(here, "neumip-paper", {})
        if ours and paper:
            first = next((r for r in ours if r["mse_log1p"] <= paper[-1]["mse_log1p"]), None)
            gain = ours[-1]["psnr_log1p"] - paper[-1]["psnr_log1p"]
            found.append(
                {
                    "material": material,
                    "what": f"error of neumip-paper after {paper[-1]['cpu_seconds']:.0f} CPU s "
                    f"({paper[-1]['psnr_log1p']:.2f} dB)",
                    "measured": "not passed"
                    if first is None
                    else f"passed within {first['cpu_seconds']:.1f} CPU s",
                    "at equal time": f"{gain:+.2f} dB",
                }
            )
        flat = _runs(here, "neumip", {"offset": "0"})
        if ours and flat:
            log, linear = (flat[-1][key] / ours[-1][key] for key in ("mse_log1p", "mse"))
            found.append(
                {
                    "material": material,
                    "what": "offset stage lowers the mse",
                    "measured": f"{log:.2f} x (log1p), {linear:.2f} x (linear)",
                    "at equal time": "",
                }
            )
    return found


def _runs(rows: Iterable[Row], model: str, settings: Mapping[str, str]) -> list[Row]:
    chosen = [row for row in rows if row["model"] == model and row["settings"] == settings]
    return sorted(chosen, key=lambda row: row["budget_cpu_s"] or 0)


def _table(names: Sequence[Any], lines: Iterable[Sequence[Any]]) -> str:
    rows = [list(map(str, names)), ["---"] * len(names), *(list(map(str, line)) for line in lines)]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows) + "\n"


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
