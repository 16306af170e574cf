"""Textures of a sequence: merged, rectified and scaled when they are asked for."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import RGB
from btfkit.calibration.alignment import Aligned
from btfkit.calibration.colours import ColourCorrection
from btfkit.calibration.demosaic import colours_of, sites
from btfkit.calibration.merge import Merged
from btfkit.calibration.nominal import LAMP
from btfkit.calibration.rectify import Footprints, Grid, Rectified, rectify
from btfkit.calibration.rig import CalibratedRig
from btfkit.calibration.windows import radiance_of
from btfkit.errors import CalibrationError
from btfkit.footprint import Blurs
from btfkit.sequence import Sequence
from btfkit.textures import Textures

Array = NDArray[np.float32]
# Views whose footprints are kept at hand, and textures whose other maps wait to be asked for.
_VIEWS, _WAITING = 8, 32


@final
class CapturedTextures(Textures):
    """Textures of a sequence, one a pose; of a pose without frames all is NaN.

    Attributes:
        rig: what makes reflectance of frames. grid: texels of the window that is asked for.
    """

    def __init__(
        self,
        sequence: Sequence,
        rig: CalibratedRig,
        poses: list[Mapping[str, float]],
        groups: list[tuple[int, ...]],
        grid: Grid,
    ) -> None:
        self._sequence, self.rig, self.grid = sequence, rig, grid
        self._poses, self._groups = poses, groups
        first = next((group[0] for group in groups if group), None)
        if first is None:
            raise CalibrationError(f"{sequence.path}: none of the sample's frames is there")
        coloured = rig.mosaic or sequence.image(first).ndim == 3
        self.channels = RGB if coloured else ("Y",)
        self._offsets_mm = np.zeros((len(groups), 2))
        self._heights_mm: NDArray[np.float64] | None = None
        self._shaped()

    def _shaped(self) -> None:
        self.shape = (len(self._groups), self.grid.h, self.grid.w, len(self.channels))
        self._views: OrderedDict[tuple[Any, ...], Footprints] = OrderedDict()
        self._waiting: OrderedDict[int, dict[str, Array]] = OrderedDict()
        self._lock = threading.Lock()

    def __getstate__(self) -> dict[str, Any]:
        # What is at hand belongs to the process that read it.
        return {**self.__dict__, "_views": OrderedDict(), "_waiting": OrderedDict(), "_lock": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._lock = threading.Lock()

    def _changed(self, **changes: Any) -> CapturedTextures:
        out = CapturedTextures.__new__(CapturedTextures)
        out.__dict__.update({**self.__dict__, **changes})
        out._shaped()
        return out

    def moved(self, shifts: list[Aligned]) -> CapturedTextures:
        """The same with each view looked for where it shows the sample."""
        offsets = self._offsets_mm.copy()
        for view in shifts:
            offsets[list(view.pairs)] += self.grid.texel_mm * np.array([view.columns, -view.rows])
        return self._changed(_offsets_mm=offsets)

    def on_relief(self, heights_mm: NDArray[np.float64]) -> CapturedTextures:
        """The same with each texel looked for at its height (h, w): without parallax."""
        return self._changed(_heights_mm=heights_mm)

    def with_unseen(self, count: int) -> CapturedTextures:
        """The same and as many textures more of which nothing was seen."""
        return self._changed(
            _poses=[*self._poses, *[{}] * count], _groups=[*self._groups, *[()] * count],
            _offsets_mm=np.concatenate([self._offsets_mm, np.zeros((count, 2))]),
        )  # fmt: skip

    def seen(self, index: int) -> bool:
        """Whether a texture has a frame."""
        return bool(self._groups[index])

    def placed(self, index: int) -> bool:
        """Whether it is known from where a texture was seen."""
        return bool(self._poses[index]) or self.seen(index)

    def variance(self) -> Textures:
        """The variances of these textures, each at hand after its texture was asked for."""
        return _Beside(self, "variance")

    def coverage(self) -> Textures:
        """(n, h, w, 1) seen share of each footprint, at hand after the texture was asked for."""
        return _Beside(self, "coverage")

    def blurs(self) -> Blurs:
        """The blur of every texel, a map a view."""
        views: dict[tuple[float, ...], int] = {}
        of = [views.setdefault(self._view(k), len(views)) for k in range(len(self))]
        first = [of.index(view) for view in range(len(views))]
        return Blurs(_BlurMaps(self, first), np.array(of, np.intp))

    def brightness(self, index: int) -> Array:
        """(h, w) mean of the channels."""
        return np.asarray(self.rectified(index).value.mean(axis=2))

    def rectified(self, index: int) -> Rectified:
        """A texture with its variance, coverage and validity."""
        group = self._groups[index]
        if not group:
            return _unseen(self.shape[1:])
        where = self.footprints(index)
        # Filters between the samples of a mosaic reach beyond what texels take.
        window = where.window(*self._sequence.frame_size, margin=4 if self.rig.mosaic else 0)
        merged = self._merged(group, window)
        if merged is None:
            return _unseen(self.shape[1:])
        mosaic = self.rig.mosaic
        image, variance = merged.radiance, merged.variance
        if image.ndim == 2:
            image, variance = image[..., None], variance[..., None]
        found = rectify(
            image, where, variance=variance, threads=1, colours=self._between(merged),
            sites=sites(self.rig.radiometry.cfa, (2, 2)).astype(np.int32) if mosaic else None,
            origin=(window[0].start, window[1].start),
        )  # fmt: skip
        return self._scaled(found, self._poses[index])

    def _between(self, merged: Merged) -> Array | None:
        """(h, w, 3) colours of a mosaic at every pixel; None where their balance is not known."""
        rig = self.rig
        if not rig.mosaic or len(np.atleast_1d(rig.scale)) != 3:
            return None
        return colours_of(merged, rig.radiometry.cfa, balance=rig.scale)

    def cropped(self, rows: slice, cols: slice) -> CapturedTextures:
        """A window of these."""
        heights = None if self._heights_mm is None else self._heights_mm[rows, cols]
        return self._changed(grid=self.grid.window(rows, cols), _heights_mm=heights)

    def crop(self, rows: slice, cols: slice) -> Textures:
        return self.cropped(rows, cols)

    def _read(self, index: int) -> Array:
        found = self.rectified(index)
        beside = _beside(found)
        with self._lock:
            self._waiting[index] = beside
            while len(self._waiting) > _WAITING:
                self._waiting.popitem(last=False)
        return found.value

    def take(self, name: str, index: int) -> Array:
        """(h, w, ...) variance or coverage; made anew where the texture was not just asked for."""
        with self._lock:
            waiting = self._waiting.get(index, {}).pop(name, None)
        if waiting is None:
            waiting = _beside(self.rectified(index)).get(name)
        if waiting is None:
            raise CalibrationError(f"the sensor's noise is not known, and so no {name}")
        return waiting

    def footprints(self, index: int) -> Footprints:
        """Where the texels of a texture lie in its frames; all lights of a view share them."""
        key = self._view(index)
        readings = self._poses[index]
        with self._lock:
            known = self._views.get(key)
        if known is None:
            x, y = self._offsets_mm[index].tolist()
            known = self.rig.footprints(
                readings, self.grid, height_mm=self._heights_mm, offset_mm=(x, y)
            )
            with self._lock:
                self._views[key] = known
                while len(self._views) > _VIEWS:
                    self._views.popitem(last=False)
        return known

    def _view(self, index: int) -> tuple[float, ...]:
        """What tells a texture's view from others; empty of one that was not seen."""
        if not self.placed(index):
            return ()
        readings = self._poses[index]
        chains = self.rig.geometry.kinematics.chains
        moved = (*chains.get("sample", ()), *chains.get("camera", ()))
        return (*(readings[name] for name in moved), *self._offsets_mm[index].tolist())

    def _merged(self, group: tuple[int, ...], window: tuple[slice, slice]) -> Merged | None:
        """Merged exposures of the window, without stray light."""
        rows, columns = window
        if rows.stop <= rows.start or columns.stop <= columns.start:
            return None
        rig = self.rig
        lamp = [rig.lamp.get(i, 1.0) for i in group]
        return radiance_of(self._sequence, group, window, rig.radiometry, rig.stray, lamp)

    def _scaled(self, found: Rectified, readings: Mapping[str, float]) -> Rectified:
        """From radiance to the quantity of a BTF, with the lamp's distance at every texel."""
        rig = self.rig
        factor = 1 / np.asarray(rig.scale, float)
        if rig.distance_mm is not None:
            lamp = rig.geometry.light_position(LAMP, readings)
            square = ((lamp - self.grid.points()) ** 2).sum(-1) / rig.distance_mm**2
            factor = square[..., None] * factor
        value = (found.value * factor).astype(np.float32)
        variance = (
            None if found.variance is None else (found.variance * factor**2).astype(np.float32)
        )
        if rig.colour is not None and value.shape[2] == 3:
            value, variance = _corrected(rig.colour, value, variance)
        return replace(found, value=value, variance=variance)


