"""The geometry of a sequence: board and mirror spheres found in its frames, the rig adjusted."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from btfkit.calibration import corners
from btfkit.calibration.board import Board
from btfkit.calibration.bundle import Adjustment, Sighting, SphereSighting, adjust
from btfkit.calibration.geometry import Geometry
from btfkit.calibration.intrinsics import SingleCamera, calibrate_camera
from btfkit.calibration.merge import SATURATED
from btfkit.calibration.mirrors import highlight
from btfkit.calibration.nominal import LAMP, nominal
from btfkit.calibration.radiometry import Radiometry
from btfkit.sequence import Frame, Sequence

Floats = NDArray[np.float64]
# Of the brightest pixel: what belongs to a highlight.
_HIGHLIGHT = 0.3
# Highlights are looked for within this share of a sphere's radius of where they should be.
_SEARCH = 0.5
_LOWEST_MM = 0.3
_FEWEST_CORNERS = 6
# Axes are first let stand this far from their readings, to see how far they do; from fewer frames
# that cannot be told from where the axes are.
_LOOSE = {"rotary": 1e-3, "linear": 0.1}
_FEWEST_FOR_SLIPS = 8


@final
@dataclass(frozen=True, eq=False)
class Found:
    """What a sequence tells of its rig.

    Attributes:
        adjustment: the geometry and how well it is known. single: the camera by itself.
        slip_sd: how far axes stand from their readings, rms, radians or mm.
        left_out: target frames that show too few corners to tell the camera.
    """

    adjustment: Adjustment
    single: SingleCamera
    slip_sd: Mapping[str, float]
    left_out: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        return {
            **self.adjustment.to_json(),
            "blur_px": self.single.blur_px,
            "axes_off": dict(self.slip_sd),
            "single_camera": {
                "residual_px": self.single.residual_px,
                "rejected": self.single.rejected,
                "left_out": list(self.left_out),
                "camera": self.single.camera.to_json(),
            },
        }


def fit_geometry(sequence: Sequence, radiometry: Radiometry) -> Found:
    """The geometry that the target and sphere frames of a sequence tell.

    Raises:
        CalibrationError: a rig or board that is not described, or frames that do not show it.
    """
    start = nominal(sequence)
    board = Board.from_json(sequence.target.get("board", {}))
    groups = list(sequence.groups("target").values())
    frames = [sequence.frames[group[0]] for group in groups]
    pictures = [grey(radiometry, sequence, group)[0] for group in groups]
    cell_px = [_cell_px(start, board, frame) for frame in frames]
    single = calibrate_camera(pictures, board, cell_px=cell_px)
    sightings, first = [], None
    for frame, view in zip(frames, single.views, strict=True):
        if view is not None:
            points = board.corners_mm[view.numbers]
            sightings.append(Sighting(frame.file, frame.axes, points, view.pixels))
            first = first or (view.pose, frame.axes)
    if first is not None:
        placed = Geometry.placed(single.camera, start.kinematics, start.board, *first)
        start = replace(start, camera=single.camera, camera_pose=placed.camera_pose)
    # The axes first: board and spheres are then found where they are.
    bare = replace(start, lights_mm={}, spheres_mm=np.zeros((0, 3)), radii_mm=np.zeros(0))
    alone = adjust(bare, sightings).geometry
    sightings = _seen_again(pictures, frames, board, alone, single.blur_px)
    warn_of_unseen(frames, sightings)
    slip_sd = slips_of(alone, sightings)
    first_fit = adjust(alone, sightings, slip_sd=slip_sd)
    rough = replace(
        first_fit.geometry,
        spheres_mm=start.spheres_mm,
        radii_mm=start.radii_mm,
        lights_mm=start.lights_mm,
    )
    spheres = [
        sighting
        for group in sequence.groups("sphere").values()
        for sighting in find_highlights(
            *grey(radiometry, sequence, group), rough, sequence.frames[group[0]]
        )
    ]
    found = adjust(rough, sightings, spheres, slip_sd=slip_sd) if spheres else first_fit
    seen = zip(frames, single.views, strict=True)
    left_out = tuple(frame.file for frame, view in seen if view is None)
    return Found(found, single, slip_sd, left_out)


def warn_of_unseen(frames: list[Frame], sightings: list[Sighting]) -> None:
    """Say which target frames tell nothing of the rig."""
    seen = {sighting.name for sighting in sightings}
    unseen = [frame.file for frame in frames if frame.file not in seen]
    if unseen:
        warnings.warn(
            f"{len(unseen)} of {len(frames)} target frames show fewer than {_FEWEST_CORNERS} "
            f"corners of the board and are left out, first {unseen[0]!r}",
            stacklevel=3,
        )


def _cell_px(start: Geometry, board: Board, frame: Frame) -> float:
    """Pixels that a cell of a marker should have in a frame."""
    to_camera = start.sample_to_camera(frame.axes) @ start.board
    return board.cell_px(start.camera.project(to_camera(board.corners_mm)))


def slips_of(start: Geometry, sightings: list[Sighting]) -> dict[str, float]:
    """By how much axes stand off their readings, rms, radians or mm, as the board tells.

    Only of those that move sample or camera: a highlight tells less of a lamp's than any encoder.
    """
    chains = start.kinematics.chains
    told = {*chains.get("sample", ()), *chains.get("camera", ())}
    loose = {a.name: _LOOSE[a.kind] for a in start.kinematics.axes if a.name in told}
    if len(sightings) < _FEWEST_FOR_SLIPS or not loose:
        return {}
    size = np.sqrt((adjust(start, sightings, slip_sd=loose).slips ** 2).mean(axis=0))
    of = zip(start.kinematics.axes, size.tolist(), strict=True)
    return {axis.name: slip for axis, slip in of if axis.name in told}


def _seen_again(
    pictures: list[Floats], frames: list[Frame], board: Board, rig: Geometry, blur_px: float
) -> list[Sighting]:
    """Every corner that frames show, from where the rig puts the board: detection misses some."""
    every = np.arange(len(board.corners_mm))
    found = []
    for picture, frame in zip(pictures, frames, strict=True):
        pose = rig.sample_to_camera(frame.axes) @ rig.board
        pixels, sd = corners.refine(board, picture, every, rig.camera, pose, blur_px=blur_px)
        good = np.isfinite(pixels).all(axis=1) & np.isfinite(sd).all(axis=1)
        if good.sum() >= _FEWEST_CORNERS:
            points = board.corners_mm[good]
            found.append(Sighting(frame.file, frame.axes, points, pixels[good], sd_px=sd[good]))
    return found


def find_highlights(
    picture: Floats, saturated: NDArray[np.bool_], rough: Geometry, frame: Frame
) -> list[SphereSighting]:
    """The lamp in the mirror spheres of one frame: the middle of each bright spot.

    Args:
        picture: (h, w) radiance; NaN where a pixel saturates or is dead.
        saturated: (h, w) which of the two: a saturated pixel is bright, a dead one says nothing.
        rough: the geometry, good to some part of a sphere.
        frame: that `picture` was merged from.
    """
    if LAMP not in rough.lights_mm:
        return []
    to_camera = rough.sample_to_camera(frame.axes)
    light = to_camera(rough.light_position(LAMP, frame.axes))
    bright = np.where(saturated, float(np.nanmax(picture, initial=0.0)), picture)
    dead = np.isnan(bright)
    bright[dead] = ndimage.median_filter(np.nan_to_num(bright), 3)[dead]
    found = []
    for sphere, (centre, radius) in enumerate(zip(rough.spheres_mm, rough.radii_mm, strict=True)):
        middle = to_camera(centre)
        spot = highlight(middle[None], light[None], np.array([radius]))[0]
        # Sunk into the plate: what is reflected below its surface is not seen.
        if to_camera.inverse()(spot)[2] < _LOWEST_MM:
            continue
        reach = _SEARCH * radius * rough.camera.parameters[0] / middle[2]
        pixel = _spot(bright, rough.camera.project(spot), reach)
        if pixel is not None:
            found.append(SphereSighting(frame.file, frame.axes, sphere, highlights={LAMP: pixel}))
    return found


def _spot(bright: Floats, expected: Floats, reach: float) -> Floats | None:
    """Centroid (2,) of the brightest spot about a pixel; None where none stands out."""
    low = np.floor(expected - reach).astype(int)
    high = np.ceil(expected + reach).astype(int) + 1
    if (low < 0).any() or (high > bright.shape[::-1]).any():
        return None
    part = bright[low[1] : high[1], low[0] : high[0]]
    ground = float(np.median(part))
    above = part - ground
    top = np.unravel_index(int(np.argmax(above)), part.shape)
    # A spot stands out of the plate's picture around it, and lies within the window.
    if above[top] < 10 * max(float(np.percentile(above, 90)), 1e-12):
        return None
    labels, _ = ndimage.label(above > _HIGHLIGHT * above[top])
    mine = ndimage.binary_dilation(labels == labels[top], iterations=2)
    if mine[[0, -1]].any() or mine[:, [0, -1]].any():
        return None
    weight = np.where(mine, np.maximum(above, 0), 0)
    row, column = ndimage.center_of_mass(weight)
    return np.array([low[0] + column, low[1] + row])


def grey(
    radiometry: Radiometry, sequence: Sequence, group: tuple[int, ...]
) -> tuple[Floats, NDArray[np.bool_]]:
    """(h, w) radiance of an achromatic target, the colours of a mosaic brought to one scale.

    NaN where a pixel tells nothing; and where that is because it saturates.
    """
    merged = radiometry.radiance(sequence, group)
    radiance, saturated = merged.radiance.astype(float), merged.validity == SATURATED
    if radiance.ndim == 3:
        return np.asarray(radiance.mean(axis=2)), np.asarray(saturated.any(axis=2))
    colours = radiometry.colours((radiance.shape[0], radiance.shape[1]))
    if colours is None:
        return radiance, saturated
    out = radiance.copy()
    for c in range(3):
        out[colours == c] /= max(float(np.nanpercentile(radiance[colours == c], 90)), 1e-12)
    return out, saturated
