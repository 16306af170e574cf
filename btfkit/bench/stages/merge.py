"""What merging an exposure series costs, and how near it comes to the bound of its noise.

Twelve bits, black 200, 15 electrons a count, 6 electrons of read noise, exposures of 1, 1/4, 1/16
and 1/64 s, radiances over five decades; synthetic, one seed. Beside ours: a plain sum over times
(Poisson), the best single exposure, hat weights, and OpenCV's Debevec on 16 bits.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit.calibration.merge import merge_exposures, merge_plainly
from btfkit.calibration.noise import NoiseModel

Floats = NDArray[Any]
GAIN, READ_E, BLACK, WHITE = 15.0, 6.0, 200.0, 4095
EXPOSURE = np.array([1, 1 / 4, 1 / 16, 1 / 64])
DECADES = (20.0, 200.0, 2e3, 2e4, 2e5)
NOISE = NoiseModel(gain=GAIN, read=READ_E / GAIN, white=WHITE, black=BLACK)
_SIDES = {False: (512, 1024, 2048), True: (64, 128, 256)}
# The slow ones are measured at the smallest size alone.
_SLOW = ("its plain twin",)


def cells(*, seed: int, quick: bool) -> list[dict[str, Any]]:
    """A row a method and size: relative deviation and bias by decade of electrons a second."""
    rows = []
    for number, side in enumerate(_SIDES[quick]):
        rng = np.random.default_rng([seed, number])
        photons = 10 ** rng.uniform(np.log10(DECADES[0]), np.log10(10 * DECADES[-1]), (side, side))
        frames = _shot(photons, rng)
        bound = NOISE.bound(photons / GAIN, EXPOSURE) * GAIN / photons
        rows.append(_row("bound", photons, bound, np.zeros_like(bound), None))
        for name, method in METHODS.items():
            if name in _SLOW and number:
                continue
            start = time.process_time()
            found = method(frames)
            seconds = time.process_time() - start
            # One of them leaves the scale open: the brightest decade sets it.
            bright = photons >= DECADES[-1]
            open_scale = name.startswith("OpenCV")
            scale = float(np.nanmedian(photons[bright] / found[bright])) if open_scale else GAIN
            off = found * scale / photons - 1
            rows.append(_row(name, photons, off, off, seconds))
    return rows


def _row(
    name: str, photons: Floats, off: Floats, signed: Floats, seconds: float | None
) -> dict[str, Any]:
    row: dict[str, Any] = {"method": name, "megapixels": photons.size / 1e6, "cpu_s": seconds}
    bands = [(photons >= d) & (photons < 10 * d) for d in DECADES]
    for low, band in zip(DECADES, bands, strict=True):
        row[f"sd {low:g}"] = float(np.sqrt(np.nanmean(off[band] ** 2)))
    row["worst bias"] = max((float(np.nanmean(signed[b])) for b in bands), key=abs)
    return row


def _shot(photons: Floats, rng: np.random.Generator) -> list[Floats]:
    """Counts (h, w) of each exposure of (h, w) electrons a second."""
    frames = []
    for t in EXPOSURE:
        electrons = rng.poisson(photons * t) + rng.normal(0, READ_E, photons.shape)
        frames.append(np.clip(np.rint(BLACK + electrons / GAIN), 0, WHITE).astype(np.uint16))
    return frames


def _ours(frames: list[Floats]) -> Floats:
    return merge_exposures(frames, EXPOSURE, NOISE).radiance


def _plain(frames: list[Floats]) -> Floats:
    return merge_plainly(frames, EXPOSURE, NOISE).radiance


def _poisson(frames: list[Floats]) -> Floats:
    """Sum of counts over the sum of times, of what does not saturate."""
    raw = np.stack(frames).astype(float)
    used = raw < WHITE
    t = EXPOSURE[:, None, None]
    with np.errstate(invalid="ignore"):
        return np.asarray((used * (raw - BLACK)).sum(0) / (used * t).sum(0))


def _single(frames: list[Floats]) -> Floats:
    """The longest exposure that does not saturate."""
    raw = np.stack(frames).astype(float)
    best = np.argmax(raw < WHITE, axis=0)
    counts = np.take_along_axis(raw, best[None], axis=0)[0]
    return np.asarray((counts - BLACK) / EXPOSURE[best])


def _hat(frames: list[Floats]) -> Floats:
    """Weights that fall to both ends of the range."""
    raw = np.stack(frames).astype(float)
    weight = np.minimum(raw, WHITE - raw) + 1e-6
    return np.asarray((weight * (raw - BLACK) / EXPOSURE[:, None, None]).sum(0) / weight.sum(0))


def _debevec(frames: list[Floats]) -> Floats:
    """OpenCV's, with the linear response that 16 bits get."""
    import cv2

    # What saturates has to be the highest code: only there its weight is 0.
    lift = 65535 / (WHITE - BLACK)
    lifted = [np.clip((f.astype(float) - BLACK) * lift, 0, 65535).astype(np.uint16) for f in frames]
    merged = cv2.createMergeDebevec().process(
        [cv2.merge([f] * 3) for f in lifted], EXPOSURE.astype(np.float32)
    )
    return np.asarray(merged)[..., 0]


METHODS: dict[str, Callable[[list[Floats]], Floats]] = {
    "noise model, iterated": _ours, "its plain twin": _plain, "sum over times": _poisson,
    "best single exposure": _single, "hat weights": _hat, "OpenCV Debevec, 16 bits": _debevec,
}  # fmt: skip
