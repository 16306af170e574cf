"""The demo's second act: a virtual rig measures a cloth, and what comes out meets the truth.

Everything here is synthetic: the rig exists in the process only, behind the driver of a real one.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

Run = Callable[..., None]
# A dozen pairs; everything that the calibration wants to see.
PLAN = {
    "version": 1, "name": "a dozen", "views": 4, "lights": 3, "reference_every": 30, "whites": 3,
    "colours": 1, "targets": 12, "spheres": 12,
}  # fmt: skip
# Two texels of the sample: 2.8 pixels of the mosaic, seen from above.
TEXEL_MM = 0.5625


def measure(here: Path, run: Run) -> None:
    """Capture, calibrate, ingest; then the picture of it."""
    (here / "rig.json").write_text(json.dumps(PLAN))
    options = "--plan rig.json --seed 5 --truth rig-truth.btf.zarr"
    run(f"capture --device mock -o rig {options}", makes="rig-truth.btf.zarr")
    run("calibrate rig", makes="rig/calibration.json")
    run(f"ingest rig --texel-mm {TEXEL_MM}", makes="rig.btf.zarr")
    picture(here)


def picture(here: Path) -> None:
    """The rig, a raw frame, the rectified texture, the truth and their difference, side by side."""
    import numpy as np
    from matplotlib.figure import Figure

    import btfkit
    from btfkit.colour import to_srgb
    from btfkit.devices.twin.truth import blurred

    if (here / "rig.png").exists():
        return
    truth = btfkit.open(here / "rig-truth.btf.zarr")
    captured = btfkit.open(here / "rig.btf.zarr")
    pair = int(captured.view[:, 2].argsort()[len(captured) // 2])
    found = captured.texture(pair)
    blur = np.nanmean(captured.blurs.of_pair(pair), (0, 1))
    wanted = blurred(truth.texture(pair), blur)
    white = 1.2 * wanted.max()
    figure = Figure(figsize=(17, 4), layout="constrained")
    drawn = figure.add_subplot(1, 5, 1, projection="3d")
    _rig(drawn, captured, here / "rig" / "calibration.json")
    panels: list[tuple[str, Any]] = [
        ("a raw frame, brightened", _raw(here / "rig", pair)),
        ("rectified", to_srgb((found / white).clip(0, 1))),
        ("truth", to_srgb((wanted / white).clip(0, 1))),
        ("difference, × 20", (0.5 + 20 * (found - wanted) / white).clip(0, 1)),
    ]
    for place, (title, image) in enumerate(panels):
        axis = figure.add_subplot(1, 5, 2 + place)
        axis.imshow(image, cmap="gray")
        axis.set_title(title)
        axis.set_axis_off()
    figure.savefig(here / "rig.png", dpi=100)


def _raw(folder: Path, pair: int) -> Any:
    """(h, w) the shortest exposure of a pair, 0 to 1, brightened for the eye."""
    from btfkit.sequence import Sequence

    sequence = Sequence.open(folder)
    group = list(sequence.groups("sample").values())[pair]
    first = min(group, key=lambda i: sequence.frames[i].need("exposure_s"))
    black, white = sequence.sensor.need("black"), sequence.sensor.need("white")
    return ((sequence.image(first) - black) / (white - black)).clip(0, 1) ** 0.45


def _rig(axis: Any, captured: Any, document: Path) -> None:
    """Cameras and lamps of all pairs about the sample, and the axes as they were calibrated."""
    import numpy as np

    from btfkit.calibration.calibration import Calibration
    from btfkit.calibration.stages import geometry_of

    geometry = geometry_of(Calibration.load(document))
    corners = 60 * np.array([[-1, -0.75], [1, -0.75], [1, 0.75], [-1, 0.75], [-1, -0.75]])
    axis.plot(*corners.T, 0, color="0.4")
    for name, places, colour in (
        ("camera", captured.view_position, "C0"), ("lamp", captured.light_position, "C1"),
    ):  # fmt: skip
        axis.scatter(*places.T, s=14, color=colour, label=name)
        for place in places:
            axis.plot(*np.stack([place, 0 * place]).T, color=colour, linewidth=0.3)
    for each in geometry.kinematics.axes:
        line = each.point_mm + np.linspace(-500, 500, 2)[:, None] * each.direction
        axis.plot(*line.T, color="0.6", linestyle="--", linewidth=0.8)
    axis.set_box_aspect((1, 1, 0.7))
    axis.set_title("the rig as calibrated, mm")
    axis.legend(loc="upper left", fontsize=8)
