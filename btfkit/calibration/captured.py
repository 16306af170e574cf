"""A captured sequence as a BTF: merged, rectified and scaled when a texture is asked for."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit import directions
from btfkit.btf import BTF, COLOUR, RGB
from btfkit.calibration.calibration import NAME, Calibration
from btfkit.calibration.colours import ColourCorrection
from btfkit.calibration.demosaic import sites
from btfkit.calibration.geometry import Geometry
from btfkit.calibration.geometry_stage import LAMP, nominal
from btfkit.calibration.merge import Merged, merge_exposures
from btfkit.calibration.radiometry import Radiometry, as_plane
from btfkit.calibration.rectify import Footprints, Grid, Rectified, footprints, rectify
from btfkit.calibration.stages import (
    calibrate,
    colour_of,
    factors_of,
    geometry_of,
    scale_of,
    stray_of,
)
from btfkit.calibration.stray import Stray, frame_means
from btfkit.errors import CalibrationError
from btfkit.sequence import TABLE, Sequence
from btfkit.textures import Textures

Array = NDArray[np.float32]
Floats = NDArray[np.floating]
# Camera pixels that a texel gets by default, seen as squarely as it is: of a mosaic, whose colours
# lie apart, more.
_PIXELS_A_TEXEL = {False: 2.0, True: 3.0}
# Pixels that tell the mean of a frame: 1 of 25.
_EVERY = slice(2, None, 5)
# Views whose footprints are kept at hand, and variances that wait to be asked for.
_VIEWS, _WAITING = 8, 192


def detect(path: Path) -> bool:
    """Whether a folder is a sequence: whether it has the table."""
    return path.is_dir() and (path / TABLE).is_file()


def read(
    path: Path,
    *,
    texel_mm: float | None = None,
    calibration: Path | None = None,
) -> BTF:
    """The BTF of a sequence; each texture is merged and rectified when it is asked for.

    Stages of the calibration whose inputs changed are run first; nothing is written.

    Args:
        path: folder of the sequence.
        texel_mm: edge of a texel; None takes 2 camera pixels (3 of a mosaic) where the sample is
            seen most squarely.
        calibration: its document; None takes calibration.json of the folder where it is there.

    Raises:
        CalibrationError: no frames of the sample, or what their values need is not known.
    """
    sequence = Sequence.open(path)
    groups = list(sequence.groups("sample").values())
    if not groups:
        raise CalibrationError(
            f"{path} has no frames of kind sample", remedy=f"name them in column kind of {TABLE}"
        )
    document = calibration or path / NAME
    previous = Calibration.load(document) if calibration or document.exists() else None
    found, ran = calibrate(sequence, previous)
    rig = _Rig.of(sequence, found)
    grid = _grid(sequence, rig, groups, texel_mm)
    poses = [sequence.frames[group[0]].axes for group in groups]
    light = np.array([rig.geometry.light_position(LAMP, at) for at in poses], np.float32)
    view = np.array([rig.geometry.view_position(at) for at in poses], np.float32)
    textures = CapturedTextures(sequence, rig, groups, grid, found)
    return BTF(
        textures=textures,
        light=directions.normalize(light).astype(np.float32),
        view=directions.normalize(view).astype(np.float32),
        light_position=light,
        view_position=view,
        variance=textures.variance(),
        footprint=np.array([_mean_footprint(rig, at, grid) for at in poses], np.float32),
        channels=textures.channels,
        colour=COLOUR if rig.colour is not None else "the camera's own",
        texel_mm=grid.texel_mm,
        provenance={
            "format": "sequence",
            "source": str(path),
            "options": {"texel_mm": texel_mm} if texel_mm else {},
            "calibration": {"ran": ran, "missing": dict(found.missing)},
            "assumed": rig.assumed,
            "synthetic": bool(sequence.document.get("synthetic", False)),
        },
        history=(f"merged and rectified from {len(sequence)} frames",),
    )


@final
@dataclass(frozen=True, eq=False)
class _Rig:
    """All that turns frames into reflectance.

    Attributes:
        distance_mm: of the lamp to the white reference; None where values stay relative.
        scale: (c,) counts a second that a value of 1 gives at that distance.
        assumed: what the sequence did not tell.
    """

    geometry: Geometry
    blur_px: float
    radiometry: Radiometry
    lamp: Mapping[int, float]
    stray: Stray | None
    scale: Floats
    distance_mm: float | None
    colour: ColourCorrection | None
    assumed: Mapping[str, str]

    @staticmethod
    def of(sequence: Sequence, found: Calibration) -> _Rig:
        assumed = {}
        blur = 0.0
        if "geometry" in found.sections:
            geometry = geometry_of(found)
            blur = float(found.section("geometry").data["blur_px"])
        else:
            geometry = nominal(sequence)
            assumed["geometry"] = f"as sequence.json states it: {found.missing.get('geometry')}"
        scale: Floats = np.ones(1)
        distance: float | None = None
        if "white" in found.sections:
            of_white, distance = scale_of(found)
            scale = of_white.value
        else:
            assumed["scale"] = f"relative counts a second: {found.missing.get('white')}"
        colour = colour_of(found) if "colour" in found.sections else None
        return _Rig(
            geometry, blur, Radiometry.from_section(found.section("radiometry")),
            factors_of(sequence, found), stray_of(found), scale, distance, colour, assumed,
        )  # fmt: skip

    @property
    def mosaic(self) -> bool:
        return self.radiometry.cfa != "none"

    def footprints(self, readings: Mapping[str, float], grid: Grid) -> Footprints:
        pose = self.geometry.sample_to_camera(readings)
        return footprints(
            self.geometry.camera, pose, grid, blur_px=self.blur_px, mosaic=self.mosaic
        )


@final
class CapturedTextures(Textures):
    """Textures of a sequence, one a group of exposures."""

    def __init__(
        self,
        sequence: Sequence,
        rig: _Rig,
        groups: list[tuple[int, ...]],
        grid: Grid,
        found: Calibration,
    ) -> None:
        self._sequence, self._rig, self._groups, self._grid = sequence, rig, groups, grid
        self._found = found
        coloured = rig.mosaic or sequence.image(groups[0][0]).ndim == 3
        self.channels = RGB if coloured else ("Y",)
        self.shape = (len(groups), grid.h, grid.w, len(self.channels))
        self._views: OrderedDict[tuple[Any, ...], Footprints] = OrderedDict()
        self._waiting: OrderedDict[int, Array] = OrderedDict()
        self._lock = threading.Lock()

    def __getstate__(self) -> dict[str, Any]:
        # What is at hand belongs to the process that read it.
        return {**self.__dict__, "_views": OrderedDict(), "_waiting": OrderedDict(), "_lock": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._lock = threading.Lock()

    def variance(self) -> Textures:
        """The variances of these textures, each at hand after its texture was asked for."""
        return _Variances(self)

    def rectified(self, index: int) -> Rectified:
        """A texture with its variance, coverage and validity."""
        group = self._groups[index]
        readings = self._sequence.frames[group[0]].axes
        where = self.footprints(index)
        sensor = self._frame_size(group)
        window = where.window(*sensor)
        merged = self._merged(group, window)
        if merged is None:
            return _unseen(self.shape[1:])
        mosaic = self._rig.mosaic
        image, variance = merged.radiance, merged.variance
        if image.ndim == 2:
            image, variance = image[..., None], variance[..., None]
        found = rectify(
            image, where, variance=variance, threads=1,
            sites=sites(self._rig.radiometry.cfa, (2, 2)).astype(np.int32) if mosaic else None,
            origin=(window[0].start, window[1].start),
        )  # fmt: skip
        return self._scaled(found, readings)

    def crop(self, rows: slice, cols: slice) -> Textures:
        grid = self._grid.window(rows, cols)
        return CapturedTextures(self._sequence, self._rig, self._groups, grid, self._found)

    def _read(self, index: int) -> Array:
        found = self.rectified(index)
        if found.variance is not None:
            with self._lock:
                self._waiting[index] = found.variance
                while len(self._waiting) > _WAITING:
                    self._waiting.popitem(last=False)
        return found.value

    def take_variance(self, index: int) -> Array:
        """(h, w, c) variance of a texture; made anew where the texture was not just asked for."""
        with self._lock:
            waiting = self._waiting.pop(index, None)
        if waiting is None:
            waiting = self.rectified(index).variance
        if waiting is None:
            raise CalibrationError("the sensor's noise is not known, and so no variance")
        return waiting

    def _frame_size(self, group: tuple[int, ...]) -> tuple[int, int]:
        sensor = self._sequence.sensor
        if sensor.height is None or sensor.width is None:
            h, w = self._sequence.image(group[0]).shape[:2]
            return h, w
        return sensor.height, sensor.width

    def footprints(self, index: int) -> Footprints:
        """Where the texels of a texture lie in its frames; all lights of a view share them."""
        readings = self._sequence.frames[self._groups[index][0]].axes
        chains = self._rig.geometry.kinematics.chains
        moved = (*chains.get("sample", ()), *chains.get("camera", ()))
        key = tuple(readings[name] for name in moved)
        with self._lock:
            known = self._views.get(key)
        if known is None:
            known = self._rig.footprints(readings, self._grid)
            with self._lock:
                self._views[key] = known
                while len(self._views) > _VIEWS:
                    self._views.popitem(last=False)
        return known

    def _merged(self, group: tuple[int, ...], window: tuple[slice, slice]) -> Merged | None:
        """Merged exposures of the window, without stray light."""
        rows, columns = window
        if rows.stop <= rows.start or columns.stop <= columns.start:
            return None
        rig, sequence = self._rig, self._sequence
        lamp = [rig.lamp.get(i, 1.0) for i in group]
        merged = _merged_window(rig.radiometry, sequence, group, window, lamp)
        if rig.stray is None or rig.stray.share == 0:
            return merged
        sparse = _merged_window(rig.radiometry, sequence, group, (_EVERY, _EVERY), lamp)
        return _without_stray(rig, merged, sparse, window)

    def _scaled(self, found: Rectified, readings: Mapping[str, float]) -> Rectified:
        """From radiance to the quantity of a BTF, with the lamp's distance at every texel."""
        rig = self._rig
        factor = 1 / np.asarray(rig.scale, float)
        if rig.distance_mm is not None:
            lamp = rig.geometry.light_position(LAMP, readings)
            square = ((lamp - self._grid.points()) ** 2).sum(-1) / rig.distance_mm**2
            factor = square[..., None] * factor
        value = (found.value * factor).astype(np.float32)
        variance = (
            None if found.variance is None else (found.variance * factor**2).astype(np.float32)
        )
        if rig.colour is not None and value.shape[2] == 3:
            value, variance = _corrected(rig.colour, value, variance)
        return replace(found, value=value, variance=variance)


