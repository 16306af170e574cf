"""How fast the tracer answers: random queries on a 256 x 256 relief, direct light and bounces.

    python benchmarks/trace.py [--quick] [--json]

One ray a query, places uniform over the tile, lights and views uniform over the projected
hemisphere to 75 degrees. Settings take turns, so that what else the machine does falls on all of
them; figures are medians over rounds. CPU seconds count what the threads used, wall seconds what
passed: on a busy machine only the first says something about the kernel.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import time
from collections import defaultdict
from typing import Any, NamedTuple

import numpy as np

from btfkit import native
from btfkit.native import trace as kernel
from btfkit.relief import procedural, trace

SIZE, STEEPEST_DEG = 256, 75.0
# Name -> height of the structure, texels. 0.08 of a tile is strong relief: rays cross many cells.
MATERIALS = {"cobbles": 0.08 * SIZE, "woven": 1.5, "print": 0.3}
UP = np.array([0.0, 0.0, 1.0], np.float32)


class Setting(NamedTuple):
    """One row of the table."""

    material: str
    bounces: int
    threads: int
    curved: bool = False
    straight: bool = False


def settings(most: int) -> list[Setting]:
    """All rows; `most` threads at the most."""
    counts = sorted({1, min(2, most)})
    rows = [Setting(m, b, t) for m in MATERIALS for b in (0, 2) for t in counts]
    rows += [Setting("cobbles", 0, t, curved=True) for t in counts]
    # Straight down, lit from above: no way over the relief, only what every query costs.
    return [*rows, Setting("cobbles", 0, 1, straight=True)]


class Asked(NamedTuple):
    """Queries as the kernel takes them."""

    place: np.ndarray
    light: np.ndarray
    view: np.ndarray
    footprint: np.ndarray
    curvature: np.ndarray


def queries(setting: Setting, count: int) -> Asked:
    """Random queries, the same in every run."""
    rng = np.random.default_rng(1)
    lowest = float(np.cos(np.radians(STEEPEST_DEG)))
    light, view = (trace._on_disk(rng, count, lowest) for _ in range(2))
    curvature = np.zeros(count, np.float32)
    if setting.curved:
        light, view = trace._on_sphere(rng, count, -1), trace._on_sphere(rng, count, 0.02)
        curvature = np.full(count, 1.0 / SIZE, np.float32)
    if setting.straight:
        light, view = (np.tile(UP, (count, 1)) for _ in range(2))
    place = (rng.random((count, 2)) * SIZE - 0.5).astype(np.float32)
    return Asked(place, light, view, np.full(count, 0.5, np.float32), curvature)


def cells(geometry: kernel.Geometry, asked: Asked, seen: kernel.Traced) -> float:
    """Mean cells that view and shadow rays cross, from where they begin and end."""
    sides = [np.abs(d[:, 0]) + np.abs(d[:, 1]) for d in (asked.view, asked.light)]
    rise = geometry.highest - seen.height
    view = 1 + rise / asked.view[:, 2] * sides[0]
    shadow = np.where(seen.visible > 0, 1 + rise / asked.light[:, 2] * sides[1], 1)
    return float(np.mean(view + shadow))


def measured(count: int, rounds: int) -> list[dict[str, Any]]:
    """Every setting, `rounds` times in turn."""
    reliefs = {
        name: trace.geometry(procedural.make(name, SIZE, relief_texels=texels))
        for name, texels in MATERIALS.items()
    }
    rows = settings(native.threads())
    asked = {row: queries(row, count) for row in rows}
    times: defaultdict[Setting, list[tuple[float, float]]] = defaultdict(list)
    answers = {}
    for turn in range(rounds + 1):
        for row in rows:
            os.environ["BTFKIT_THREADS"] = str(row.threads)
            wall, cpu = time.perf_counter(), time.process_time()
            answers[row] = kernel.trace(
                reliefs[row.material], *asked[row], samples=1, bounces=row.bounces
            )
            spent = time.perf_counter() - wall, time.process_time() - cpu
            if turn:  # the first touches memory for the first time
                times[row].append(spent)
    found = []
    for row in rows:
        wall, cpu = (statistics.median(column) for column in zip(*times[row], strict=True))
        one: dict[str, Any] = {
            **row._asdict(), "mq_per_s": count / wall / 1e6, "mq_per_cpu_s": count / cpu / 1e6,
            "best_mq_per_s": count / min(t for t, _ in times[row]) / 1e6,
            "best_mq_per_cpu_s": count / min(t for _, t in times[row]) / 1e6,
            "ns_per_query": cpu / count * 1e9,
        }  # fmt: skip
        if not row.curved:
            one["cells"] = cells(reliefs[row.material], asked[row], answers[row])
        found.append(one)
    return found


def main() -> None:
    """Measure, and print a table or JSON."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="fewer queries and rounds")
    parser.add_argument("--json", action="store_true", help="one JSON object")
    options = parser.parse_args()
    count, rounds = (100_000, 3) if options.quick else (300_000, 5)
    if native.load("trace") is None:
        raise SystemExit("the tracing kernel was not built: this measures the compiled form")
    before = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    rows = measured(count, rounds)
    about = {
        "machine": platform.processor() or platform.machine(), "processors": os.cpu_count(),
        "load_before": before, "queries": count, "rounds": rounds, "rows": rows,
    }  # fmt: skip
    if options.json:
        print(json.dumps(about))
        return
    print(f"{count} queries, median of {rounds}; {os.cpu_count()} processors, load {before:.1f}")
    print("material  kind      bounces threads  Mq/s (best)   Mq/CPU-s (best)  ns/query  cells")
    for row in rows:
        kind = "cylinder" if row["curved"] else ("upright" if row["straight"] else "plane")
        print(
            f"{row['material']:<9} {kind:<9} {row['bounces']:7d} {row['threads']:7d} "
            f"{row['mq_per_s']:6.2f} ({row['best_mq_per_s']:5.2f}) "
            f"{row['mq_per_cpu_s']:8.2f} ({row['best_mq_per_cpu_s']:5.2f}) "
            f"{row['ns_per_query']:9.0f} {row.get('cells', float('nan')):6.1f}"
        )


if __name__ == "__main__":
    main()
