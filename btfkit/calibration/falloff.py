"""Photographs divided by a white frame: the light falls off over the picture, and the lens too."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.calibration import photographs
from btfkit.calibration.photographs import Progress
from btfkit.calibration.rti import LightTable
from btfkit.errors import CalibrationError
from btfkit.files import whole_folder
from btfkit.io import images
from btfkit.textures import narrowed

Array = NDArray[np.float32]
Floats = NDArray[np.floating]
_SATURATED = 0.995
_DEGREE = 4


@final
@dataclass(frozen=True, eq=False)
class Falloff:
    """What photographs are divided by.

    Attributes:
        way: "a white frame a light", or "one white frame and light positions".
        residual: (m,) relative rms of each white frame from its smooth fit.
        range: (n,) brightest to darkest place of the picture under each light.
    """

    way: str
    residual: Floats
    range: Floats

    def record(self) -> dict[str, Any]:
        """As JSON's own types."""
        return {
            "way": self.way, "residual": self.residual.tolist(), "range": self.range.tolist(),
            "rms": float(np.sqrt(np.mean(self.residual**2))),
        }  # fmt: skip


def correct(
    table: LightTable,
    white: Path,
    out: Path,
    *,
    transfer: str = "srgb",
    force: bool = False,
    progress: Progress = lambda done, total: None,
) -> tuple[Falloff, tuple[Path, ...]]:
    """Write photographs with fall-off and vignetting divided out, as half-float EXR.

    Values are pi times radiance per irradiance on a surface facing the light, relative to the
    white: the white itself, lit from above, is 1.

    Args:
        table: lights of the photographs.
        white: a folder with a white frame for each light, in the same order or under the same
            names; or one file, named like the photograph whose light it has.
        out: folder to write.
        transfer: what code values mean. force: whether `out` is replaced.
        progress: called with what is done, and of how much.

    Returns:
        What was found, and (n,) the files written.

    Raises:
        CalibrationError: white frames that do not match, saturate, or are not smooth.
    """
    frames = photographs.listed(white)
    size = (table.optics.height, table.optics.width)
    if len(frames) == 1 and len(table.files) > 1:
        way, divisor, residual = _one(table, frames[0], transfer)
    else:
        way, divisor, residual = _each(table, _by_light(table, frames, white), transfer)
    ranges, names = [], []
    with whole_folder(out, force=force) as folder:
        for i, path in enumerate(table.files):
            if table.lights[i] is None:
                names.append(out / path.name)
                continue
            shade = divisor(i)
            picture = photographs.colours(path, transfer)
            if picture.shape[:2] != size:
                raise CalibrationError(f"{path}: another size than the spheres' photographs")
            name = _written(folder, path, picture, shade[..., None])
            ranges.append(float(shade.max() / shade.min()))
            names.append(out / name)
            progress(i + 1, len(table.files))
    return Falloff(way, np.array(residual), np.array(ranges)), tuple(names)


def develop(
    table: LightTable,
    out: Path,
    *,
    force: bool = False,
    progress: Progress = lambda done, total: None,
) -> tuple[Path, ...]:
    """Write RAW photographs as half-float EXR in linear BT.709; fall-off stays in.

    Args:
        table: lights of the photographs. out: folder to write.
        force: whether `out` is replaced. progress: called with what is done, and of how much.

    Returns:
        (n,) the files written.
    """
    names = []
    with whole_folder(out, force=force) as folder:
        for i, path in enumerate(table.files):
            names.append(out / f"{path.stem}.exr")
            if table.lights[i] is not None:
                _written(folder, path, photographs.colours(path, "linear"), np.float32(1))
            progress(i + 1, len(table.files))
    return tuple(names)


def _written(folder: Path, path: Path, picture: Array, divisor: Any) -> str:
    """Write a photograph over what it is to be divided by; its name."""
    # Where the picture is cut off there is no value.
    values = np.where(picture >= _SATURATED, np.nan, picture / divisor)
    matrix = photographs.colour_matrix(path)
    if matrix is not None:
        values = values @ matrix.T.astype(np.float32)
    name = f"{path.stem}.exr"
    channels = "RGB" if picture.shape[2] == 3 else "Y"
    images.write_exr(folder / name, narrowed(values), tuple(channels))
    return name


def _each(
    table: LightTable, frames: list[Path], transfer: str
) -> tuple[str, Callable[[int], Array], list[float]]:
    """A smooth fit to the white frame of each light, so that the white is cos(theta) in it."""
    residual: list[float] = []

    def divisor(i: int) -> Array:
        light = table.lights[i]
        smooth, off = _smooth(frames[i], transfer, table)
        residual.append(off)
        cosine = max(float(light.direction[2]), 1e-3) if light is not None else 1.0
        return smooth / np.float32(cosine)

    return "a white frame a light", divisor, residual


