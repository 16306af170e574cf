"""The loop's error by view angle, and each imperfection's share of it.

    python benchmarks/loop.py                                  # a handful of imperfections
    python benchmarks/loop.py --without mosaic prnu --seed 3

Each row is a whole run of the twin: capture, calibrate, rectify, compare with the traced truth.
About 25 CPU seconds a row.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from btfkit.bench.loop import Looped, compare

PLAN = (
    '{"views": 4, "lights": 3, "reference_every": 30, "whites": 3, "colours": 1, "targets": 16, '
    '"spheres": 12}'
)
HANDFUL = ("mosaic", "defocus", "shot-noise")
BTFKIT = Path(sys.executable).with_name("btfkit")


def looped(folder: Path, options: list[str], seed: int) -> Looped:
    """One run of the twin against its truth."""
    plan, run = folder / "plan.json", folder / "run"
    plan.write_text(PLAN)
    for line in (
        ["capture", "--device", "mock", "--plan", plan, "-o", run, "--seed", str(seed), *options],
        ["calibrate", run],
    ):
        subprocess.run([BTFKIT, *map(str, line), "--quiet"], check=True, stdout=subprocess.DEVNULL)
    return compare(run)


def main() -> None:
    """A row for all imperfections, for none, and without each alone."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--without", nargs="*", default=list(HANDFUL))
    parser.add_argument("--seed", type=int, default=8)
    given = parser.parse_args()
    rows = {"all": [], "none": ["--perfect"]}
    rows |= {f"all but {name}": ["--without", name] for name in given.without}
    first: float | None = None
    for name, options in rows.items():
        start = os.times()
        with tempfile.TemporaryDirectory() as folder:
            found = looped(Path(folder), options, given.seed)
        now = os.times()
        cpu = sum(now[:4]) - sum(start[:4])
        error = 10 ** (-found.psnr() / 10)
        first = error if first is None else first
        by_view = [found.psnr(tilt) for tilt in sorted(set(found.tilt.tolist()))]
        cells = [*(f"{value:.1f}" for value in (*by_view, found.psnr()))]
        cells += [f"{100 * (1 - error / first):.0f} %", f"{found.view.max():.3f}"]
        cells += [f"{found.light.max():.3f}", f"{abs(found.scale - 1).max():.3f}", f"{cpu:.0f}"]
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
