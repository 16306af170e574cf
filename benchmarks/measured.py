"""`sbtf` of a BTF, whose outlines are those of the relief that its pictures imply (Fig. 11).

    python benchmarks/measured.py SAMPLE.btf.zarr [--steps K]
    python benchmarks/measured.py knit [--size N] [--texels T] [--steps K] [--picture FILE.jpg]

One line of JSON: errors of all held-out pairs on the plane, of `sbtf` and `neumip` trained for as
much CPU time as `sbtf` and its relief took; the model's heights about the plane (least, 1, 50,
99 %, most); and the share of rays that are opaque, over the whole tile and all azimuths, by the
curvature along the view (1/tile width) and its angle, of the model as it is and moved under its
highest point.

A name of the catalogue in place of a store is traced first, under its surface, 81 views by 30
lights. Then the tracer's own shares stand beside, and the IoU of outlines on the fixed torus of
`sbtf.py`; the picture is that torus traced, by `neumip` and by `sbtf` so moved.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sbtf import draw, torus, torus_outline

import btfkit
from btfkit import metrics
from btfkit.btf import BTF
from btfkit.fitting.report import FitReport
from btfkit.materials.base import Material
from btfkit.materials.sbtf.material import SBTF
from btfkit.relief import procedural
from btfkit.relief.material import TracedRelief
from btfkit.relief.synth import relief_btf

ANGLES = (60.0, 70.0, 75.0, 80.0, 85.0, 88.0)  # degrees
BENDS = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0)  # 1/tile width
RAYS = 20000
# Steps by which the speed of `neumip` is judged.
TRIAL = 300


def fits(data: BTF, steps: int) -> dict[str, tuple[FitReport, float]]:
    """`sbtf` and, in as much CPU time, `neumip`: what was fitted, and CPU seconds with reading."""
    ours, spent = _fitted(data, "sbtf", steps)
    trial, took = _fitted(data, "neumip", TRIAL)
    rate = trial.cpu_seconds / TRIAL
    enough = TRIAL + (spent - took) / rate
    return {"sbtf": (ours, spent), "neumip": _fitted(data, "neumip", max(round(enough), TRIAL))}


def _fitted(data: BTF, model: str, steps: int) -> tuple[FitReport, float]:
    start = time.process_time()
    report = btfkit.fit(data, model=model, steps=steps, full_report=True, settings={"levels": 1})
    return report, time.process_time() - start


def opaque(material: Material, depth: float) -> dict[str, list[float]]:
    """Shares of rays that are stopped, at each of `ANGLES`, by curvature up to 0.85 / depth."""
    rng = np.random.default_rng(4)
    uv = rng.random((RAYS, 2), np.float32)
    azimuth = 2 * np.pi * rng.random(RAYS)
    up = np.broadcast_to(np.float32([0, 0, 1]), (RAYS, 3))
    found: dict[str, list[float]] = {}
    for bend in (bend for bend in BENDS if bend * depth < 0.85):
        shares = []
        for theta in np.radians(ANGLES):
            view = _view(theta, azimuth)
            shares.append(float(material.evaluate(uv, up, view, 0.5, bend).opacity.mean()))
        found[f"{bend:g}"] = shares
    return found


def _view(theta: float, azimuth: NDArray[np.float64]) -> NDArray[np.float32]:
    flat = np.sin(theta)
    parts = [flat * np.cos(azimuth), flat * np.sin(azimuth), 0 * azimuth + np.cos(theta)]
    return np.stack(parts, axis=1).astype(np.float32)


def measured(given: argparse.Namespace) -> dict[str, Any]:
    """All figures of a sample."""
    relief = None
    if given.sample in procedural.CATALOGUE:
        made = procedural.make(given.sample, given.size, relief_texels=given.texels)
        relief = made.under_surface()[0]
        data = relief_btf(relief, views="bonn81", lights="30")
    else:
        data = btfkit.open(given.sample)
    found: dict[str, Any] = {"sample": given.sample, "angles_deg": ANGLES}
    both = fits(data, given.steps)
    for model, (report, spent) in both.items():
        keys = ("psnr", "psnr_log1p", "ssim_srgb", "pairs")
        found[model] = {key: report.errors[key] for key in keys}
        found[model] |= {"cpu_s": spent, "steps": report.steps}
    ours, flat = (both[model][0].material for model in ("sbtf", "neumip"))
    assert isinstance(ours, SBTF)
    heights = ours.layout.surface(ours.texels) * ours.spec.depth_scale
    found["heights"] = np.quantile(heights, [0, 0.01, 0.5, 0.99, 1]).tolist()
    found["choice"] = list(both["sbtf"][0].choice)
    under = ours.under_surface()[0]
    found["opaque"] = opaque(ours, under.thickness)
    found["opaque, under its highest point"] = opaque(under, under.thickness)
    if relief is not None:
        truth = TracedRelief(relief)
        found["opaque, traced"] = opaque(truth, truth.thickness)
        outline = torus_outline(relief)
        for model, material in (("sbtf", under), ("neumip", flat)):
            found[model]["torus_iou"] = metrics.iou(torus(material).cover > 0.5, outline)
        if given.picture:
            draw(given.picture, [truth, flat, under])
    return found


def main() -> None:
    """One line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("sample")
    parser.add_argument("--size", type=int, default=64, help="of a traced one, texels a side")
    parser.add_argument("--texels", type=float, default=6.0, help="its depth")
    parser.add_argument("--steps", type=int, default=4000, help="of sbtf")
    parser.add_argument("--picture", type=Path)
    print(json.dumps(measured(parser.parse_args())), flush=True)


if __name__ == "__main__":
    main()