def _one(
    table: LightTable, frame: Path, transfer: str
) -> tuple[str, Callable[[int], Array], list[float]]:
    """Vignetting from one white frame; the fall-off of every light from its position."""
    stems = [path.stem.lower() for path in table.files]
    if frame.stem.lower() not in stems:
        raise CalibrationError(
            f"{frame}: one white frame for {len(stems)} lights, named like none of them",
            remedy="name it like the photograph whose light it was taken under",
        )
    far = [
        p.name for p, x in zip(table.files, table.lights, strict=True) if x and x.position is None
    ]
    own = table.lights[stems.index(frame.stem.lower())]
    if far or own is None:
        raise CalibrationError(
            f"{frame}: one white frame needs the position of every light, and {len(far)} have none"
            + (f", first {far[0]}" if far else ""),
            remedy="photograph two or three spheres at once, or a white frame for each light",
        )
    smooth, residual = _smooth(frame, transfer, table)
    lens = smooth / _irradiance(table, own.position)

    def divisor(i: int) -> Array:
        light = table.lights[i]
        if light is None or light.position is None:
            raise CalibrationError(f"{table.files[i]}: its light has no position")
        shade = lens * _irradiance(table, light.position)
        # In the middle the lamps are as bright as each other: they are the same make.
        middle = shade.shape[0] // 2, shade.shape[1] // 2
        return np.asarray(shade / shade[middle] * lens[middle], np.float32)

    return "one white frame and light positions", divisor, [residual]


def _irradiance(table: LightTable, position: Any) -> Array:
    """(h, w) cosine over squared distance on the plane of the object, 1 in the origin."""
    optics = table.optics
    rows, cols = np.mgrid[: optics.height, : optics.width]
    xy = optics.centred(np.stack([cols, rows], axis=-1))
    if optics.focal_px is None:
        scale = max(s.radius / s.radius_px for s in table.spheres)
    else:
        scale = abs(float(table.origin[2])) / optics.focal_px
    off = position - np.concatenate([xy * scale, np.zeros((*xy.shape[:2], 1))], axis=-1)
    square = np.sum(off**2, axis=-1)
    here = off[..., 2] / square**1.5
    middle = position[2] / float(np.dot(position, position)) ** 1.5
    return np.asarray(here / middle, np.float32)


def _by_light(table: LightTable, frames: list[Path], white: Path) -> list[Path]:
    by_name = {path.stem.lower(): path for path in frames}
    if all(path.stem.lower() in by_name for path in table.files):
        return [by_name[path.stem.lower()] for path in table.files]
    if len(frames) != len(table.files):
        raise CalibrationError(
            f"{white}: {len(frames)} white frames for {len(table.files)} photographs, and their "
            "names do not match",
            remedy="give each light one white frame, or a single file for all",
        )
    return frames


def _smooth(path: Path, transfer: str, table: LightTable) -> tuple[Array, float]:
    """(h, w) the smooth surface through a white frame, and its relative rms.

    Spheres and dirt are left out: the logarithm of medians of 24 x 24 blocks is fitted.
    """
    from numpy.polynomial import legendre

    size = (table.optics.height, table.optics.width)
    picture = photographs.grey(path, transfer, size)
    if float(np.mean(picture >= _SATURATED)) > 0.05:
        raise CalibrationError(
            f"{path}: {100 * float(np.mean(picture >= _SATURATED)):.0f} % of the white frame "
            "saturates",
            remedy="photograph it at a shorter exposure",
        )
    clear = picture < _SATURATED
    for sphere in table.spheres:
        rows, cols = np.ogrid[: size[0], : size[1]]
        near = np.hypot(cols - sphere.pixel[0], rows - sphere.pixel[1]) < 1.3 * sphere.radius_px
        clear &= ~near
    points = []
    for r in np.array_split(np.arange(size[0]), min(24, size[0])):
        for c in np.array_split(np.arange(size[1]), min(24, size[1])):
            block = picture[np.ix_(r, c)][clear[np.ix_(r, c)]]
            if block.size > 0.3 * len(r) * len(c) and np.median(block) > 0:
                points.append((r.mean(), c.mean(), np.log(np.median(block))))
    if len(points) < 2 * (_DEGREE + 1) ** 2:
        raise CalibrationError(
            f"{path}: too little of the white frame is lit and clear",
            remedy="cover the whole picture with white, under the same light",
        )
    y, x, value = np.array(points).T
    y, x = 2 * y / (size[0] - 1) - 1, 2 * x / (size[1] - 1) - 1
    design = legendre.legvander2d(y, x, [_DEGREE, _DEGREE])
    keep = np.ones(len(value), bool)
    for _ in range(6):
        answer, *_ = np.linalg.lstsq(design[keep], value[keep], rcond=None)
        off = np.abs(design @ answer - value)
        keep = off < 4 * max(1.4826 * float(np.median(off)), 1e-4)
    shape = answer.reshape(_DEGREE + 1, _DEGREE + 1)
    grid = legendre.leggrid2d(np.linspace(-1, 1, size[0]), np.linspace(-1, 1, size[1]), shape)
    return np.exp(grid).astype(np.float32), float(np.sqrt(np.mean(off[keep] ** 2)))
