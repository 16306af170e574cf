"""Rigs without axes: every frame has a pose and a light of its own.

What a frame tells is written as readings of nine axes that nobody built (three slides and three
turns that carry the sample, three slides that carry the lamp). All that follows then knows one kind
of rig.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from btfkit.calibration.board_poses import CAMERA_COLUMNS, Finder, has, numbers_of, views_of
from btfkit.calibration.calibration import Calibration
from btfkit.calibration.camera_model import Camera
from btfkit.calibration.geometry import Geometry
from btfkit.calibration.kinematics import Axis, Kinematics, Rigid
from btfkit.calibration.nominal import LAMP
from btfkit.calibration.radiometry import Radiometry
from btfkit.errors import CalibrationError
from btfkit.sequence import TABLE, Frame, Sequence

Floats = NDArray[np.float64]
LIGHT_COLUMNS = tuple(f"light_{c}_mm" for c in "xyz")
_DOCUMENT = "sequence.json"
_SLIDES, _TURNS = ("pose x", "pose y", "pose z"), ("pose rz", "pose ry", "pose rx")
_LAMP_SLIDES = ("lamp x", "lamp y", "lamp z")
# A light of which only the direction is known stands here: a texel's is the same to 1e-4 degrees.
FAR_MM = 1e7
# What a table says of a view and what the board shows: further apart one of them is wrong.
_CONTRADICTION_DEG = 5.0


def without_axes(sequence: Sequence) -> bool:
    """Whether the sequence is of a rig that has no axes, so that each frame needs a pose."""
    return not sequence.rig.get("axes")


def lacks(sequence: Sequence) -> str | None:
    """Why the frames have no poses; None where they may."""
    samples = [sequence.frames[i] for i in sequence.of_kind("sample")]
    lit = "position_mm" in sequence.rig.get("light", {})
    dark = [f.file for f in samples if not (lit or f.light or has(f, LIGHT_COLUMNS))]
    if dark:
        return (
            f"{_DOCUMENT} has no rig.axes, and {len(dark)} sample frames have no light_x, light_y, "
            f"light_z (first: {dark[0]})"
        )
    blind = [f.file for f in samples if not has(f, CAMERA_COLUMNS)]
    if blind and "board" not in sequence.target and "camera" not in sequence.rig:
        return (
            f"{_DOCUMENT} has neither rig.axes nor rig.camera nor target.board, and {len(blind)} "
            f"sample frames have no {CAMERA_COLUMNS[0]} … {CAMERA_COLUMNS[-1]} (first: {blind[0]})"
        )
    return None


def columns_of(frame: Frame) -> list[tuple[str, str]]:
    """What a frame's line says of its own pose, for fingerprints."""
    return sorted((k, v) for k, v in frame.extra.items() if k in CAMERA_COLUMNS + LIGHT_COLUMNS)


def with_poses(sequence: Sequence, found: Calibration) -> Sequence:
    """The sequence with the readings that a calibration gave its frames; itself where none."""
    section = found.sections.get("geometry")
    readings = section.data.get("readings") if section is not None else None
    if not readings:
        return sequence
    frames = tuple(replace(f, axes=readings.get(f.file, f.axes)) for f in sequence.frames)
    return replace(sequence, frames=frames)


def fit_poses(sequence: Sequence, radiometry: Radiometry) -> dict[str, Any]:
    """The section "geometry" of a rig without axes.

    Raises:
        CalibrationError: a frame without a pose or light, or one whose table and board disagree.
    """
    finder = Finder.of(sequence, radiometry)
    readings: dict[str, dict[str, float]] = {}
    ways: dict[str, int] = {}
    off: list[tuple[float, str]] = []
    rms: list[float] = []
    far = False
    for groups in views_of(sequence).values():
        pose, way, residual = finder.pose(groups)
        ways[way] = ways.get(way, 0) + 1
        if residual is not None:
            rms.append(residual)
        for group in groups:
            first = sequence.frames[group[0]]
            if first.view is not None:
                off.append((_apart(pose, first), first.file))
            lamp, is_far = _lamp(sequence, first)
            far = far or is_far
            at = _readings(pose, lamp)
            readings |= {sequence.frames[i].file: at for i in group}
    worst = max(off, default=None)
    if worst is not None and worst[0] > _CONTRADICTION_DEG:
        raise CalibrationError(
            f"{worst[1]} shows the sample from {worst[0]:.1f} degrees beside the view_x, view_y, "
            f"view_z of its line in {TABLE}",
            remedy="correct the directions (away from the sample, x right, y up as target.board "
            "says), or clear them",
        )
    return {
        **_geometry(finder.camera).to_json(),
        "blur_px": finder.blur_px, "axes_off": {},
        "residuals_px": {"corner": float(np.sqrt(np.mean(np.square(rms))))} if rms else {},
        "view_rms_px": rms, "rejected": finder.rejected, "held": finder.held,
        "readings": readings, "poses_from": ways, "far_light": far,
        "off_table_deg": None if worst is None else {
            "rms": float(np.sqrt(np.mean([o**2 for o, _ in off]))), "worst": worst[0],
            "frame": worst[1],
        },
    }  # fmt: skip


def _lamp(sequence: Sequence, frame: Frame) -> tuple[Floats, bool]:
    """Position of the lamp in a frame, sample frame, mm; and whether it only is a direction."""
    light: Mapping[str, Any] = sequence.rig.get("light", {})
    if has(frame, LIGHT_COLUMNS):
        return numbers_of(frame, LIGHT_COLUMNS), False
    if frame.light is not None:
        distance = light.get("distance_mm")
        return np.array(frame.light) * float(distance or FAR_MM), distance is None
    if "position_mm" in light:
        return np.array(light["position_mm"], float), False
    raise CalibrationError(
        f"{frame.file} has no light_x, light_y, light_z, and {_DOCUMENT} no rig.axes",
        remedy=f"add them to its line of {TABLE}",
    )


def _apart(pose: Rigid, frame: Frame) -> float:
    """Degrees between where the camera is and where the table has it."""
    eye = pose.inverse().translation
    told = np.array(frame.view)
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(eye, told)), eye @ told)))


def _readings(pose: Rigid, lamp: Floats) -> dict[str, float]:
    turns = Rotation.from_matrix(pose.rotation).as_euler("ZYX")
    values = [*pose.translation.tolist(), *turns.tolist(), *np.asarray(lamp).tolist()]
    return dict(zip((*_SLIDES, *_TURNS, *_LAMP_SLIDES), values, strict=True))


def _geometry(camera: Camera) -> Geometry:
    """The rig of nine axes, its camera at the origin of the lab."""
    x, y, z = np.eye(3)
    lines = [*zip(_SLIDES, (x, y, z), strict=True), *zip(_LAMP_SLIDES, (x, y, z), strict=True)]
    axes = [Axis(name, "linear", line, np.zeros(3)) for name, line in lines]
    axes += [
        Axis(name, "rotary", line, np.zeros(3))
        for name, line in zip(_TURNS, (z, y, x), strict=True)
    ]
    sample = (*_SLIDES, *_TURNS)
    chains = {"sample": sample, "camera": (), "light": (*sample, *_LAMP_SLIDES)}
    return Geometry(
        camera, Rigid.identity(), Kinematics(tuple(axes), chains), lights_mm={LAMP: np.zeros(3)}
    )
