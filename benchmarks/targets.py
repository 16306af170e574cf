"""How far the benchmark's targets are met: what its finished runs say, and nothing else.

Only runs that ended at a budget count: the course of a longer one, whose rate still is high, is
not a run of that budget.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from btfkit.bench.tables import generic

Row = Mapping[str, Any]


def targets(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """A line a comparison: material, what is compared, the target, what was measured."""
    found = []
    good = [row for row in rows if "failed" not in row]
    for material in dict.fromkeys(row["material"] for row in good):
        here = [row for row in good if row["material"] == material]
        ours, paper = (_runs(here, model, {}) for model in ("neumip", "neumip-paper"))
        flat = _runs(here, "neumip", {"offset": "0"})
        lines = [
            _passing(ours, paper),
            _equal_time(ours, paper),
            _offset_stage(ours, flat),
            *(_falling(runs[-1]) for runs in (ours, paper) if runs),
        ]
        found += [{"material": material, **line} for line in lines if line]
    return found


def _passing(ours: Sequence[Row], paper: Sequence[Row]) -> dict[str, str]:
    """The shortest budget at which neumip passes the published recipe's longest run."""
    if not ours or not paper:
        return {}
    goal = paper[-1]
    first = next((row for row in ours if row["mse_log1p"] <= goal["mse_log1p"]), None)
    best = max(ours, key=lambda row: float(row["psnr_log1p"]))
    return {
        "what": f"neumip passes neumip-paper's {_decibel(goal)} after {_budget(goal)}",
        "target": "15 CPU s against 600",
        "measured": f"not passed: {_decibel(best)} after {_budget(best)}"
        if first is None
        else f"within {_budget(first)}: {_decibel(first)}",
    }


def _equal_time(ours: Sequence[Row], paper: Sequence[Row]) -> dict[str, str]:
    pair = _longest_common(ours, paper)
    if pair is None:
        return {}
    gain = float(pair[0]["psnr_log1p"]) - float(pair[1]["psnr_log1p"])
    return {
        "what": f"neumip over neumip-paper, both after {_budget(pair[0])}",
        "target": "+2 dB (log1p)",
        "measured": f"{gain:+.2f} dB",
    }


def _offset_stage(ours: Sequence[Row], flat: Sequence[Row]) -> dict[str, str]:
    pair = _longest_common(ours, flat)
    if pair is None:
        return {}
    # A perfect answer is told by its own zero, not by an infinite gain.
    log, linear = (pair[1][key] / max(pair[0][key], 1e-30) for key in ("mse_log1p", "mse"))
    return {
        "what": f"offset stage lowers the mse, both after {_budget(pair[0])}",
        "target": "2.7 x where there is parallax",
        "measured": f"{log:.2f} x (log1p), {linear:.2f} x (linear)",
    }


def _falling(row: Row) -> dict[str, str]:
    """Whether the error falls from each level to the next, and where it does not."""
    levels = row.get("levels") or []
    if len(levels) < 2:
        return {}
    rising = [
        f"{coarse['level']} ({coarse['mse'] / max(fine['mse'], 1e-30):.2f} x)"
        for fine, coarse in pairwise(levels)
        if coarse["mse"] >= fine["mse"]
    ]
    overall = levels[0]["mse"] / max(levels[-1]["mse"], 1e-30)
    steps = f"{len(levels) - 1 - len(rising)} of {len(levels) - 1} levels"
    return {
        "what": f"{row['label']}: mse falls with coarser levels, after {_budget(row)}",
        "target": "at every level",
        "measured": f"at {steps}, {overall:.1f} x over all"
        + (f"; rises at {', '.join(rising)}" if rising else ""),
    }


def _longest_common(some: Iterable[Row], others: Iterable[Row]) -> tuple[Row, Row] | None:
    """The rows of the longest budget that both have."""
    theirs = {row["budget_cpu_s"]: row for row in others}
    both = [row for row in some if row["budget_cpu_s"] in theirs]
    return (both[-1], theirs[both[-1]["budget_cpu_s"]]) if both else None


def _runs(rows: Iterable[Row], model: str, settings: Mapping[str, str]) -> list[Row]:
    chosen = [row for row in rows if row["model"] == model and row["settings"] == settings]
    return sorted(chosen, key=lambda row: row["budget_cpu_s"] or 0)


def _budget(row: Row) -> str:
    return f"{row['budget_cpu_s']:g} CPU s"


def _decibel(row: Row) -> str:
    return f"{float(row['psnr_log1p']):.2f} dB"


def main() -> None:
    """A table of the targets from a bench.json: python benchmarks/targets.py bench/bench.json."""
    rows = json.loads(Path(sys.argv[1]).read_text())["cells"]
    print(generic(targets(rows)))


if __name__ == "__main__":
    main()