@final
class _Variances(Textures):
    """Variances of captured textures."""

    def __init__(self, of: CapturedTextures) -> None:
        self._of = of
        self.shape = of.shape

    def _read(self, index: int) -> Array:
        return self._of.take_variance(index)

    def crop(self, rows: slice, cols: slice) -> Textures:
        cropped = self._of.crop(rows, cols)
        if not isinstance(cropped, CapturedTextures):
            raise TypeError("a window of captured textures is none")
        return _Variances(cropped)


def _merged_window(
    radiometry: Radiometry,
    sequence: Sequence,
    group: tuple[int, ...],
    window: tuple[slice, slice],
    lamp: list[float],
) -> Merged:
    """As `Radiometry.radiance`, of a window of the frames only."""
    frames = [sequence.frames[i] for i in group]
    times = [float(frame.need("exposure_s")) for frame in frames]
    warm = [f.temperature_c for f in frames if f.temperature_c is not None]
    noise = radiometry.at_temperature(float(np.mean(warm)) if warm else None)
    raw, channels = [], 1
    for i in group:
        image = sequence.image(i)
        channels = 1 if image.ndim == 2 else image.shape[2]
        raw.append(as_plane(image[window]))

    def part(value: Any) -> Any:
        if np.ndim(value) != 2:
            return value
        return as_plane(value.reshape(len(value), -1, channels)[window])

    noise = replace(
        noise, black=part(noise.black), dark=part(noise.dark), sensitivity=part(noise.sensitivity)
    )
    merged = merge_exposures(raw, [t * radiometry.factor(t) for t in times], noise, lamp=lamp)
    if channels == 1:
        return merged
    shape = (len(merged.radiance), -1, channels)
    return Merged(
        merged.radiance.reshape(shape),
        merged.variance.reshape(shape),
        merged.validity.reshape(shape),
    )


