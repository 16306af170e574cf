"""Reliefs found in traced BTFs: error of each source and of the fusion against CPU seconds.

    python benchmarks/heightfield.py [--sizes 32,64,128] [--relief TEXELS] [--budget 20] NAME...

Synthetic: Bonn-81 lights and views, four rays a texel. Only the pairs that are read are traced;
their tracing is not counted. Prints one JSON object a line and a table.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace

import numpy as np

from btfkit.fitting.heightfield import find_relief
from btfkit.fitting.heightfield.accuracy import against_truth, rerendered
from btfkit.relief import procedural, synth
from btfkit.relief.stack import chosen


def measure(
    name: str, size: int, relief_texels: float | None, budget_s: float
) -> dict[str, object]:
    """One material at one size: what the report states, and errors against the truth."""
    truth = procedural.make(name, size, relief_texels=relief_texels)
    lazy = synth.relief_btf(truth)
    btf = lazy.subset(np.sort(chosen(lazy)))
    btf = replace(btf, textures=btf.batch(np.arange(len(btf))))
    cpu, start = time.process_time(), time.perf_counter()
    found = find_relief(btf, budget_s=budget_s, holdout=0.0)
    row = {
        "material": name, "size": size, "cpu_s": time.process_time() - cpu,
        "seconds": time.perf_counter() - start, **against_truth(found, truth),
    }  # fmt: skip
    return {**row, "psnr_log1p": rerendered(found, btf)["psnr_log1p"], "figures": found.figures}


def main() -> None:
    """Measure and print."""
    ask = argparse.ArgumentParser(description=__doc__)
    ask.add_argument("names", nargs="+")
    ask.add_argument("--sizes", default="32,64,128")
    ask.add_argument("--relief", type=float)
    ask.add_argument("--budget", type=float, default=20.0)
    given = ask.parse_args()
    rows = []
    for name in given.names:
        for size in map(int, given.sizes.split(",")):
            rows.append(measure(name, size, given.relief, given.budget))
            print(json.dumps(rows[-1], default=str), flush=True)
    print("| material | size | range | CPU s | normals, degrees", end=" | ")
    print(
        "model | normals | parallax | fusion | fusion, half | filtered, half | by tenths of depth |"
    )
    for row in rows:
        heights: dict[str, dict[str, float]] = row["heights"]  # type: ignore[assignment]
        cells = [f"{heights[k]['rms']:.3f}" if k in heights else "-"
                 for k in ("model", "normals", "parallax", "fusion")]  # fmt: skip
        last = heights.get("fusion", heights["normals"])
        print(
            f"| {row['material']} | {row['size']} | {row['range_texels']:.1f} | {row['cpu_s']:.0f} "
            f"| {row['normal_median_deg']:.2f} / {row['normal_mean_deg']:.2f} | "
            + " | ".join(cells)
            + f" | {last['rms_half']:.3f} | {last['rms_filtered_half']:.3f} | "
            + " ".join(f"{part:.2f}" for part in row["by_depth"])
            + " |"  # type: ignore[attr-defined]
        )


if __name__ == "__main__":
    main()
