"""Frames of a posed camera onto the plane of the sample, each texel with its own footprint.

A texel is wanted with the blur of a Gaussian of some standard deviation on the sample. Pixel and
lens have blurred already; what is missing is done here, so that every texel of every view comes
with the same blur where the camera resolves it, and with a stated, larger one where it does not.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit.calibration.camera_model import Camera
from btfkit.calibration.kinematics import Rigid
from btfkit.native import resample

Array = NDArray[np.float32]
Floats = NDArray[np.float64]
# The blur of one texel, as everywhere in the toolkit.
ONE_TEXEL = 0.5
# Variance of a square pixel along either side, px^2.
_PIXEL = 1 / 12
# Gaussians narrower than half the distance of samples fall between them, and what is finer than
# pixels comes back as stripes (0.7 % of it at this width). Colours of a mosaic lie two apart.
_NARROWEST_PX = {False: 0.5, True: 1.0}
# Sine of the slant below which a plane is seen edge on.
_EDGE_ON = 1e-6
# A texel of which a tenth was not seen is a guess about that tenth.
_COVERED = 0.9


@final
@dataclass(frozen=True)
class Grid:
    """Texels on the sample's plane, centred on the origin; row 0 at the top (largest y).

    Attributes:
        rows, columns: of the whole grid. texel_mm: edge of a texel.
        first_row, first_column, h, w: the window that is asked for.
    """

    rows: int
    columns: int
    texel_mm: float
    first_row: int = 0
    first_column: int = 0
    h: int = -1
    w: int = -1

    def __post_init__(self) -> None:
        object.__setattr__(self, "h", self.rows - self.first_row if self.h < 0 else self.h)
        object.__setattr__(self, "w", self.columns - self.first_column if self.w < 0 else self.w)
        if min(self.h, self.w) < 1 or not self.texel_mm > 0:
            raise ValueError(f"a grid of {self.h} x {self.w} texels of {self.texel_mm} mm is none")

    def window(self, rows: slice, columns: slice) -> Grid:
        """A window of this one; slices have start and stop within it."""
        return Grid(
            self.rows, self.columns, self.texel_mm,
            self.first_row + rows.start, self.first_column + columns.start,
            rows.stop - rows.start, columns.stop - columns.start,
        )  # fmt: skip

    def points(self, height_mm: Floats | None = None) -> Floats:
        """(h, w, 3) centres of texels, sample frame, mm; on a relief (h, w) where one is given."""
        x = (self.first_column + np.arange(self.w) + 0.5 - self.columns / 2) * self.texel_mm
        y = (self.rows / 2 - self.first_row - np.arange(self.h) - 0.5) * self.texel_mm
        z = np.zeros((self.h, self.w)) if height_mm is None else height_mm
        return np.stack([*np.meshgrid(x, y), z], axis=-1)


@final
@dataclass(frozen=True, eq=False)
class Footprints:
    """Where texels lie in a frame, and what each takes of it.

    Attributes:
        place: (h, w, 2) pixel of each centre, column first; NaN where the camera does not see it.
        inverse: (h, w, 3) inverse covariance of the Gaussian over pixels: xx, xy, yy.
        blur: (h, w, 3) covariance of the texel's whole blur on the sample, texels^2: uu, uv, vv
            with u along columns and v along rows.
    """

    place: Floats
    inverse: Array
    blur: Array

    @property
    def footprint(self) -> Array:
        """(h, w) standard deviation of the blur, texels: the mean over directions, by squares."""
        return np.sqrt((self.blur[..., 0] + self.blur[..., 2]) / 2)

    @property
    def axes(self) -> tuple[Array, Array]:
        """(h, w) standard deviations along the longest and the shortest axis, texels."""
        uu, uv, vv = np.moveaxis(self.blur, -1, 0)
        mean, half = (uu + vv) / 2, np.hypot((uu - vv) / 2, uv)
        return np.sqrt(mean + half), np.sqrt(np.maximum(mean - half, 0))

    def window(self, height: int, width: int, *, margin: int = 0) -> tuple[slice, slice]:
        """Rows and columns of a frame that texels take anything of; whole 2 x 2 cells of a mosaic.

        Empty slices where none is in the frame.

        Args:
            height, width: of the frame. margin: pixels more on each side, an even number.
        """
        a, b, d = np.moveaxis(self.inverse.astype(float), -1, 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            reach = np.sqrt(resample.CUT * np.stack([d, a], -1) / (a * d - b * b)[..., None])
            low, high = np.floor(self.place - reach), np.ceil(self.place + reach)
        if not np.isfinite(low).any():
            return slice(0, 0), slice(0, 0)
        first = np.maximum(np.nanmin(low, axis=(0, 1)) - margin, 0).astype(int) // 2 * 2
        last = np.nanmax(high, axis=(0, 1)) + 2 + margin
        last = np.minimum(last, [width, height]).astype(int)
        columns, rows = (slice(a, max(a, b)) for a, b in zip(first, last, strict=True))
        return rows, columns


@final
@dataclass(frozen=True, eq=False)
class Rectified:
    """One texture.

    Attributes:
        value: (h, w, c), NaN where not valid. variance: (h, w, c); None where not known.
        coverage: (h, w) share of each footprint that was seen, of the least seen channel.
        valid: (h, w) bool.
    """

    value: Array
    variance: Array | None
    coverage: Array
    valid: NDArray[np.bool_]


def footprints(
    camera: Camera,
    pose: Rigid,
    grid: Grid,
    *,
    footprint: float = ONE_TEXEL,
    blur_px: float = 0.0,
    mosaic: bool = False,
    height_mm: Floats | None = None,
    offset_mm: tuple[float, float] = (0.0, 0.0),
) -> Footprints:
    """The footprints of texels in a frame.

    Args:
        camera, pose: sample to camera.
        grid: texels.
        footprint: blur that is wanted, texels.
        blur_px: standard deviation of the lens's own blur.
        mosaic: whether frames are mosaics, whose colours lie farther apart.
        height_mm: (h, w) of a relief; texels are then looked for on it.
        offset_mm: by how much the frame shows them displaced on the sample, x and y.
    """
    points = grid.points(height_mm) + np.array([*offset_mm, 0.0])
    place, by_point, _ = camera.project_with_derivatives(pose(points))
    # Texels step along +x with columns and along -y with rows.
    steps = pose.rotation[:, :2] * [grid.texel_mm, -grid.texel_mm]
    slope = by_point @ steps
    centre = pose.inverse().translation
    # The plane is seen from its upper side only.
    above = centre[2] - points[..., 2] > _EDGE_ON * np.linalg.norm(centre)
    place[~above | np.isnan(place.sum(-1))] = np.nan
    wanted = footprint**2 * (slope @ np.swapaxes(slope, -1, -2))
    present = _PIXEL + blur_px**2
    extra = _at_least(wanted - present * np.eye(2), _NARROWEST_PX[mosaic] ** 2)
    # The kernel ends its Gaussians: what is left of their covariance shall be the one wanted.
    inverse = np.linalg.inv(extra / resample.KEPT)
    with np.errstate(invalid="ignore"):
        back = _inverse(slope)
        blur = back @ (extra + present * np.eye(2)) @ np.swapaxes(back, -1, -2)
    return Footprints(place, _packed(inverse), _packed(blur))


def rectify(
    image: Array,
    where: Footprints,
    *,
    variance: Array | None = None,
    sites: NDArray[np.int32] | None = None,
    colours: Array | None = None,
    origin: tuple[int, int] = (0, 0),
    threads: int | None = None,
) -> Rectified:
    """A texture out of a frame.

    Args:
        image: (h', w', c) radiance, NaN where unusable; or a mosaic (h', w', 1).
        where: footprints of the texels.
        variance: (h', w', c) of the radiance.
        sites: (2, 2) channel of the first pixels of a mosaic.
        colours: (h', w', 3) of a mosaic, as `demosaic` tells them between its samples: values are
            gathered from these. Variance and coverage stay those of the samples, since what the
            other colours add is detail that a texel's kernel averages out.
        origin: row and column of the image's first pixel in the frame.
    """
    h, w = where.place.shape[:2]
    place = where.place.reshape(-1, 2) - [origin[1], origin[0]]
    found = resample.ewa(
        image, place, where.inverse.reshape(-1, 3), variance=variance, sites=sites, colours=colours,
        threads=threads,
    )  # fmt: skip
    coverage = found.coverage.min(axis=1).reshape(h, w)
    valid = coverage >= _COVERED
    value = np.where(valid[..., None], found.value.reshape(h, w, -1), np.float32(np.nan))
    spread = found.variance
    if spread is not None:
        spread = np.where(valid[..., None], spread.reshape(h, w, -1), np.float32(np.nan))
    return Rectified(value, spread, coverage, valid)


def _at_least(matrix: Floats, least: float) -> Floats:
    """(..., 2, 2) symmetric matrices whose eigenvalues below `least` are raised to it."""
    xx, xy, yy = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 1]
    mean, half = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    large, small = np.maximum(mean + half, least), np.maximum(mean - half, least)
    with np.errstate(invalid="ignore", divide="ignore"):
        turn = np.where(half > 0, (large - small) / (2 * half), 0.0)
    middle = (large + small) / 2
    out = turn[..., None, None] * (matrix - mean[..., None, None] * np.eye(2))
    return out + middle[..., None, None] * np.eye(2)


def _inverse(matrix: Floats) -> Floats:
    """(..., 2, 2) inverses; not finite where there is none."""
    (a, b), (c, d) = np.moveaxis(matrix, (-2, -1), (0, 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        det = 1 / (a * d - b * c)
        return np.stack([np.stack([d, -b], -1), np.stack([-c, a], -1)], -2) * det[..., None, None]


def _packed(matrix: NDArray[np.floating]) -> Array:
    return np.stack([matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 1]], -1).astype(
        np.float32
    )
