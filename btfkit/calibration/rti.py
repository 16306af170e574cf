"""Lights of a folder of photographs with mirror spheres in view (RTI), and its `.lp` file."""

from __future__ import annotations

import os
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.calibration import photographs
from btfkit.calibration.highlights import Spot, find_spot, mirrors
from btfkit.calibration.lights import Light, locate
from btfkit.calibration.photographs import Progress
from btfkit.calibration.spheres import Optics, Sphere, find_spheres, in_proportion, need_spheres
from btfkit.errors import CalibrationError
from btfkit.files import whole

Floats = NDArray[np.floating]


@final
@dataclass(frozen=True, eq=False)
class LightTable:
    """The light of every photograph.

    Attributes:
        files: (n,) photographs. lights: (n,) None where no sphere shows one.
        spheres: the mirrors. optics: of the camera. origin: (3,) of directions and positions.
        unit: "mm", "px" or "radii", of positions and of `spheres`.
    """

    files: tuple[Path, ...]
    lights: tuple[Light | None, ...]
    spheres: tuple[Sphere, ...]
    optics: Optics
    origin: Floats
    unit: str

    @property
    def found(self) -> list[Light]:
        """The lights that are known."""
        return [light for light in self.lights if light is not None]

    @property
    def error_deg(self) -> float:
        """What a direction is off by, rms over the lights, degrees.

        The larger of what edges and spots allow and of how far the spheres disagree.
        """
        said = float(np.sqrt(np.mean([light.sd**2 for light in self.found])))
        seen = [x.residual**2 / x.spheres for x in self.found if np.isfinite(x.residual)]
        return float(np.degrees(max(said, float(np.sqrt(np.mean(seen))) if seen else 0.0)))

    def record(self) -> dict[str, Any]:
        """As JSON's own types."""
        placed = sum(light.position is not None for light in self.found)
        return {
            "photographs": len(self.files),
            "lights": len(self.found),
            "positions": placed,
            "without_light": [
                p.name for p, x in zip(self.files, self.lights, strict=True) if x is None
            ],
            "error_deg": self.error_deg,
            "unit": self.unit,
            "focal_px": self.optics.focal_px,
            "spheres": [sphere.record() for sphere in self.spheres],
            "entries": [
                {"file": p.name, **x.record()}
                for p, x in zip(self.files, self.lights, strict=True)
                if x is not None
            ],
        }

    def write_lp(
        self, path: Path, *, files: tuple[Path, ...] | None = None, force: bool = False
    ) -> None:
        """Write the light position file; photographs without a light are left out.

        Args:
            path: to write.
            files: (n,) that stand for the photographs, such as corrected ones; None for them.
            force: whether an existing file is replaced.
        """
        lines = [
            f"{os.path.relpath(name, path.parent)} " + " ".join(f"{x:.6f}" for x in light.direction)
            for name, light in zip(files or self.files, self.lights, strict=True)
            if light is not None
        ]
        with whole(path, force=force) as partial:
            partial.write_text("\n".join([str(len(lines)), *lines]) + "\n", encoding="utf-8")


def calibrate_lights(
    folder: Path,
    *,
    spheres: Path | None = None,
    sphere_mm: float | None = None,
    focal_px: float | None = None,
    transfer: str = "srgb",
    progress: Progress = lambda done, total: None,
) -> LightTable:
    """The lights of a folder of photographs.

    Args:
        folder: photographs of the object, one a light, by a camera that stands still.
        spheres: a folder of photographs of mirror spheres under the same lights in the same
            order or under the same names; None where spheres lie beside the object.
        sphere_mm: diameter of the largest sphere.
        focal_px: focal length in pixels of the photographs; None for a far camera.
        transfer: what code values mean.
        progress: called with what is done, and of how much.

    Raises:
        CalibrationError: no sphere, no light on any, or two folders that do not match.
    """
    files = photographs.listed(folder)
    shown = files if spheres is None else _matched(files, spheres)
    mean, highest, spread = photographs.summaries(shown, transfer, progress)
    optics = Optics(mean.shape[1], mean.shape[0], focal_px)
    round_things = find_spheres([mean, highest, spread], optics)
    need_spheres(round_things, str(folder if spheres is None else spheres))
    floor = 0.1 * float(highest.max())
    spots: list[list[Spot | None]] = [[] for _ in round_things]
    for i, path in enumerate(shown):
        picture = photographs.grey(path, transfer)
        for each, sphere in zip(spots, round_things, strict=True):
            each.append(find_spot(picture, sphere, optics, floor=floor))
        progress(len(shown) + i + 1, 2 * len(shown))
    chosen = mirrors(round_things, spots)
    need_spheres([round_things[i] for i in chosen], f"{folder}: {len(round_things)} round outlines")
    before = [round_things[i] for i in chosen]
    sized, origin = in_proportion(before, optics, sphere_mm)
    lights = []
    for photograph in range(len(shown)):
        seen = [
            moved(spot, old, new)
            for i, old, new in zip(chosen, before, sized, strict=True)
            if (spot := spots[i][photograph]) is not None
        ]
        lights.append(locate(seen, origin) if seen else None)
    unit = "mm" if sphere_mm else "px" if focal_px is None else "radii"
    table = LightTable(tuple(files), tuple(lights), tuple(sized), optics, origin, unit)
    _check(table, folder)
    return table


def moved(spot: Spot, old: Sphere, new: Sphere) -> Spot:
    """A spot on a sphere whose size became known."""
    point = new.centre + (spot.point - old.centre) * (new.radius / old.radius)
    return Spot(point, spot.light, spot.pixel, spot.sd)


def _check(table: LightTable, folder: Path) -> None:
    missing = [p.name for p, x in zip(table.files, table.lights, strict=True) if x is None]
    if len(missing) == len(table.files):
        raise CalibrationError(f"{folder}: no photograph shows a light on a sphere")
    if missing:
        warnings.warn(
            f"{folder}: {len(missing)} of {len(table.files)} photographs show no light on any "
            f"sphere and are left out, first {missing[0]!r}",
            stacklevel=3,
        )
    ratio = max(sphere.axis_ratio for sphere in table.spheres)
    if table.optics.focal_px is None and ratio > 1.02:
        warnings.warn(
            f"{folder}: an outline is an ellipse, longer by {100 * (ratio - 1):.1f} %: the camera "
            "is near; --focal-px makes the directions right",
            stacklevel=3,
        )


def _matched(files: list[Path], spheres: Path) -> list[Path]:
    """Photographs of the spheres in the order of those of the object."""
    shown = photographs.listed(spheres)
    by_name = {path.stem.lower(): path for path in shown}
    if all(path.stem.lower() in by_name for path in files):
        return [by_name[path.stem.lower()] for path in files]
    if len(shown) != len(files):
        raise CalibrationError(
            f"{spheres}: {len(shown)} photographs of spheres for {len(files)} of the object, and "
            "their names do not match",
            remedy="give each light one photograph in both folders, in the same order",
        )
    return shown
