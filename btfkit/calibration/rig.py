"""All that turns the frames of a sequence into reflectance, and the grid that it is wanted on."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.calibration.calibration import Calibration
from btfkit.calibration.colours import ColourCorrection
from btfkit.calibration.geometry import Geometry
from btfkit.calibration.nominal import nominal
from btfkit.calibration.poses import without_axes
from btfkit.calibration.radiometry import Radiometry
from btfkit.calibration.rectify import Footprints, Grid, footprints
from btfkit.calibration.stages import colour_of, factors_of, geometry_of, scale_of, stray_of
from btfkit.calibration.stray import Stray
from btfkit.errors import CalibrationError
from btfkit.sequence import Sequence

Floats = NDArray[np.floating]
# Camera pixels that a texel gets by default, seen as squarely as it is: of a mosaic, whose colours
# lie apart, more.
_PIXELS_A_TEXEL = {False: 2.0, True: 3.0}
# More than any camera has pixels.
_MOST_TEXELS = 1 << 28
# Half of a usual sample: what an axis that is off moves its rim by.
_REACH_MM = 20.0


@final
@dataclass(frozen=True, eq=False)
class CalibratedRig:
    """All that turns frames into reflectance.

    Attributes:
        error_mm: how far places on the sample are expected to be off; None where nothing tells.
        distance_mm: of the lamp to the white reference; None where values stay relative.
        scale: (c,) counts a second that a value of 1 gives at that distance.
        assumed: what the sequence did not tell.
        far_light: whether of lights only directions are known.
    """

    geometry: Geometry
    blur_px: float
    error_mm: float | None
    radiometry: Radiometry
    lamp: Mapping[int, float]
    stray: Stray | None
    scale: Floats
    distance_mm: float | None
    colour: ColourCorrection | None
    assumed: Mapping[str, str]
    far_light: bool = False

    @staticmethod
    def of(sequence: Sequence, found: Calibration) -> CalibratedRig:
        assumed = {}
        far, blur = False, 0.0
        error: float | None = None
        if "geometry" in found.sections:
            geometry = geometry_of(found)
            data = found.section("geometry").data
            blur = float(data["blur_px"])
            far = bool(data.get("far_light", False))
            error = _expected_error_mm(geometry, data)
        elif without_axes(sequence):
            raise CalibrationError(
                f"{sequence.path}: {found.missing.get('geometry')}",
                remedy="describe rig.axes and carries, or tell light and camera of each frame: "
                "docs/capture.md, the sequence folder",
            )
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
        return CalibratedRig(
            geometry, blur, error, Radiometry.from_section(found.section("radiometry")),
            factors_of(sequence, found), stray_of(found), scale, distance, colour, assumed,
            far,
        )  # fmt: skip

    @property
    def mosaic(self) -> bool:
        return self.radiometry.cfa != "none"

    def footprints(
        self,
        readings: Mapping[str, float],
        grid: Grid,
        *,
        height_mm: NDArray[np.float64] | None = None,
        offset_mm: tuple[float, float] = (0.0, 0.0),
    ) -> Footprints:
        """Of texels in a frame; as `rectify.footprints`."""
        pose = self.geometry.sample_to_camera(readings)
        return footprints(
            self.geometry.camera, pose, grid, blur_px=self.blur_px, mosaic=self.mosaic,
            height_mm=height_mm, offset_mm=offset_mm,
        )  # fmt: skip

    def pixels_a_mm(self, readings: Mapping[str, float]) -> float:
        """Of the camera in the middle of the sample, by area; 0 where it does not see it."""
        pose = self.geometry.sample_to_camera(readings)
        _, slope, _ = self.geometry.camera.project_with_derivatives(pose(np.zeros(3)))
        with np.errstate(invalid="ignore"):
            area = abs(float(np.linalg.det(slope @ pose.rotation[:, :2])))
        return float(np.sqrt(area)) if np.isfinite(area) else 0.0


def grid_of(
    sequence: Sequence, rig: CalibratedRig, groups: list[tuple[int, ...]], texel_mm: float | None
) -> Grid:
    """Texels over the sample's area."""
    sample = sequence.target.get("sample")
    size: Any = sample.get("size_mm") if isinstance(sample, dict) else None
    numbers = isinstance(size, list) and all(isinstance(s, int | float) for s in size)
    if not numbers or len(size) != 2 or not all(0 < s < math.inf for s in size):
        raise CalibrationError(
            f"sequence.json says no target.sample.size_mm (found {size!r})",
            remedy="give width and height of the sample's area in mm",
        )
    if texel_mm is None:
        pixels = max(rig.pixels_a_mm(sequence.frames[group[0]].axes) for group in groups)
        if not pixels:
            raise CalibrationError(
                "no frame's camera sees the middle of the sample",
                remedy="correct rig.camera and rig.axes of sequence.json, or give --texel-mm",
            )
        wanted = _PIXELS_A_TEXEL[rig.mosaic] / pixels
        texel_mm = float(size[0]) / max(round(size[0] / wanted), 1)
    rows, columns = (max(round(float(side) / texel_mm), 1) for side in (size[1], size[0]))
    if rows * columns > _MOST_TEXELS:
        raise CalibrationError(
            f"target.sample.size_mm {size!r} takes {rows} x {columns} texels of {texel_mm:.3g} mm",
            remedy="correct it in sequence.json, or give larger texels (--texel-mm)",
        )
    return Grid(rows, columns, texel_mm)


def mean_footprint(rig: CalibratedRig, readings: Mapping[str, float], grid: Grid) -> float:
    """The footprint of a view, texels: by squares over nine places of the sample."""
    squares = []
    for row in (0, grid.h // 2, grid.h - 1):
        for column in (0, grid.w // 2, grid.w - 1):
            one = grid.window(slice(row, row + 1), slice(column, column + 1))
            squares.append(float(rig.footprints(readings, one).footprint[0, 0]) ** 2)
    seen = [square for square in squares if np.isfinite(square)]
    return float(np.sqrt(np.mean(seen))) if seen else float("inf")


def _expected_error_mm(geometry: Geometry, data: Mapping[str, Any]) -> float | None:
    """Of places on the sample: what corners are off by, and axes from their readings."""
    if "corner" not in data["residuals_px"]:
        return None
    readings: Mapping[str, float] = next(iter(data.get("readings", {}).values()), {})
    away = geometry.sample_to_camera(readings) if readings else geometry.camera_pose
    middle = float(away.translation[2]) / float(geometry.camera.parameters[0])
    corners = float(data["residuals_px"]["corner"]) * middle
    turning = {axis.name for axis in geometry.kinematics.axes if axis.kind == "rotary"}
    off = [float(v) for name, v in data.get("axes_off", {}).items() if name in turning]
    return float(np.hypot(corners, max(off, default=0.0) * _REACH_MM))
