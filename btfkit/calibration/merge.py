"""One radiance out of an exposure series: the merge of least variance.

Weights follow the full noise model (read, shot, rounding) and are iterated, since shot noise is
that of the radiance sought. Negative values after black subtraction are kept: clamping them
would brighten the dark.

Source: Granados et al., "Optimal HDR reconstruction with linear digital cameras", 2010, eqs. 4-9.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from btfkit.calibration.noise import NoiseModel
from btfkit.errors import CalibrationError

Array = NDArray[np.float32]
Raw = NDArray[Any]
VALID, BELOW_NOISE, SATURATED, DEAD = range(4)
# Pixels at once: buffers of six such blocks stay in a second-level cache.
_BLOCK = 1 << 15
_ROUNDS = 3
# A count whose mean is nearer than this to saturation is cut off at one side too often.
_MARGIN_SD = 4.0


@final
@dataclass(frozen=True, eq=False)
class Merged:
    """What an exposure series says.

    Attributes:
        radiance: (h, w) counts a second; NaN where nothing tells.
        variance: (h, w) of `radiance`; infinite where nothing tells.
        validity: (h, w) VALID; BELOW_NOISE, kept, less than one deviation above 0; SATURATED in
            every exposure; DEAD, not finite in any.
    """

    radiance: Array
    variance: Array
    validity: NDArray[np.uint8]

    def counts(self) -> dict[str, int]:
        """How many pixels are what."""
        names = ("valid", "below_noise", "saturated", "dead")
        found = np.bincount(self.validity.ravel(), minlength=4)
        return dict(zip(names, map(int, found), strict=True))


def merge_exposures(
    raw: Sequence[Raw] | Raw, exposure_s: ArrayLike, noise: NoiseModel, *, lamp: ArrayLike = 1.0
) -> Merged:
    """Radiance, its variance and validity from raw frames of one exposure series.

    Args:
        raw: k frames (h, w) of linear counts, any order.
        exposure_s: (k,) shutter times, seconds.
        noise: of the sensor.
        lamp: (k,) brightness of the lamp during each, relative; radiance is that at 1.

    Raises:
        CalibrationError: no frame, frames of different size, or a time that is none.
    """
    frames, exposure, light = checked(raw, exposure_s, lamp)
    shape = frames[0].shape
    maps = [_flat(value, shape) for value in (noise.black, noise.dark, noise.sensitivity)]
    order = np.argsort(exposure * light)
    flat = [frames[i].reshape(-1) for i in order]
    exposure, light = exposure[order], light[order]
    out = Merged(
        np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.uint8)
    )
    results = [value.reshape(-1) for value in (out.radiance, out.variance, out.validity)]
    scratch = _Scratch(len(flat), min(_BLOCK, flat[0].size))
    with np.errstate(divide="ignore", invalid="ignore"):
        for start in range(0, flat[0].size, _BLOCK):
            at = slice(start, min(start + _BLOCK, flat[0].size))
            black, dark, sensitivity = (m[at] if np.ndim(m) else m for m in maps)
            block = [f[at] for f in flat]
            scratch.load(block, exposure, light, noise, black, dark)
            scratch.solve(noise, exposure, light, dark)
            scratch.store([r[at] for r in results], block, sensitivity)
    return out


@final
class _Scratch:
    """Buffers of one block, written over and over.

    Args:
        k: exposures. size: most pixels in a block.
    """

    def __init__(self, k: int, size: int) -> None:
        self._signal = np.empty((k, size), np.float32)
        self._used = np.empty((k, size), bool)
        self._sums = np.empty((5, size), np.float32)
        self._n = size

    def load(
        self, block: list[Raw], exposure: Any, light: Any, noise: NoiseModel, black: Any, dark: Any
    ) -> None:
        """Counts above black, and which of them tell: 0 where they don't."""
        self._n = block[0].size
        total, time, estimate, *_ = self._sums[:, : self._n]
        total.fill(0)
        time.fill(0)
        limit = noise.full - _MARGIN_SD * float(np.sqrt(noise.variance(noise.full)))
        for i, counts in enumerate(block):
            signal, used = self._signal[i, : self._n], self._used[i, : self._n]
            np.less(counts, noise.white, out=used)
            np.subtract(counts, black, out=signal, casting="unsafe")
            if noise.curve != (0.0, 0.0):
                signal[...] = noise.linear(signal)
            if np.ndim(dark) or dark:
                signal -= np.float32(exposure[i]) * np.asarray(dark, np.float32)
            if counts.dtype.kind == "f":
                used &= np.isfinite(signal)
            if i:
                # What shorter exposures say decides whether this one is near saturation: its
                # own noise would choose the low ones.
                np.divide(total, time, out=estimate)
                estimate *= np.float32(exposure[i] * light[i])
                used &= ~(estimate > limit)
            np.copyto(signal, 0, where=~used)
            total += signal
            time += used * np.float32(exposure[i] * light[i])
        np.divide(total, time, out=estimate)

    def solve(self, noise: NoiseModel, exposure: Any, light: Any, dark: Any) -> None:
        """Weights of the noise model at the present estimate, over and over."""
        numerator, denominator, estimate, weight, product = self._sums[:, : self._n]
        per_count = np.float32(1 / noise.gain)
        for _ in range(_ROUNDS):
            numerator.fill(0)
            denominator.fill(0)
            np.maximum(estimate, 0, out=estimate)
            for i, t in enumerate(exposure * light):
                np.multiply(estimate, per_count * np.float32(t), out=weight)
                weight += np.float32(noise.floor)
                if np.ndim(dark) or dark:
                    weight += np.maximum(dark, 0) * np.float32(exposure[i] / noise.gain)
                np.divide(np.float32(t), weight, out=weight)
                np.multiply(weight, self._used[i, : self._n], out=weight)
                np.multiply(weight, self._signal[i, : self._n], out=product)
                numerator += product
                weight *= np.float32(t)
                denominator += weight
            np.divide(numerator, denominator, out=estimate)

    def store(self, results: list[Any], block: list[Raw], sensitivity: Any) -> None:
        """The block's radiance, variance and validity."""
        _, denominator, estimate, *_ = self._sums[:, : self._n]
        radiance, variance, validity = results
        radiance[...] = estimate
        np.divide(1, denominator, out=variance)
        if sensitivity is not None:
            # A pixel that sees nothing is dead: 0 / 0 is NaN, and so is its radiance.
            radiance /= sensitivity
            variance /= np.square(sensitivity)
        none = ~np.isfinite(radiance)
        validity[...] = np.where(radiance * np.abs(radiance) < variance, BELOW_NOISE, VALID)
        if none.any():
            finite = np.isfinite(np.stack([b[none] for b in block])).any(axis=0)
            if sensitivity is not None:
                finite &= (sensitivity > 0)[none]
            validity[none] = np.where(finite, SATURATED, DEAD)
            radiance[none], variance[none] = np.nan, np.inf