def _without_stray(
    rig: _Rig, merged: Merged, sparse: Merged, window: tuple[slice, slice]
) -> Merged:
    """As `Stray.removed`, with the frame's mean from a part of its pixels."""
    if rig.stray is None:
        return merged
    h, w = merged.radiance.shape[:2]
    rows, columns = sparse.radiance.shape[:2]
    lens, few = _lens(rig, merged, window), _lens(rig, sparse, (_EVERY, _EVERY))
    if merged.radiance.ndim == 3:
        spread: Floats = rig.stray.share * frame_means(sparse, few, None) / lens
    else:
        # An odd step meets the colours of a mosaic in the order of the mosaic itself, and windows
        # begin with a whole cell of it.
        added = rig.stray.share * frame_means(sparse, few, rig.radiometry.colours((rows, columns)))
        own = rig.radiometry.colours((h, w))
        spread = (added[0] if own is None else added[own]) / lens
    return replace(merged, radiance=(merged.radiance - spread).astype(np.float32))


def _lens(rig: _Rig, merged: Merged, window: tuple[slice, slice]) -> Floats:
    """Shading of the lens over a window of the frame, of the shape of what was merged there."""
    shading, shape = rig.radiometry.shading, merged.radiance.shape
    if shading is None:
        return np.ones(shape)
    return shading.reshape(len(shading), -1, *shape[2:])[window]


