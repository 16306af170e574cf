"""By how much one texture is shifted against another, to a hundredth of a texel.

Windowed cross-correlation, not normalised by frequency (which would give noise the same say as
the texture), within a bound: a calibrated rig is never off by half a period of a weave, and a
search that is not bounded jumps by whole ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit.errors import CalibrationError

Floats = NDArray[np.float64]
# Rounds of moving one picture onto the other: the window's own pull on the peak dies with them.
_ROUNDS = 6
_SETTLED = 1e-4
# What two pictures have in common must be this many deviations of what chance gives; and along
# stripes there is this share of what there is across them.
_CHANCE, _STRIPES = 6.0, 1e-4


@final
@dataclass(frozen=True)
class Shift:
    """A shift of the second texture against the first.

    Attributes:
        rows, columns: texels; the second shows at (r + rows, c + columns) what the first does
            at (r, c).
        sd: standard deviation along the worse axis, texels, from the difference that is left.
        gain: brightness of the second over the first.
    """

    rows: float
    columns: float
    sd: float
    gain: float


def register(first: Floats, second: Floats, *, within: float) -> Shift:
    """The shift between two textures of one place.

    Args:
        first, second: (h, w) values; NaN where not valid. Their brightness may differ.
        within: bound of the shift along rows and columns, texels; less than half a period.

    Raises:
        CalibrationError: nothing in the textures tells a shift, or it is not within the bound.
    """
    a, b, mask = _prepared(first, second, within)
    window = _window(a.shape) * mask
    shift = np.zeros(2)
    for turn in range(_ROUNDS):
        moved = _moved(b, -shift)
        step = _peak(a * window, moved * window, within - shift if turn == 0 else 1.0, turn == 0)
        shift += step
        if turn and np.abs(step).max() < _SETTLED:
            break
    moved = _moved(b, -shift)
    norm = float((window * a * a).sum())
    gain = float((window * a * moved).sum() / norm)
    left = moved - gain * a
    sd = _deviation(a * gain, moved, left, window)
    if np.abs(shift).max() > within:
        raise CalibrationError(
            f"textures seem shifted by {shift[0]:.2f}, {shift[1]:.2f} texels, beyond the bound of "
            f"{within:g}",
            remedy="check the calibration of the geometry",
        )
    return Shift(float(shift[0]), float(shift[1]), sd, gain)


def period_of(texture: Floats) -> float | None:
    """Shortest period of a texture along rows or columns, texels; None where it has none.

    A bound for `register` is less than half of it.
    """
    values = np.where(np.isfinite(texture), texture, np.nanmean(texture))
    values = (values - values.mean()) * _window(values.shape)
    power = np.abs(np.fft.fft2(values)) ** 2
    weight = np.fft.ifft2(np.abs(np.fft.fft2(_window(values.shape))) ** 2).real
    match = np.fft.ifft2(power).real / np.maximum(weight, 0.05 * weight[0, 0])
    if not match[0, 0] > 0:
        return None
    found = []
    for line in (match[: len(match) // 2, 0], match[0, : match.shape[1] // 2]):
        line = line / match[0, 0]
        low = np.flatnonzero(line < 0.5)
        if low.size == 0:
            continue
        after = line[low[0] : -1]
        peaks = np.flatnonzero((after[1:-1] > after[:-2]) & (after[1:-1] >= after[2:])) + 1
        high = peaks[after[peaks] > 0.5]
        if high.size:
            found.append(float(low[0] + high[0]))
    return min(found) if found else None


def _prepared(first: Floats, second: Floats, within: float) -> tuple[Floats, Floats, Floats]:
    """Both without their trends, 0 where either is not valid, and the mask of the rest."""
    if first.shape != second.shape or first.ndim != 2 or min(first.shape) < 8:
        raise ValueError(
            f"textures {first.shape} and {second.shape}; expected two (h, w), h, w >= 8"
        )
    if not 0 < within < min(first.shape) / 4:
        raise ValueError(
            f"within = {within:g}; expected up to a quarter of {min(first.shape)} texels"
        )
    valid = np.isfinite(first) & np.isfinite(second)
    if valid.mean() < 0.25:
        raise CalibrationError(
            f"only {valid.mean():.0%} of the texels are valid in both textures",
            remedy="register other views",
        )
    mask = valid.astype(float)
    if not valid.all():
        # A hard edge of the mask would be the strongest feature there is.
        from scipy import ndimage

        inner = ndimage.distance_transform_edt(np.pad(valid, 1))[1:-1, 1:-1]
        mask = np.clip((inner - 1) / 8, 0, 1)
    pictures = []
    for picture in (first, second):
        values = np.where(valid, picture, 0.0)
        trend = _plane(values, mask)
        flat = np.where(valid, values - trend, 0.0)
        size = float(np.abs(values).max())
        if not np.sqrt((mask * flat**2).sum() / mask.sum()) > 1e-6 * max(size, 1e-30):
            raise CalibrationError(
                "the texture is constant: nothing in it tells a shift",
                remedy="register another channel, light or sample",
            )
        pictures.append(flat)
    return pictures[0], pictures[1], mask


def _plane(values: Floats, mask: Floats) -> Floats:
    """(h, w) the plane through values, by least squares."""
    h, w = values.shape
    y, x = np.mgrid[:h, :w] / max(h, w) - 0.5
    basis = np.stack([np.ones(h * w), x.ravel(), y.ravel()], -1)
    weighted = basis * mask.reshape(-1, 1)
    solved = np.linalg.lstsq(weighted.T @ basis, weighted.T @ values.ravel(), rcond=None)[0]
    return (basis @ solved).reshape(h, w)


def _window(shape: tuple[int, ...]) -> Floats:
    """(h, w) Hann window that is 0 outside."""
    return np.outer(*(np.hanning(size + 2)[1:-1] for size in shape))


def _frequencies(shape: tuple[int, ...]) -> tuple[Floats, Floats]:
    """(h, 1) and (1, w) angular frequencies, the one at Nyquist left out: it has no sign."""
    out = []
    for size in shape:
        frequency = np.asarray(2 * np.pi * np.fft.fftfreq(size), np.float64)
        if size % 2 == 0:
            frequency[size // 2] = 0
        out.append(frequency)
    return out[0][:, None], out[1][None]


def _moved(picture: Floats, by: Floats) -> Floats:
    """A picture shifted by (rows, columns), round about: the window hides where it comes in."""
    if not np.any(by):
        return picture
    down, across = _frequencies(picture.shape)
    turned = np.fft.fft2(picture) * np.exp(-1j * (down * by[0] + across * by[1]))
    return np.fft.ifft2(turned).real


def _peak(a: Floats, b: Floats, within: Floats | float, coarse: bool) -> Floats:
    """Where the correlation of b with a is largest: whole texels first, then Newton's steps."""
    cross = np.fft.fft2(b) * np.conj(np.fft.fft2(a))
    at = np.zeros(2)
    if coarse:
        match = np.fft.ifft2(cross).real
        reach = int(np.floor(np.max(within)))
        offsets = np.arange(-reach, reach + 1)
        near = match[np.ix_(offsets, offsets)]
        best = np.unravel_index(int(np.argmax(near)), near.shape)
        at = np.array([offsets[best[0]], offsets[best[1]]], float)
    down, across = _frequencies(a.shape)
    start = at.copy()
    for _ in range(20):
        wave = cross * np.exp(1j * (down * at[0] + across * at[1]))
        slope = np.array([-(wave.imag * f).sum() for f in (down, across)])
        bend = np.array(
            [[-(wave.real * f * g).sum() for g in (down, across)] for f in (down, across)]
        )
        values, axes = np.linalg.eigh(bend)
        # Along what is not a maximum, or is flat, there is no step to take.
        usable = values < 1e-9 * values.min()
        along = axes.T @ slope
        step = -axes @ np.where(usable, along / np.where(usable, values, 1), 0)
        size = float(np.abs(step).max())
        at = np.clip(at + step * min(1.0, 0.5 / max(size, 1e-12)), start - 1, start + 1)
        if size < 1e-7:
            break
    return at