def merge_plainly(
    raw: Sequence[Raw] | Raw, exposure_s: ArrayLike, noise: NoiseModel, *, lamp: ArrayLike = 1.0
) -> Merged:
    """`merge_exposures` in float64, all pixels at once, iterated until nothing moves."""
    frames, exposure, light = checked(raw, exposure_s, lamp)
    order = np.argsort(exposure * light)
    counts = np.stack([frames[i] for i in order]).astype(float)
    t = (exposure * light)[order][:, None, None]
    dark = exposure[order][:, None, None] * np.asarray(noise.dark, float)
    signal = noise.linear(counts - noise.black) - dark
    used = (counts < noise.white) & np.isfinite(signal)
    limit = noise.full - _MARGIN_SD * np.sqrt(noise.variance(noise.full))
    with np.errstate(divide="ignore", invalid="ignore"):
        for i in range(1, len(t)):
            total = np.where(used[:i], signal[:i], 0).sum(0)
            used[i] &= ~(total / (used[:i] * t[:i]).sum(0) * t[i] > limit)
        signal = np.where(used, signal, 0)
        radiance = signal.sum(0) / (used * t).sum(0)
        for _ in range(50):
            weight = used * t / noise.variance(np.maximum(radiance, 0) * t + np.maximum(dark, 0))
            radiance = (weight * signal).sum(0) / (weight * t).sum(0)
        sensitivity = np.ones(radiance.shape) if noise.sensitivity is None else noise.sensitivity
        variance = 1 / (weight * t).sum(0) / sensitivity**2
        radiance = radiance / sensitivity
        none = ~np.isfinite(radiance)
        below = radiance * np.abs(radiance) < variance
    seen = np.isfinite(counts).any(0) & (sensitivity > 0)
    validity = np.where(none, np.where(seen, SATURATED, DEAD), np.where(below, BELOW_NOISE, VALID))
    return Merged(
        np.where(none, np.nan, radiance).astype(np.float32),
        np.where(none, np.inf, variance).astype(np.float32),
        validity.astype(np.uint8),
    )


def checked(
    raw: Sequence[Raw] | Raw, exposure_s: ArrayLike, lamp: ArrayLike
) -> tuple[list[Raw], NDArray[np.float64], NDArray[np.float64]]:
    """Frames (h, w) of one size, their times (k,) and lamp readings (k,).

    Raises:
        CalibrationError: no frame, frames of different size, or a time or reading that is none.
    """
    frames = [np.ascontiguousarray(frame) for frame in raw]
    exposure = np.atleast_1d(np.asarray(exposure_s, float))
    if not frames or len(frames) != len(exposure):
        raise CalibrationError(
            f"{len(frames)} frames and {len(exposure)} exposure times; expected as many of both",
            remedy="give every frame its exposure_s",
        )
    for i, frame in enumerate(frames):
        if frame.ndim not in (2, 3) or frame.shape != frames[0].shape or not frame.size:
            raise CalibrationError(
                f"frame {i} of the exposure series has shape {frame.shape}, the first "
                f"{frames[0].shape}; expected (h, w) or (h, w, c) counts of one size",
                remedy="leave the frame out or capture it again",
            )
    light = np.broadcast_to(np.asarray(lamp, float), exposure.shape)
    for name, values in (("exposure time", exposure), ("lamp reading", light)):
        bad = np.flatnonzero(~(np.isfinite(values) & (values > 0)))
        if bad.size:
            raise CalibrationError(
                f"frame {bad[0]} of the exposure series has {name} {values[bad[0]]:g}; "
                "expected a positive number",
                remedy="correct it in sequence.csv",
            )
    return frames, exposure, np.array(light)


def _flat(value: Any, shape: tuple[int, ...]) -> Any:
    """A map (h, w) as float32 (h w,); a number as float32; None as it is."""
    if value is None:
        return None
    if np.ndim(value) == 0:
        return np.float32(value)
    if np.shape(value) != shape:
        raise CalibrationError(
            f"a map of the sensor is {np.shape(value)}, the frames are {shape}",
            remedy="calibrate with frames of the size that is merged",
        )
    return np.ascontiguousarray(value, np.float32).reshape(-1)
