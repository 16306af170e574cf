"""The stages of a calibration in their order; only those whose inputs changed are made again."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from btfkit import documents
from btfkit.calibration import poses
from btfkit.calibration.board_poses import POSED
from btfkit.calibration.calibration import Calibration, Section
from btfkit.calibration.colours import ColourCorrection
from btfkit.calibration.geometry import Geometry
from btfkit.calibration.geometry_stage import fit_geometry
from btfkit.calibration.lamp_stage import LIT, lamp_factors, lamp_frames
from btfkit.calibration.noise import Fitted
from btfkit.calibration.nominal import LAMP, nominal
from btfkit.calibration.placement import Placement, of_directions, of_geometry
from btfkit.calibration.poses import with_poses
from btfkit.calibration.radiometry import Radiometry
from btfkit.calibration.references import (
    Scene,
    measure_colour,
    measure_stray,
    measure_white,
)
from btfkit.calibration.sensor_stage import fit_sensor, frames_used
from btfkit.calibration.stray import Stray
from btfkit.calibration.white import Scale
from btfkit.errors import CalibrationError
from btfkit.sequence import Sequence as Frames

Progress = Callable[[float, float], None]
ORDER = ("radiometry", "lamp", "geometry", "stray", "white", "colour")
# Raised with what a stage computes: sections of older code are made again.
_REVISION = {"radiometry": 1, "lamp": 1, "geometry": 3, "stray": 1, "white": 1, "colour": 1}
_NEEDED = {"radiometry"}


def calibrate(
    sequence: Frames,
    previous: Calibration | None = None,
    *,
    placement: Placement | None = None,
    progress: Progress = lambda done, total: None,
) -> tuple[Calibration, list[str]]:
    """Calibrate a sequence as far as its frames tell.

    Args:
        sequence: of frames.
        previous: a calibration whose sections are kept where their inputs are the same.
        placement: where things are; None takes what the sequence says itself.
        progress: called with what is done, and of how much.

    Returns:
        The calibration, and the stages that were run.

    Raises:
        CalibrationError: the sensor cannot be calibrated, or frames contradict each other. What
            is only missing is named in `Calibration.missing`.
    """
    found = previous or Calibration()
    ran: list[str] = []
    placed = placement or placement_of(sequence)
    for done, name in enumerate(ORDER):
        inputs = fingerprint(sequence, name, found, placed)
        if found.fresh(name, inputs) is None:
            lacks = _lacks(sequence, name, found)
            if lacks is not None:
                found = found.without(name, lacks)
            else:
                found = found.with_section(name, _made(sequence, name, found, placed, inputs))
                ran.append(name)
        if name == "geometry" and name in found.sections:
            sequence = with_poses(sequence, found)
            if placement is None:
                placed = placed_by(sequence, found) or placed
        progress(done + 1, len(ORDER))
    return found, ran


def refuse_unfit(sequence: Frames, found: Calibration, path: Path) -> None:
    """Refuse a calibration that was made from other frames or settings than a sequence's.

    Raises:
        CalibrationError: names the first stage whose inputs differ.
    """
    placed = placement_of(sequence)
    for name in ORDER:
        if name not in found.sections:
            continue
        if found.fresh(name, fingerprint(sequence, name, found, placed)) is None:
            raise CalibrationError(
                f"{path}: its section {name!r} was not made from the frames and settings of "
                f"{sequence.path}",
                remedy=f"run btfkit calibrate {sequence.path} -o ANOTHER.json, or leave out "
                "--calibration",
            )
        if name == "geometry":
            sequence = with_poses(sequence, found)
            placed = placed_by(sequence, found) or placed


def geometry_of(found: Calibration) -> Geometry:
    """The geometry of a calibration.

    Raises:
        CalibrationError: it was not calibrated.
    """
    return Geometry.from_json(found.section("geometry").data)


def placed_by(sequence: Frames, found: Calibration) -> Placement | None:
    """Where things are by the calibrated geometry; None where it knows no lamp, or no poses."""
    geometry = geometry_of(found)
    if any(not sequence.frames[i].axes for i in sequence.of_kind(*POSED)):
        return None
    return of_geometry(geometry, "calibrated") if LAMP in geometry.lights_mm else None


def placement_of(sequence: Frames) -> Placement:
    """From directions in the table where they are there, else from section rig."""
    lit = [sequence.frames[i] for i in sequence.of_kind(*LIT)]
    if lit and all(frame.light is not None and frame.view is not None for frame in lit):
        return of_directions()
    if poses.without_axes(sequence):
        return of_directions()
    return of_geometry(nominal(sequence), "nominal")


def fingerprint(sequence: Frames, name: str, found: Calibration, placed: Placement) -> str:
    """SHA-256 over all that a stage reads: frames, their lines of the table, settings, sections."""
    earlier = {"radiometry": (), "lamp": ("radiometry",), "geometry": ("radiometry",),
               "stray": ("radiometry", "lamp", "geometry"),
               "white": ("radiometry", "lamp", "geometry", "stray"),
               "colour": ("radiometry", "lamp", "geometry", "stray", "white")}[name]  # fmt: skip
    document: dict[str, Any] = {
        "stage": name,
        "revision": _REVISION[name],
        "sensor": vars(sequence.sensor),
        "earlier": {
            each: found.sections[each].inputs for each in earlier if each in found.sections
        },
        "frames": [_frame_entry(sequence, i) for i in _frames_of(sequence, name)],
    }
    if name in ("stray", "white", "colour"):
        target = sequence.target
        document["target"] = target.get("white") if name == "white" else target.get("patches")
        document["placement"] = placed.source
        document["rig"] = dict(sequence.rig)
    if name == "geometry":
        document["target"] = {key: sequence.target.get(key) for key in ("board", "spheres")}
        document["rig"] = dict(sequence.rig)
    if name == "lamp":
        document["readings"] = [
            [f.file, f.lamp, f.time_s] for f in (sequence.frames[i] for i in sequence.of_kind(*LIT))
        ]
    return documents.fingerprint(document)


def _frames_of(sequence: Frames, name: str) -> Sequence[int]:
    if name == "radiometry":
        return frames_used(sequence)
    if name == "lamp":
        return lamp_frames(sequence)
    if name == "geometry":
        posed = POSED if poses.without_axes(sequence) else ("sphere",)
        return sequence.of_kind("target", *posed)
    kinds = {"stray": "colour", "white": "white", "colour": "colour"}
    return sequence.of_kind(kinds[name])


def _frame_entry(sequence: Frames, index: int) -> list[Any]:
    """A frame's content and pose. Where the table has no hash, the file is read."""
    frame = sequence.frames[index]
    digest = frame.sha256
    if digest is None:
        path = sequence.path / frame.file
        digest = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "missing"
    pose: list[Any] = [sorted(frame.axes.items()), frame.light, frame.view, frame.group]
    pose += poses.columns_of(frame)
    return [frame.file, frame.kind, digest, frame.exposure_s, frame.temperature_c, *pose]