def _deviation(a: Floats, b: Floats, left: Floats, window: Floats) -> float:
    """Standard deviation of the shift along its worse direction.

    Slopes are taken of one picture times the other: noise of its own has none in common with
    the other's.

    Raises:
        CalibrationError: along some direction the texture does not tell a shift.
    """
    of_a, of_b = np.gradient(a), np.gradient(b)
    weight = window**2
    tensor = np.array([[(weight * f * g).sum() for g in of_b] for f in of_a])
    noise = float((weight * left**2).sum() / weight.sum())
    values, axes = np.linalg.eigh((tensor + tensor.T) / 2)
    # Central differences of noise have a quarter of the variance of its difference.
    chance = _CHANCE * noise / 4 * float(np.sqrt((weight**2).sum()))
    if not values[1] > chance:
        raise CalibrationError(
            "the texture is constant but for noise: nothing in it tells a shift",
            remedy="register another channel, light or sample",
        )
    if not values[0] > max(chance, _STRIPES * values[1]):
        direction = "columns" if abs(axes[0, 0]) > abs(axes[1, 0]) else "rows"
        raise CalibrationError(
            f"the texture is constant along its {direction}: nothing tells a shift that way",
            remedy="register another channel, light or sample",
        )
    square = float((weight**2).sum() / weight.sum())
    return float(np.sqrt(noise * square / values[0]))
