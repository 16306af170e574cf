"""The stages of the references: stray light, white and colours, from their frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.calibration import white as whites
from btfkit.calibration.aim import shift_of
from btfkit.calibration.colours import ColourCorrection, fit_colour
from btfkit.calibration.merge import Merged
from btfkit.calibration.patches import Level, level_of, mask_of
from btfkit.calibration.placement import Placement
from btfkit.calibration.radiometry import Radiometry
from btfkit.calibration.stray import Stray, fit_stray, frame_means
from btfkit.calibration.white import Scale
from btfkit.errors import CalibrationError
from btfkit.sequence import Frame
from btfkit.sequence import Sequence as Frames

Floats = NDArray[np.floating]
_ORIGIN = np.zeros(3)
# How far a rig may be from what its builder believes, seen on the sample.
_OFF_MM = 4.0
# Channels of a grey that differ by no more than this.
_NEUTRAL = 0.03
# A group of frames may be merged once for several patches; more than these say no more.
_MOST_GROUPS = 24


@final
@dataclass(frozen=True, eq=False)
class Scene:
    """A sequence whose sensor is known.

    Attributes:
        sequence: of frames. radiometry: of its sensor. placement: where things are.
        factor: brightness of the lamp by frame, relative; 1 where it is not in it.
        stray: of lens and housing.
    """

    sequence: Frames
    radiometry: Radiometry
    placement: Placement
    factor: Mapping[int, float]
    stray: Stray | None = None

    def merged(self, indices: Sequence[int]) -> Merged:
        """Flat-fielded radiance of one pose, the lamp at its median, stray light removed."""
        lamp = [self.factor.get(i, 1.0) for i in indices]
        found = self.radiometry.radiance(self.sequence, indices, lamp=lamp)
        if self.stray is None:
            return found
        lens = self.radiometry.lens(found.radiance.shape)
        return self.stray.removed(found, lens, self.colours(found))

    def colours(self, merged: Merged) -> NDArray[np.intp] | None:
        """(h, w) channel of each pixel of a mosaic."""
        h, w = merged.radiance.shape[:2]
        return self.radiometry.colours((h, w)) if merged.radiance.ndim == 2 else None

    def groups(self, kind: str) -> list[tuple[int, ...]]:
        """Frames of each pose of a kind, at most 24 poses."""
        found = list(self.sequence.groups(kind).values())
        chosen = np.unique(
            np.linspace(0, len(found) - 1, min(_MOST_GROUPS, len(found))).astype(int)
        )
        return [found[i] for i in chosen]

    def mask(
        self, merged: Merged, entry: Mapping[str, Any], frame: Frame, shift: Floats
    ) -> NDArray[np.bool_]:
        """(h, w) a patch in a merged frame."""
        h, w = merged.radiance.shape[:2]
        return mask_of(entry, frame, self.placement, (h, w), shift)

    def level(self, merged: Merged, entry: Mapping[str, Any], frame: Frame, shift: Floats) -> Level:
        """What a patch reads in a merged frame."""
        return level_of(merged, self.mask(merged, entry, frame, shift), self.colours(merged))

    def shift(self, merged: Merged, frame: Frame) -> Floats:
        """(2,) pixels by which a nominal pose is off in a frame; 0 of a calibrated one."""
        if self.placement.source != "nominal":
            return np.zeros(2)
        white = self.sequence.target.get("white")
        entries = [*_patches(self), *([white] if white else [])]
        return shift_of(merged, entries, frame, self.placement, reach_mm=_OFF_MM)

    def lit(self, entry: Mapping[str, Any], frame: Frame, nominal_mm: float | None) -> float:
        """Cosine of the light at a patch, times the square of the nominal distance over its own."""
        at = np.asarray(entry.get("centre_mm", _ORIGIN), float)
        light, _ = self.placement.directions(frame, at)
        distance = self.placement.distance_mm(frame, at)
        near = 1.0 if distance is None or nominal_mm is None else (nominal_mm / distance) ** 2
        return float(light[2]) * near


def measure_stray(scene: Scene) -> tuple[Stray, dict[str, Any]]:
    """Stray light from the grey patches in colour frames.

    Raises:
        CalibrationError: no greys, or nothing that shows them.
    """
    greys = [
        p
        for p in _patches(scene)
        if np.ptp(p["reflectance"]) <= _NEUTRAL * np.mean(p["reflectance"])
    ]
    groups = scene.groups("colour")
    if len(greys) < 3 or not groups:
        raise CalibrationError(
            f"{len(greys)} grey patches and {len(groups)} poses of kind colour: stray light needs "
            "three greys from dark to bright",
            remedy="put greys beside the sample and into target.patches of sequence.json",
        )
    values, expected, around = [], [], []
    for group in groups:
        frame = scene.sequence.frames[group[0]]
        merged = scene.merged(group)
        colours = scene.colours(merged)
        lens = scene.radiometry.lens(merged.radiance.shape)
        mean = frame_means(merged, lens, colours)
        shift = scene.shift(merged, frame)
        for patch in greys:
            mask = scene.mask(merged, patch, frame, shift)
            values.append(level_of(merged, mask, colours).mean)
            expected.append(
                float(np.mean(patch["reflectance"])) * scene.lit(patch, frame, _near(scene, frame))
            )
            around.append(mean / lens[mask].mean(axis=0))
    found = fit_stray(values, expected, around)
    return found, {"share": found.share, **found.fitted.record()}


def measure_white(scene: Scene, lamp_sd: float = 0.0) -> tuple[Scale, dict[str, Any]]:
    """The absolute scale from the white reference.

    Args:
        scene: with stray light removed. lamp_sd: relative deviation of the lamp's factors.

    Raises:
        CalibrationError: no frames or no description of it, or frames that cannot be used.
    """
    groups = scene.groups("white")
    entry = scene.sequence.target.get("white", {})
    if not groups:
        raise CalibrationError(
            "no frames of kind white: reflectance stays relative",
            remedy="capture the white reference",
        )
    diffuser = whites.from_document(entry)
    at = np.asarray(entry.get("centre_mm", _ORIGIN), float)
    frames = [scene.sequence.frames[group[0]] for group in groups]
    nominal = _near(scene, frames[0])
    levels, directions, near, shifts, glare = [], [], [], [], []
    for group, frame in zip(groups, frames, strict=True):
        merged = scene.merged(group)
        shifts.append(scene.shift(merged, frame))
        levels.append(scene.level(merged, entry, frame, shifts[-1]))
        whole, own = merged.radiance, levels[-1].mean
        lit = np.isfinite(whole).any() and np.isfinite(own).all() and bool(np.all(own > 0))
        glare.append(float(np.nanmean(whole)) / float(own.mean()) if lit else 0.0)
        directions.append(scene.placement.directions(frame, at))
        distance = scene.placement.distance_mm(frame, at)
        near.append(1.0 if distance is None or nominal is None else (nominal / distance) ** 2)
    found = whites.fit_scale(
        [x.mean for x in levels], [x.sd for x in levels], diffuser,
        light=np.array([d[0] for d in directions]), view=np.array([d[1] for d in directions]),
        files=[f.file for f in frames], irradiance=near,
    )  # fmt: skip
    stray_sd = 0.0 if scene.stray is None else scene.stray.fitted.sd.get("share", 0.0)
    budget = {
        "white frames": float(found.sd.max()),
        "lamp": lamp_sd,
        "stray light": stray_sd * float(np.mean(glare)),
        "angular model of the white": diffuser.residual,
        "certificate": float(entry.get("uncertainty", 0.0)),
    }
    budget["together"] = float(np.sqrt(sum(v**2 for v in budget.values())))
    data = {
        **found.record(), "budget": budget, "files": [f.file for f in frames],
        "distance_mm": nominal, "diffuser_residual": diffuser.residual,
        "placement": scene.placement.source, "spread": [x.spread for x in levels],
        "shift_px": np.array(shifts).tolist(),
    }  # fmt: skip
    return found, data


def measure_colour(
    scene: Scene, scale: Scale, nominal_mm: float | None
) -> tuple[ColourCorrection, dict[str, Any]]:
    """The correction of colours from the patches beside the sample.

    Args:
        scene: with stray light removed.
        scale: of the white reference. nominal_mm: distance of the lamp that it holds for.

    Raises:
        CalibrationError: no frames, no patches, or patches that cannot be used.
    """
    groups, patches = scene.groups("colour"), _patches(scene)
    if not groups or not patches:
        raise CalibrationError(
            f"{len(groups)} poses of kind colour and {len(patches)} patches in target.patches: "
            "colours stay those of the camera",
            remedy="capture a colour chart, and write its patches into sequence.json",
        )
    sums = []
    for group in groups:
        frame = scene.sequence.frames[group[0]]
        merged = scene.merged(group)
        shift = scene.shift(merged, frame)
        sums.append(
            [
                scale.reflectance(scene.level(merged, patch, frame, shift).mean[None])[0]
                / scene.lit(patch, frame, nominal_mm)
                for patch in patches
            ]
        )
    camera = np.median(np.array(sums), axis=0)
    if camera.shape[1] != 3:
        raise CalibrationError("frames of one colour: there are no colours to correct")
    reference = np.array([patch["reflectance"] for patch in patches], float)
    try:
        found = fit_colour(camera, reference)
    except CalibrationError as error:
        file = scene.sequence.frames[groups[0][0]].file
        raise CalibrationError(f"{file}: {error.message}", remedy=error.remedy) from error
    corrected = found.apply(camera)
    names = [str(patch.get("name", i)) for i, patch in enumerate(patches)]
    grey = np.ptp(reference, axis=1) <= _NEUTRAL * reference.mean(axis=1)
    relative = corrected[grey] / reference[grey] - 1
    off = corrected[grey].mean(axis=1) / reference[grey].mean(axis=1) - 1
    data = {
        **found.record(), "patches": names, "measured": corrected.tolist(),
        "reference": reference.tolist(),
        "greys_by_channel": relative.tolist(),
        "greys": {n: float(o) for n, o in zip(np.array(names)[grey].tolist(), off, strict=True)},
    }  # fmt: skip
    return found, data


def _near(scene: Scene, frame: Frame) -> float | None:
    """Distance of the lamp to the middle of the sample in a frame; None for far lamps."""
    return scene.placement.distance_mm(frame, _ORIGIN)


def _patches(scene: Scene) -> list[Mapping[str, Any]]:
    """The patches of sequence.json, checked."""
    found = scene.sequence.target.get("patches", [])
    for i, patch in enumerate(found):
        values = patch.get("reflectance")
        good = isinstance(values, list) and len(values) == 3
        if not good or not all(isinstance(v, (int, float)) and 0 < v < 1.2 for v in values or []):
            raise CalibrationError(
                f"target.patches[{i}] of sequence.json has reflectance {values!r}",
                remedy="give three linear values, like [0.18, 0.18, 0.18]",
            )
    return list(found)