def _lacks(sequence: Frames, name: str, found: Calibration) -> str | None:
    """Why a stage that may be absent cannot run; None where it can."""
    if name in _NEEDED or name == "lamp":
        return None
    if name == "geometry" and poses.without_axes(sequence):
        return poses.lacks(sequence)
    if name == "geometry":
        if not sequence.of_kind("target"):
            return "no frames of kind target"
        if "board" not in sequence.target:
            return "sequence.json has no target.board"
        return None
    kind = "white" if name == "white" else "colour"
    if not sequence.of_kind(kind):
        return f"no frames of kind {kind}"
    if name == "white" and "white" not in sequence.target:
        return "sequence.json has no target.white"
    if name != "white" and not sequence.target.get("patches"):
        return "sequence.json has no target.patches"
    if name == "colour" and "white" not in found.sections:
        return "needs the white reference"
    if sequence.sensor.cfa == "none" and name == "colour":
        first = sequence.image(sequence.of_kind("colour")[0])
        return "frames of one colour" if first.ndim == 2 else None
    return None


def _made(
    sequence: Frames, name: str, found: Calibration, placed: Placement, inputs: str
) -> Section:
    if name == "radiometry":
        radiometry, details = fit_sensor(sequence)
        return radiometry.to_section(inputs, details)
    radiometry = Radiometry.from_section(found.section("radiometry"))
    if name == "lamp":
        lit, lamp = lamp_factors(sequence, radiometry)
        files = [sequence.frames[i].file for i in lit]
        return Section(inputs, {"files": files, **finite(lamp.record())})
    if name == "geometry" and poses.without_axes(sequence):
        return Section(inputs, finite(poses.fit_poses(sequence, radiometry)))
    if name == "geometry":
        return Section(inputs, finite(fit_geometry(sequence, radiometry).to_json()))
    stray = None if name == "stray" else stray_of(found)
    scene = Scene(sequence, radiometry, placed, factors_of(sequence, found), stray)
    if name == "stray":
        _, data = measure_stray(scene)
    elif name == "white":
        lamp_sd = found.sections["lamp"].data["sd"] if "lamp" in found.sections else None
        _, data = measure_white(scene, lamp_sd or 0.0)
    else:
        scale, nominal_mm = scale_of(found)
        _, data = measure_colour(scene, scale, nominal_mm)
    return Section(inputs, finite(data))


def factors_of(sequence: Frames, found: Calibration) -> dict[int, float]:
    """Brightness of the lamp by index of the frame."""
    if "lamp" not in found.sections:
        return {}
    data = found.sections["lamp"].data
    by_file = dict(zip(data["files"], data["factor"], strict=True))
    return {i: by_file[f.file] for i, f in enumerate(sequence.frames) if f.file in by_file}


def stray_of(found: Calibration) -> Stray | None:
    """The stray light of a calibration; None where it was not measured."""
    if "stray" not in found.sections:
        return None
    data = found.sections["stray"].data
    share = float(data["share"])
    return Stray(share, Fitted({"share": share}, dict(data["sd"]), 0.0, 0.0))


def scale_of(found: Calibration) -> tuple[Scale, float | None]:
    """The absolute scale, and the distance of the lamp in mm that it holds for.

    Raises:
        CalibrationError: the white reference was not measured.
    """
    data = found.section("white").data
    scale = Scale(np.array(data["counts_per_s"]), np.array(data["sd"]), np.array(data["frames"]))
    return scale, data["distance_mm"]


def colour_of(found: Calibration) -> ColourCorrection:
    """The correction of colours.

    Raises:
        CalibrationError: no colours were measured.
    """
    data = found.section("colour").data
    return ColourCorrection(
        np.array(data["matrix"]), np.array(data["left_out"]), np.array(data["fitted"]),
        float(data["condition"]),
    )  # fmt: skip


def finite(value: Any) -> Any:
    """JSON has no NaN and no infinity: null stands for them."""
    if isinstance(value, Mapping):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