def _corrected(
    colour: ColourCorrection, value: Array, variance: Array | None
) -> tuple[Array, Array | None]:
    """Corrected colours, and variances through the slope of the correction."""
    out = colour.apply(value).astype(np.float32)
    if variance is None:
        return out, None
    spread = np.zeros_like(out)
    step = np.maximum(1e-3 * np.abs(value).max(axis=2), 1e-6).astype(np.float32)
    for k in range(3):
        moved = value.copy()
        moved[..., k] += step
        slope = (colour.apply(moved) - out) / step[..., None]
        spread += slope**2 * variance[..., k : k + 1]
    return out, spread.astype(np.float32)


def _unseen(shape: tuple[int, int, int]) -> Rectified:
    none = np.full(shape, np.nan, np.float32)
    return Rectified(none, none.copy(), np.zeros(shape[:2], np.float32), np.zeros(shape[:2], bool))


def _grid(
    sequence: Sequence, rig: _Rig, groups: list[tuple[int, ...]], texel_mm: float | None
) -> Grid:
    """Texels over the sample's area."""
    size = sequence.target.get("sample", {}).get("size_mm")
    good = isinstance(size, list) and len(size) == 2 and all(s > 0 for s in size)
    if not good or not isinstance(size, list):
        raise CalibrationError(
            f"sequence.json says no target.sample.size_mm (found {size!r})",
            remedy="give width and height of the sample's area in mm",
        )
    if texel_mm is None:
        pixels = max(_pixels_a_mm(rig, sequence.frames[group[0]].axes) for group in groups)
        wanted = _PIXELS_A_TEXEL[rig.mosaic] / pixels
        texel_mm = float(size[0]) / max(round(size[0] / wanted), 1)
    rows, columns = (max(round(float(side) / texel_mm), 1) for side in (size[1], size[0]))
    return Grid(rows, columns, texel_mm)


def _pixels_a_mm(rig: _Rig, readings: Mapping[str, float]) -> float:
    """Of the camera in the middle of the sample, by area."""
    pose = rig.geometry.sample_to_camera(readings)
    _, slope, _ = rig.geometry.camera.project_with_derivatives(pose(np.zeros(3)))
    area = abs(float(np.linalg.det(slope @ pose.rotation[:, :2])))
    return float(np.sqrt(area)) if np.isfinite(area) else 0.0


def _mean_footprint(rig: _Rig, readings: Mapping[str, float], grid: Grid) -> float:
    """The footprint of a view, texels: by squares over nine places of the sample."""
    squares = []
    for row in (0, grid.h // 2, grid.h - 1):
        for column in (0, grid.w // 2, grid.w - 1):
            one = grid.window(slice(row, row + 1), slice(column, column + 1))
            squares.append(float(rig.footprints(readings, one).footprint[0, 0]) ** 2)
    seen = [square for square in squares if np.isfinite(square)]
    return float(np.sqrt(np.mean(seen))) if seen else float("inf")
