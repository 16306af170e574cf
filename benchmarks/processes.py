"""One fit by two processes of torchrun beside two threads, and beside one (docs/scale.md).

python benchmarks/processes.py wool.btf.zarr [--steps 400] [--repeats 3]

Wall times depend on what else runs: the three take turns. Processor seconds are of all processes,
beyond what the same command with a tenth of the steps takes.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

WAYS = {"1 thread": (1, 1), "2 threads": (1, 2), "2 processes": (2, 1)}


def run(store: Path, out: Path, steps: int, processes: int, threads: int) -> dict[str, float]:
    """Steps a second while training, error, and CPU seconds of the whole command."""
    environment = {
        **os.environ, "BTFKIT_THREADS": str(threads), "OMP_NUM_THREADS": str(threads),
    }  # fmt: skip
    start = ["-m", "btfkit"]
    if processes > 1:
        start = ["-m", "torch.distributed.run", "--nproc-per-node", str(processes), *start]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [sys.executable, *start, "fit", str(store), "--model", "neumip", "--steps", str(steps),
         "--holdout", "0.005", "--no-preview", "--quiet", "--force", "-o", str(out)],
        env=environment, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    report = json.loads(out.with_name("m.report.json").read_text())
    return {
        "cpu": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
        "rate": report["steps"] / report["seconds"],
        "queries": report["queries"],
        "psnr": report["psnr_log1p"],
    }


def main() -> None:
    """Print each run, and the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("store", type=Path)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--repeats", type=int, default=3)
    asked = parser.parse_args()
    found: dict[str, list[tuple[dict[str, float], dict[str, float]]]] = {way: [] for way in WAYS}
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "m.safetensors"
        for _time in range(asked.repeats):
            for way, (processes, threads) in WAYS.items():
                few, all_ = (
                    run(asked.store, out, steps, processes, threads)
                    for steps in (asked.steps // 10, asked.steps)
                )
                found[way].append((few, all_))
                print(
                    f"{time.strftime('%X')} load {os.getloadavg()[0]:.1f} {way}: {all_}", flush=True
                )
    print("\n| way | queries | CPU ms a step | steps a second, median and best | PSNR log1p |")
    print("|---|---|---|---|---|")
    for way, runs in found.items():
        cpu = statistics.median(a["cpu"] - f["cpu"] for f, a in runs) / (0.9 * asked.steps)
        rates = [a["rate"] for _, a in runs]
        psnr = statistics.median(a["psnr"] for _, a in runs)
        print(
            f"| {way} | {runs[0][1]['queries']} | {1e3 * cpu:.2f} | "
            f"{statistics.median(rates):.0f}, {max(rates):.0f} | {psnr:.2f} |"
        )


if __name__ == "__main__":
    main()