@final
class _Beside(Textures):
    """What comes with captured textures: their variances, or how much of each texel was seen."""

    def __init__(self, of: CapturedTextures, name: str) -> None:
        self._of, self._name = of, name
        self.shape = of.shape if name == "variance" else (*of.shape[:3], 1)

    def _read(self, index: int) -> Array:
        return self._of.take(self._name, index)

    def crop(self, rows: slice, cols: slice) -> Textures:
        return _Beside(self._of.cropped(rows, cols), self._name)


@final
class _BlurMaps(Textures):
    """The blur of every texel of some of the captured textures."""

    def __init__(self, of: CapturedTextures, pairs: list[int]) -> None:
        self._of, self._pairs = of, pairs
        self.shape = (len(pairs), *of.shape[1:3], 3)

    def _read(self, index: int) -> Array:
        pair = self._pairs[index]
        if not self._of.placed(pair):
            return np.full(self.shape[1:], np.nan, np.float32)
        where = self._of.footprints(pair)
        shown = np.asarray(np.isfinite(where.place).all(-1))
        return np.where(shown[..., None], where.blur, np.float32(np.nan))

    def crop(self, rows: slice, cols: slice) -> Textures:
        return _BlurMaps(self._of.cropped(rows, cols), self._pairs)


def _beside(found: Rectified) -> dict[str, Array]:
    """What comes with a texture, as the lists of it give it."""
    out = {"coverage": found.coverage.astype(np.float32)[..., None]}
    return out if found.variance is None else {**out, "variance": found.variance}


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
