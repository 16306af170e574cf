"""The loop's error by view angle, and each imperfection's share of it.

    python benchmarks/loop.py                                  # all, none, and without a handful
    python benchmarks/loop.py --without mosaic prnu --seed 3
    python benchmarks/loop.py --small --alone every -o loop    # each by itself, on a small sensor

Each row is a whole run of the twin: capture, calibrate, rectify, compare with the traced truth.
About 45 CPU seconds a row, 20 of the small one (320 x 240, four pairs, 32 x 32 texels).

Shares are of the mean square error of log1p with all imperfections. Of `--without`: by how much it
falls without that one. Of `--alone`: by how much it rises from none to that one; where one
imperfection makes most of the error, only this tells the others apart; mosaic+colour is both.

With -o a folder keeps finished rows (loop.json), is gone on with, and ends in a report, loop.md,
in which shares are listed by size.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import tempfile
from pathlib import Path
from typing import Any

from btfkit.bench.loop import Looped, compare
from btfkit.calibration.calibration import NAME
from btfkit.calibration.stages import calibrate
from btfkit.devices import mock
from btfkit.devices.capture.plan import from_document
from btfkit.devices.capture.run import measure
from btfkit.devices.twin.imperfections import IMPERFECTIONS
from btfkit.devices.twin.log import Twin, TwinLog, everything
from btfkit.files import whole
from btfkit.sequence import Sequence

PLAN: dict[str, Any] = {
    "views": 4, "lights": 3, "reference_every": 30, "whites": 3, "colours": 1, "targets": 16,
    "spheres": 12,
}  # fmt: skip
SMALL: dict[str, Any] = {
    **PLAN, "views": [[0, 0], [60, 120]], "lights": [[30, 60], [60, 250]], "whites": 2,
    "targets": 7, "spheres": 8,
}  # fmt: skip
HANDFUL = ("mosaic", "defocus", "shot-noise")


def looped(folder: Path, twin: Twin, plan: dict[str, Any]) -> Looped:
    """One run of the twin against its truth."""
    run = folder / "run"
    log = TwinLog(run, twin)
    rig = mock.open_rig(log.begin(), log=log)
    measure(rig, from_document("loop", plan), run, synthetic=True)
    found, _ = calibrate(Sequence.open(run))
    found.save(run / NAME)
    return compare(run)


def measured(twin: Twin, plan: dict[str, Any]) -> dict[str, Any]:
    """A row: mean square errors in all and by tilt, directions in degrees, scale, CPU seconds."""
    start = os.times()
    with tempfile.TemporaryDirectory() as folder:
        found = looped(Path(folder), twin, plan)
    now = os.times()
    tilts = sorted(set(found.tilt.tolist()))
    return {
        "mse": 10 ** (-found.psnr() / 10),
        "by_tilt": {str(tilt): 10 ** (-found.psnr(tilt) / 10) for tilt in tilts},
        "view": float(found.view.max()), "light": float(found.light.max()),
        "scale": float(abs(found.scale - 1).max()), "cpu_s": sum(now[:4]) - sum(start[:4]),
    }  # fmt: skip


def share(name: str, rows: dict[str, dict[str, Any]]) -> float:
    """Of the error with all imperfections: what one adds to none, or what falls without it."""
    every = rows["all"]["mse"]
    if name.startswith("alone: "):
        return float((rows[name]["mse"] - rows["none"]["mse"]) / every)
    return float(1 - rows[name]["mse"] / every)


def decibels(mse: float) -> str:
    """Of a mean square error, peak 1."""
    return f"{-10 * math.log10(mse):.1f}"


def line(name: str, rows: dict[str, dict[str, Any]]) -> str:
    """A row as a line of a table."""
    row = rows[name]
    cells = [*(decibels(mse) for mse in row["by_tilt"].values()), decibels(row["mse"])]
    cells += [f"{100 * share(name, rows):.1f} %", f"{row['view']:.3f}", f"{row['light']:.3f}"]
    return (
        f"| {name} | " + " | ".join([*cells, f"{row['scale']:.3f}", f"{row['cpu_s']:.0f}"]) + " |"
    )


def report(asked: dict[str, Any], rows: dict[str, dict[str, Any]]) -> str:
    """All rows, and the imperfections by their shares."""
    tilts = [f"{tilt}°" for tilt in rows["all"]["by_tilt"]]
    heads = ["", *tilts, "all, dB", "share", "view, °", "light, °", "scale", "CPU s"]
    table = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    single = [name for name in rows if name not in ("all", "none")]
    ordered = sorted(single, key=lambda name: -share(name, rows))
    table += [line(name, rows) for name in ("all", "none", *ordered)]
    return "\n".join([f"# The loop: synthetic, {asked}", "", *table, ""])


def main() -> None:
    """A row for all imperfections, for none, and with or without each alone."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--without", nargs="*")
    parser.add_argument("--alone", nargs="*")
    parser.add_argument("--seed", type=int, default=8)
    parser.add_argument("--small", action="store_true")
    parser.add_argument("-o", "--out", type=Path)
    given = parser.parse_args()
    nothing_asked = given.without is None and given.alone is None
    without, alone = (
        list(IMPERFECTIONS) if names == ["every"] else names or []
        for names in (list(HANDFUL) if nothing_asked else given.without, given.alone)
    )
    wanted: dict[str, tuple[str, ...]] = {"all": (), "none": everything()}
    wanted |= {f"all but {name}": (name,) for name in without}
    wanted |= {
        f"alone: {n}": tuple(x for x in IMPERFECTIONS if x not in n.split("+")) for n in alone
    }
    asked = {"seed": given.seed, "size": [320, 240] if given.small else [640, 480]}
    rows: dict[str, dict[str, Any]] = {}
    kept = None if given.out is None else given.out / "loop.json"
    if kept is not None and kept.exists():
        held = json.loads(kept.read_text())
        if held["asked"] != asked:
            raise SystemExit(f"{kept} is of {held['asked']}, not of {asked}; name another folder")
        rows = held["rows"]
    for name, off in wanted.items():
        if name not in rows:
            width, height = asked["size"]
            twin = Twin(seed=given.seed, without=off, width=width, height=height)
            rows[name] = measured(twin, SMALL if given.small else PLAN)
            if kept is not None:
                kept.parent.mkdir(parents=True, exist_ok=True)
                with whole(kept, force=True) as partial:
                    partial.write_text(json.dumps({"asked": asked, "rows": rows}, indent=1))
        print(line(name, rows), flush=True)
    if given.out is not None:
        with whole(given.out / "loop.md", force=True) as partial:
            partial.write_text(report(asked, rows), encoding="utf-8")


if __name__ == "__main__":
    main()
