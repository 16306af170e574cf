"""What `btfkit calibrate` does: a sequence to its calibration, photographs to their lights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from btfkit import documents
from btfkit.calibration import falloff, photographs, plots, report, rti, stages
from btfkit.calibration.calibration import NAME, Calibration
from btfkit.calibration.sensor_stage import NOISELESS_GAIN
from btfkit.errors import CalibrationError
from btfkit.files import refuse_existing, whole
from btfkit.sequence import TABLE, Sequence

Progress = Callable[[float, float], None]


@final
@dataclass(frozen=True)
class Photographs:
    """How a folder of photographs with mirror spheres is to be read.

    Attributes:
        spheres: folder of the spheres, where they were photographed first; else None.
        white: a folder of white frames, or one; None leaves the fall-off in.
        sphere_mm: diameter of the largest sphere. focal_px: focal length, None for a far camera.
        transfer: what code values mean.
    """

    spheres: Path | None = None
    white: Path | None = None
    sphere_mm: float | None = None
    focal_px: float | None = None
    transfer: str = "srgb"


def calibrate_sequence(
    folder: Path, out: Path | None, *, force: bool, progress: Progress, preview: bool = True
) -> dict[str, Any]:
    """Calibrate a sequence; sections whose inputs are unchanged are kept.

    Args:
        folder: the sequence.
        out: of the document; by default calibration.json in the folder, which is brought up to
            date where it is there.
        force: whether another existing document is replaced, and everything is made anew.
        progress: called with what is done, and of how much.
        preview: whether a small picture of the lights is left beside the document.

    Returns:
        Figures and paths, as JSON's own types.
    """
    sequence = Sequence.open(folder)
    final = out or folder / NAME
    refuse_existing(final, force=force or out is None)
    previous = Calibration.load(final) if final.exists() and not force else None
    found, ran = stages.calibrate(sequence, previous, progress=progress)
    page = final.with_name(f"{final.stem}.html")
    found.save(final, force=True)
    lights = _lights(sequence)
    report.write_report(found, page, title=folder.resolve().name, lights=lights, force=True)
    gone = [frame.file for frame in sequence.frames if not (folder / frame.file).is_file()]
    return {
        "out": final, "report": page, "ran": ran, "missing": dict(found.missing), "gone": gone,
        "figures": figures(found),
        **(_preview(final, lights) if preview and lights is not None else {}),
    }  # fmt: skip


def figures(found: Calibration) -> dict[str, Any]:
    """The figures that a line can hold."""
    out: dict[str, Any] = {}
    if "radiometry" in found.sections:
        noise = found.sections["radiometry"].data["noise"]
        out |= {"photon_noise": noise["gain_e_per_count"] < NOISELESS_GAIN}
        out |= {"gain_e_per_count": noise["gain_e_per_count"], "read_e": noise["read_e"]}
    if "geometry" in found.sections:
        residuals = found.sections["geometry"].data["residuals_px"]
        out |= {f"{kind}_px": rms for kind, rms in residuals.items()}
    if "lamp" in found.sections:
        out["lamp_drift"] = found.sections["lamp"].data["drift"]
    if "stray" in found.sections:
        out["stray_share"] = found.sections["stray"].data["share"]
    if "white" in found.sections:
        out["scale_sd"] = found.sections["white"].data["budget"]["together"]
    if "colour" in found.sections:
        data = found.sections["colour"].data
        out["delta_e"] = data["mean_left_out"]
        if data["greys"]:
            out["worst_grey"] = max(abs(v) for v in data["greys"].values())
    return out


def calibrate_photographs(
    folder: Path,
    out: Path | None,
    how: Photographs,
    *,
    force: bool,
    progress: Progress,
    preview: bool = True,
) -> dict[str, Any]:
    """The lights of a folder of photographs, as an .lp file with its report beside it.

    Returns:
        Figures and paths, as JSON's own types.
    """
    final = out or folder / f"{folder.resolve().name}.lp"
    if final.suffix.lower() != ".lp":
        raise CalibrationError(
            f"{final}: {folder} holds photographs and no {TABLE}; its lights are written as .lp",
            remedy=f"write -o {final.with_suffix('.lp').name}",
        )
    refuse_existing(final, force=force)
    table = rti.calibrate_lights(
        folder, spheres=how.spheres, sphere_mm=how.sphere_mm, focal_px=how.focal_px,
        transfer=how.transfer, progress=progress,
    )  # fmt: skip
    record = table.record()
    files, even = None, None
    if how.white is not None:
        even = final.with_name(f"{final.stem}.even")
        found, files = falloff.correct(
            table, how.white, even, transfer=how.transfer, force=force, progress=progress
        )
        record["falloff"] = found.record()
    elif any(map(photographs.is_raw, table.files)):
        even = final.with_name(f"{final.stem}.developed")
        files = falloff.develop(table, even, force=force, progress=progress)
    table.write_lp(final, files=files, force=force)
    beside = final.with_suffix(".json")
    documents.save(beside, stages.finite(record), force=True)
    page = final.with_suffix(".html")
    report.write_light_report(
        table, record.get("falloff"), page, title=folder.resolve().name, force=True
    )
    lights = np.array([light.direction for light in table.found])
    # Among the photographs it would be one of them the next time.
    within = final.resolve().parent == folder.resolve()
    return {
        "out": final, "report": page, "data": beside, "corrected": even,
        "lights": record["lights"], "positions": record["positions"], "spheres": len(table.spheres),
        "error_deg": table.error_deg, "unit": table.unit, "without_light": record["without_light"],
        "falloff_rms": record["falloff"]["rms"] if "falloff" in record else None,
        **(_preview(final, lights) if preview and not within else {}),
    }  # fmt: skip


def _lights(sequence: Sequence) -> Any:
    """(n, 3) lights of the sample's poses; None where nothing tells them."""
    try:
        placed = stages.placement_of(sequence)
        groups = sequence.groups("sample").values()
        frames = [sequence.frames[group[0]] for group in groups]
        return np.array([placed.directions(frame, np.zeros(3))[0] for frame in frames])
    except CalibrationError:
        return None


def _preview(final: Path, lights: Any) -> dict[str, Path]:
    """The lights seen from above, as a small picture beside a document."""
    path = final.with_name(f"{final.stem}.preview.png")
    known = lights[np.isfinite(lights).all(axis=1)]
    # It belongs to the document, which was new or was to be replaced.
    with whole(path, force=True) as partial:
        partial.write_bytes(plots.sky_png(known))
    return {"preview": path}
