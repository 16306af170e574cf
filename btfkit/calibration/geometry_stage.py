"""The geometry of a sequence: board and mirror spheres found in its frames, the rig adjusted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from btfkit.calibration.board import Board
from btfkit.calibration.bundle import Adjustment, Sighting, SphereSighting, adjust
from btfkit.calibration.camera_model import Camera
from btfkit.calibration.geometry import Geometry
from btfkit.calibration.intrinsics import SingleCamera, calibrate_camera
from btfkit.calibration.kinematics import Axis, Kinematics, Rigid
from btfkit.calibration.merge import SATURATED
from btfkit.calibration.mirrors import highlight
from btfkit.calibration.radiometry import Radiometry
from btfkit.errors import CalibrationError
from btfkit.sequence import Frame, Sequence

Floats = NDArray[np.float64]
# The rig's own lamp, as the sequence has one.
LAMP = "lamp"
_DOCUMENT = "sequence.json"
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
    """

    adjustment: Adjustment
    single: SingleCamera
    slip_sd: Mapping[str, float]

    def to_json(self) -> dict[str, Any]:
        return {
            **self.adjustment.to_json(),
            "blur_px": self.single.blur_px,
            "axes_off": dict(self.slip_sd),
            "single_camera": {
                "residual_px": self.single.residual_px,
                "rejected": self.single.rejected,
                "camera": self.single.camera.to_json(),
            },
        }


def fit_geometry(sequence: Sequence, radiometry: Radiometry) -> Found:
    """The geometry that the target and sphere frames of a sequence tell.

    Raises:
        CalibrationError: a rig or board that is not described, or frames that do not show it.
    """
    start = nominal(sequence)
    board = Board.from_json(_section(sequence.target, "board", "target"))
    groups = list(sequence.groups("target").values())
    frames = [sequence.frames[group[0]] for group in groups]
    pictures = [_grey(radiometry, sequence, group)[0] for group in groups]
    single = calibrate_camera(pictures, board)
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
            *_grey(radiometry, sequence, group), rough, sequence.frames[group[0]]
        )
    ]
    found = adjust(rough, sightings, spheres, slip_sd=slip_sd) if spheres else first_fit
    return Found(found, single, slip_sd)


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
        pixels, sd = board.refine(picture, every, rig.camera, pose, blur_px=blur_px)
        good = np.isfinite(pixels).all(axis=1) & np.isfinite(sd).all(axis=1)
        if good.sum() >= _FEWEST_CORNERS:
            corners = board.corners_mm[good]
            found.append(Sighting(frame.file, frame.axes, corners, pixels[good], sd_px=sd[good]))
    return found


def nominal(sequence: Sequence) -> Geometry:
    """The geometry that sequence.json states.

    Raises:
        CalibrationError: it lacks what a geometry needs, or garbles it.
    """
    rig, sensor = sequence.rig, sequence.sensor
    try:
        axes = [
            Axis(str(a["name"]), str(a.get("kind", "rotary")), _vector(a["direction"]),
                 _vector(a.get("point_mm", (0, 0, 0))))
            for a in rig["axes"]
        ]  # fmt: skip
        carries = {
            body: tuple(rig["carries"].get(body, ())) for body in ("sample", "camera", "light")
        }
        camera, lamp = rig["camera"], rig.get("light", {})
        turn, eye = np.array(camera["rotation"], float), _vector(camera["position_mm"])
        focal, centre = (np.array(camera[key], float) for key in ("focal_px", "centre_px"))
        lens = np.concatenate([focal, centre, np.zeros(5)])
        lights = {LAMP: _vector(lamp["position_mm"])} if "position_mm" in lamp else {}
        spheres = sequence.target.get("spheres", [])
        centres = np.array([_vector(s["centre_mm"]) for s in spheres]).reshape(-1, 3)
        radii = np.array([float(s["radius_mm"]) for s in spheres])
        if turn.shape != (3, 3) or lens.shape != (9,):
            raise ValueError(f"camera of shapes {turn.shape} and {focal.shape}")
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise CalibrationError(
            f"rig of {_DOCUMENT} does not tell axes, camera and light ({error!r})",
            remedy="add axes, carries, camera (position_mm, rotation, focal_px, centre_px), light",
        ) from error
    return Geometry(
        Camera(int(sensor.need("width")), int(sensor.need("height")), lens),
        Rigid(turn, -turn @ eye), Kinematics(tuple(axes), carries),
        _board_pose(sequence), centres, radii, lights,
    )  # fmt: skip


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


def _grey(
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


def _board_pose(sequence: Sequence) -> Rigid:
    """Board to sample, from origin_mm (first outer corner) and drawn axes x and y (down)."""
    if "board" not in sequence.target:
        return Rigid.identity()
    board = _section(sequence.target, "board", "target")
    size = Board.from_json(board)
    try:
        across = _vector(board.get("x", (1, 0, 0)))
        down = _vector(board.get("y", (0, -1, 0)))
        width, height = (n * size.square_mm for n in size.squares)
        rotation = np.stack([across, -down, np.cross(across, -down)], axis=1)
        corner = board.get("origin_mm")
        middle = (
            np.zeros(3)
            if corner is None
            else _vector(corner) + across * width / 2 + down * height / 2
        )
    except (TypeError, ValueError) as error:
        raise CalibrationError(f"target.board of {_DOCUMENT} has no pose ({error})") from error
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
        raise CalibrationError(
            f"target.board of {_DOCUMENT}: x {across.tolist()} and y {down.tolist()} are not "
            "perpendicular unit vectors"
        )
    return Rigid(rotation, middle)


def _section(of: Mapping[str, Any], name: str, where: str) -> Mapping[str, Any]:
    section = of.get(name)
    if not isinstance(section, Mapping):
        raise CalibrationError(f"{_DOCUMENT} has no {where}.{name}", remedy="describe it there")
    return section


def _vector(values: Any) -> Floats:
    vector = np.array(values, float)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"{values!r} is no vector of three numbers")
    return vector
