"""A captured sequence as a BTF: merged, rectified and scaled when a texture is asked for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from btfkit import directions
from btfkit.btf import BTF, COLOUR
from btfkit.calibration.alignment import Aligned, align, report
from btfkit.calibration.calibration import NAME, Calibration
from btfkit.calibration.captured_textures import CapturedTextures
from btfkit.calibration.nominal import LAMP
from btfkit.calibration.partial import lacking
from btfkit.calibration.poses import with_poses
from btfkit.calibration.rectify import Grid
from btfkit.calibration.rig import CalibratedRig, grid_of, mean_footprint
from btfkit.calibration.stages import calibrate, refuse_unfit
from btfkit.errors import CalibrationError
from btfkit.relief import file as relief_file
from btfkit.sequence import TABLE, Sequence

Array = NDArray[np.float32]
# Registration itself is good to a hundredth of a texel: what a geometry leaves below twice that is
# none of its business. It looks at the middle of large samples.
_WORTHWHILE, _REGISTERED = 0.02, 256
# Views are the same whose directions differ by less.
_SAME_VIEW = 2e-3
# No rig is larger than a thousand kilometres.
_FARTHEST_MM = 1e9


def detect(path: Path) -> bool:
    """Whether a folder is a sequence: whether it has the table."""
    return path.is_dir() and (path / TABLE).is_file()


def read(
    path: Path,
    *,
    texel_mm: float | None = None,
    calibration: Path | None = None,
    register: bool | None = None,
    relief: Path | None = None,
    partial: bool = False,
) -> BTF:
    """The BTF of a sequence; each texture is merged and rectified when it is asked for.

    Stages of the calibration whose inputs changed are run first; nothing is written.

    Args:
        path: folder of the sequence.
        texel_mm: edge of a texel; None takes 2 camera pixels (3 of a mosaic) where the sample is
            seen most squarely.
        calibration: its document; None takes calibration.json of the folder where it is there,
            and makes anew what does not fit.
        register: whether each view is moved to where the squarest one shows the sample; None does
            where the geometry was calibrated and leaves more than a fiftieth of a texel.
        relief: heights of the sample (a relief file) that lie over its area: views are compared
            without parallax.
        partial: whether a run that lacks frames or pairs is taken, the rest masked.

    Raises:
        CalibrationError: no frames of the sample, or what their values need is not known; frames
            or pairs are missing and `partial` is False; `calibration` is of another sequence.
    """
    sequence = Sequence.open(path)
    if not sequence.of_kind("sample"):
        raise CalibrationError(
            f"{path} has no frames of kind sample", remedy=f"name them in column kind of {TABLE}"
        )
    lacks = lacking(sequence)
    if lacks and not partial:
        lacks.refuse(sequence)
    document = calibration or path / NAME
    previous = Calibration.load(document) if calibration or document.exists() else None
    if calibration is not None and previous is not None:
        refuse_unfit(sequence, previous, calibration)
    found, ran = calibrate(sequence, previous)
    sequence = with_poses(sequence, found)
    rig = CalibratedRig.of(sequence, found)
    groups = list(sequence.groups("sample").values())
    grid = grid_of(sequence, rig, groups, texel_mm)
    poses = [sequence.frames[group[0]].axes for group in groups]
    light = _positions("light", [rig.geometry.light_position(LAMP, at) for at in poses])
    view = _positions("camera", [rig.geometry.view_position(at) for at in poses])
    heights = None if relief is None else _heights(relief, grid)
    there = [tuple(i for i in group if sequence.frames[i].file not in lacks.files)
             for group in groups]  # fmt: skip
    textures = CapturedTextures(sequence, rig, poses, there, grid)
    footprint = np.array([mean_footprint(rig, at, grid) for at in poses], np.float32)
    registration = None
    if _worthwhile(rig, grid) if register is None else register:
        shifts = _registered(textures, light, view, heights)
        textures = textures.moved(shifts)
        registration = report(shifts, grid.texel_mm)
    if lacks.pairs:
        far = [float(np.linalg.norm(each, axis=1).mean()) for each in (light, view)]
        light, view = (
            np.concatenate([each, mean * more]).astype(np.float32)
            for each, mean, more in ((light, far[0], lacks.light), (view, far[1], lacks.view))
        )
        footprint = np.append(footprint, np.full(len(lacks.pairs), footprint.mean(), np.float32))
        textures = textures.with_unseen(len(lacks.pairs))
    return BTF(
        textures=textures,
        light=directions.normalize(light).astype(np.float32),
        view=directions.normalize(view).astype(np.float32),
        light_position=None if rig.far_light else light,
        view_position=view,
        validity=_validity(textures) if lacks else None,
        variance=textures.variance(),
        footprint=footprint,
        coverage=textures.coverage(),
        blurs=textures.blurs(),
        channels=textures.channels,
        colour=COLOUR if rig.colour is not None else "the camera's own",
        texel_mm=grid.texel_mm,
        provenance={
            "format": "sequence",
            "source": str(path),
            "options": {"texel_mm": texel_mm} if texel_mm else {},
            "calibration": {"document": str(document) if previous else None, "ran": ran,
                            "missing": dict(found.missing)},
            **({"registration": registration} if registration else {}),
            **({"partial": lacks.record()} if lacks else {}),
            "assumed": rig.assumed,
            "synthetic": bool(sequence.document.get("synthetic", False)),
        },
        history=(f"merged and rectified from {len(sequence)} frames",),
    )  # fmt: skip


def _worthwhile(rig: CalibratedRig, grid: Grid) -> bool:
    """Whether a calibrated geometry leaves more than registration can be off by itself."""
    return rig.error_mm is not None and rig.error_mm > _WORTHWHILE * grid.texel_mm


def _registered(
    textures: CapturedTextures, light: Array, view: Array, heights: NDArray[np.float64] | None
) -> list[Aligned]:
    """Shifts of the views, texels, from the middle of the sample."""
    grid = textures.grid
    h, w = min(grid.h, _REGISTERED), min(grid.w, _REGISTERED)
    top, left = (grid.h - h) // 2, (grid.w - w) // 2
    rows, columns = slice(top, top + h), slice(left, left + w)
    middle = textures.cropped(rows, columns)
    if heights is not None:
        middle = middle.on_relief(heights[rows, columns])
    there = [k for k in range(len(view)) if middle.seen(k)]
    views: dict[tuple[int, ...], list[int]] = {}
    toward = directions.normalize(view)
    for k in there:
        views.setdefault(tuple(np.rint(toward[k] / _SAME_VIEW).astype(int).tolist()), []).append(k)
    error = textures.rig.error_mm
    return align(
        middle.brightness, list(views.values()), directions.normalize(light), toward,
        error=None if error is None else error / grid.texel_mm,
    )  # fmt: skip


def _positions(what: str, found: list[NDArray[np.float64]]) -> Array:
    """(n, 3) float32 mm. CalibrationError where one is farther away than anything is."""
    positions = np.array(found)
    off = np.flatnonzero(~(np.abs(positions) < _FARTHEST_MM).all(axis=1))
    if len(off):
        raise CalibrationError(
            f"the {what} of pair {off[0]} lies at {positions[off[0]].tolist()} mm",
            remedy="correct rig.axes, camera and light of sequence.json",
        )
    return positions.astype(np.float32)


def _heights(path: Path, grid: Grid) -> NDArray[np.float64]:
    """(h, w) heights in mm of a relief file that lies over the sample's area."""
    relief = relief_file.read(path)
    rows, columns = relief.size
    if not np.isclose(rows / columns, grid.h / grid.w, rtol=0.02):
        raise CalibrationError(
            f"{path} is {columns} x {rows} texels; the sample's area is {grid.w} x {grid.h}",
            remedy="give the relief of the same area, as btfkit heightfield makes it",
        )
    wanted = (grid.h, grid.w)
    coarser = np.array(relief.size) / wanted
    at = [(np.arange(n) + 0.5) * c - 0.5 for n, c in zip(wanted, coarser, strict=True)]
    # Blurred as its own texels are finer: a texel lies on the mean of what it covers.
    smooth = ndimage.gaussian_filter(
        relief.height.astype(float), 0.5 * np.maximum(coarser - 1, 0), mode="nearest"
    )
    heights = ndimage.map_coordinates(
        smooth, np.meshgrid(*at, indexing="ij"), order=1, mode="nearest"
    )
    return np.asarray(heights * grid.w * grid.texel_mm)


def _validity(textures: CapturedTextures) -> NDArray[np.bool_]:
    """(n, h, w) False for pairs of which there is no frame."""
    seen = np.array([textures.seen(k) for k in range(textures.shape[0])])
    return np.broadcast_to(seen[:, None, None], textures.shape[:3]).copy()
