"""The first stage: the sensor's noise, response and exposure times, from the run's own frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit.calibration.dark import Dark, fit_dark
from btfkit.calibration.exposures import refine_exposures
from btfkit.calibration.noise import NoiseModel
from btfkit.calibration.radiometry import Radiometry, as_plane
from btfkit.calibration.response import fit_linearity, fit_sensitivity
from btfkit.calibration.transfer import exposure_pairs, lacks_photon_noise, photon_transfer
from btfkit.errors import CalibrationError
from btfkit.sequence import Sequence

Floats = NDArray[np.floating]
# More frames than this say no more: the error falls with the root of their number.
_MOST_DARKS, _MOST_FLATS, _MOST_GROUPS = 24, 24, 4
# So many equal counts at the top, and three times as many as in the counts just below.
_PILE, _NEAR_TOP = 50, 16
# A frame without light has equal counts too.
_DARKEST = 0.1
# Electrons a count whose photon noise is far below rounding.
NOISELESS_GAIN = 1e12
_LIT = ("sample", "white", "colour", "reference", "target")


def frames_used(sequence: Sequence) -> list[int]:
    """Indices of the frames that this stage reads."""
    groups = [i for group in _bracketed(sequence) for i in group]
    return [*_some(sequence, "dark", _MOST_DARKS), *_some(sequence, "flat", _MOST_FLATS), *groups]


def fit_sensor(sequence: Sequence) -> tuple[Radiometry, dict[str, Any]]:
    """The radiometry of a sequence, and what its fits say of themselves.

    Raises:
        CalibrationError: what neither frames nor sequence.json tell, and how to add it.
    """
    _check_iso(sequence)
    details: dict[str, Any] = {"notes": []}
    # Of a real rig frames without noise are copies or averages, and refused.
    noiseless = bool(sequence.document.get("synthetic")) and _noiseless(sequence)
    if not noiseless:
        _check_saturation(sequence)
    dark = _dark(sequence, details)
    noise = _gain(sequence, dark, details, noiseless=noiseless)
    flats = _some(sequence, "flat", _MOST_FLATS)
    shading = None
    if flats:
        noise, shading = _response(sequence, flats, noise, dark, details)
    else:
        details["notes"].append(
            "no flat frames: neither linearity, nor what differs between pixels"
        )
    cfa = sequence.sensor.cfa
    radiometry = Radiometry(
        noise, cfa, None if dark is None else dark.temperature_c,
        6.5 if dark is None else dark.doubling_k, shading,
    )  # fmt: skip
    return replace(radiometry, factors=_factors(sequence, radiometry, details)), details


def _dark(sequence: Sequence, details: dict[str, Any]) -> Dark | None:
    indices = _some(sequence, "dark", _MOST_DARKS)
    if not indices:
        if sequence.sensor.black is None:
            raise CalibrationError(
                f"{sequence.path}: no dark frames, and sequence.json says no sensor.black",
                remedy="capture frames with the lens capped, kind dark, or write sensor.black",
            )
        details["notes"].append("no dark frames: black level of sequence.json, no dark current")
        return None
    frames = [sequence.frames[i] for i in indices]
    exposure = [frame.need("exposure_s") for frame in frames]
    warm = [np.nan if f.temperature_c is None else f.temperature_c for f in frames]
    dark = fit_dark([as_plane(sequence.image(i)) for i in indices], exposure, warm)
    if dark.clipped > 0.01:
        raise CalibrationError(
            f"{frames[0].file}: {100 * dark.clipped:.0f} % of dark counts are 0: the black "
            "level is cut off, and with it half of the noise",
            remedy="raise the camera's black level (offset)",
        )
    white = sequence.sensor.white
    if white is not None and float(np.mean(dark.black)) > 0.5 * white:
        raise CalibrationError(
            f"{frames[0].file}: dark frames read {float(np.mean(dark.black)):.0f} of {white:g} "
            "counts: they are not dark",
            remedy="cap the lens, or correct kind in sequence.csv",
        )
    details["dark"] = dark.record()
    return dark


def _noiseless(sequence: Sequence) -> bool:
    """Whether flats scatter no more where they are brighter."""
    black, white = float(sequence.sensor.need("black")), float(sequence.sensor.need("white"))
    return lacks_photon_noise([planes for _, planes in _flat_pairs(sequence)], black, white)


def _flat_pairs(sequence: Sequence) -> list[tuple[str, tuple[NDArray[Any], NDArray[Any]]]]:
    """Up to eight pairs of flat frames of one exposure, and the name of each first."""
    flats = [sequence.frames[i] for i in sequence.of_kind("flat")]
    times = [frame.need("exposure_s") for frame in flats]
    groups = [tuple(sorted(frame.axes.items())) for frame in flats]
    indices = sequence.of_kind("flat")
    return [
        (
            flats[a].file,
            (as_plane(sequence.image(indices[a])), as_plane(sequence.image(indices[b]))),
        )
        for a, b in exposure_pairs(times, groups)[:8]
    ]


def _gain(
    sequence: Sequence, dark: Dark | None, details: dict[str, Any], *, noiseless: bool
) -> NoiseModel:
    """The noise model without response, from pairs of flats or from sequence.json."""
    sensor = sequence.sensor
    white = float(sensor.need("white"))
    black: Any = sensor.black if dark is None else dark.black
    current = 0.0 if dark is None else dark.current
    read = None if dark is None else dark.read
    if noiseless:
        details["notes"].append(
            "no photon noise: variances hold read noise and rounding alone (synthetic)"
        )
        return NoiseModel(NOISELESS_GAIN, read or 0.0, white, black, current)
    pairs = _flat_pairs(sequence)
    if pairs:
        try:
            found = photon_transfer([planes for _, planes in pairs], black, white, read=read)
        except CalibrationError as error:
            raise CalibrationError(
                f"{pairs[0][0]} and others: {error.message}", remedy=error.remedy
            ) from error
        details["transfer"] = found.record()
        return NoiseModel(found.gain, found.read, white, black, current)
    if sensor.gain_e_per_dn is None:
        raise CalibrationError(
            f"{sequence.path}: no two flat frames of one exposure, and sequence.json says no "
            "sensor.gain_e_per_dn",
            remedy="capture two flat frames at each of several exposures, or write the gain",
        )
    gain = sensor.gain_e_per_dn
    if read is None:
        if sensor.read_noise_e is None:
            raise CalibrationError(
                f"{sequence.path}: no two dark frames of one exposure, and sequence.json says no "
                "sensor.read_noise_e",
                remedy="capture two dark frames at one exposure, or write the read noise",
            )
        read = sensor.read_noise_e / gain
    details["notes"].append("no pairs of flat frames: gain of sequence.json")
    return NoiseModel(gain, read, white, black, current)


def _response(
    sequence: Sequence,
    flats: list[int],
    noise: NoiseModel,
    dark: Dark | None,
    details: dict[str, Any],
) -> tuple[NoiseModel, Floats]:
    """The noise model with curve and sensitivity, and the shading of the lens."""
    frames = [sequence.frames[i] for i in flats]
    images = [as_plane(sequence.image(i)) for i in flats]
    times = [float(frame.need("exposure_s")) for frame in frames]
    known = all(frame.lamp is not None for frame in frames)
    lamp = [float(f.lamp or 1.0) for f in frames] if known else [1.0] * len(frames)
    try:
        linearity = fit_linearity(images, times, noise, lamp=lamp)
        details["linearity"] = linearity.record()
        noise = replace(noise, curve=linearity.curve)
    except CalibrationError as error:
        details["notes"].append(f"linearity not told: {error.message}")
    columns = 3 if sequence.image(flats[0]).ndim == 3 else 1
    period = (2, 2) if sequence.sensor.cfa != "none" else (1, columns)
    # Where more than a hundredth saturates the rest is chosen by its noise.
    good = [i for i, image in enumerate(images) if np.mean(image >= noise.white) < 0.01]
    if not good:
        raise CalibrationError(
            f"{frames[0].file}: all {len(frames)} flat frames saturate",
            remedy="capture the flat at shorter exposures",
        )
    effective = [times[i] * lamp[i] for i in good]
    found = fit_sensitivity(
        [images[i] for i in good], effective, noise, period=period,
        hot=None if dark is None else dark.hot,
    )  # fmt: skip
    details["sensitivity"] = found.record()
    return replace(noise, sensitivity=found.pixel * found.shading), found.shading


def _factors(
    sequence: Sequence, radiometry: Radiometry, details: dict[str, Any]
) -> Mapping[float, float]:
    """Exposure factors from brackets, all with the same nominal times."""
    groups = _bracketed(sequence)
    if not groups:
        details["notes"].append("no exposure series: exposure times are taken as they are")
        return {}
    times = [float(sequence.frames[i].need("exposure_s")) for i in groups[0]]
    lamps = [[float(sequence.frames[i].lamp or 1.0) for i in group] for group in groups]
    noise = radiometry.noise
    if noise.sensitivity is not None and (noise.sensitivity == 0).any():
        # Hot and dead pixels would count as any other.
        noise = replace(noise, sensitivity=None)
    try:
        found = refine_exposures(
            [[as_plane(sequence.image(i)) for i in group] for group in groups], times, noise,
            lamp=lamps,
        )  # fmt: skip
    except CalibrationError as error:
        details["notes"].append(f"exposure times taken as they are: {error.message}")
        return {}
    details["exposures"] = found.record()
    return {float(t): float(f) for t, f in zip(times, found.factor, strict=True)}


def _bracketed(sequence: Sequence) -> list[tuple[int, ...]]:
    """Up to four groups of frames with the same, different exposure times; spread over the run."""
    found: dict[tuple[float, ...], list[tuple[int, ...]]] = {}
    for indices in sequence.groups(*_LIT).values():
        members = [i for i in indices if sequence.frames[i].exposure_s is not None]
        members.sort(key=lambda i: float(sequence.frames[i].exposure_s or 0))
        times = tuple(float(sequence.frames[i].exposure_s or 0) for i in members)
        if len(times) > 1 and len(set(times)) == len(times):
            found.setdefault(times, []).append(tuple(members))
    if not found:
        return []
    most = max(found.values(), key=len)
    return [most[i] for i in np.unique(np.linspace(0, len(most) - 1, _MOST_GROUPS).astype(int))]


def _some(sequence: Sequence, kind: str, most: int) -> list[int]:
    """Indices of a kind, evenly over the run where there are many; pairs stay pairs."""
    indices = sequence.of_kind(kind)
    if len(indices) <= most:
        return list(indices)
    starts = np.unique(np.linspace(0, len(indices) // 2 - 1, most // 2).astype(int))
    return [indices[2 * s + k] for s in starts for k in (0, 1)]


def _check_iso(sequence: Sequence) -> None:
    isos = sorted({frame.iso for frame in sequence.frames if frame.iso is not None})
    if len(isos) > 1:
        raise CalibrationError(
            f"{sequence.path}: frames at ISO {', '.join(f'{iso:g}' for iso in isos)}; a gain holds "
            "for one",
            remedy="make a sequence of the frames of each, with darks and flats of its own",
        )


def _check_saturation(sequence: Sequence) -> None:
    """Refuse a saturation level above that of the sensor: what is cut off would count as light.

    Raises:
        CalibrationError: counts pile up below sensor.white.
    """
    white = float(sequence.sensor.need("white"))
    step = 1 if sequence.sensor.cfa == "none" else 2
    for i in frames_used(sequence):
        image = as_plane(sequence.image(i))
        if sequence.frames[i].kind == "dark" or image.dtype.kind != "u":
            continue
        planes = [image[row::step, col::step] for row in range(step) for col in range(step)]
        for top, full in filter(None, (_piled(plane, white) for plane in planes)):
            raise CalibrationError(
                f"{sequence.frames[i].file}: {full} counts pile up at {top}, below sensor.white "
                f"{white:g}",
                remedy=f"write {top} as sensor.white into sequence.json",
            )


def _piled(plane: NDArray[Any], white: float) -> tuple[int, int] | None:
    """The highest count below `white` and how many have it, where they are too many for noise.

    Noise thins out towards its end; a level that cuts it off is full.
    """
    top = int(plane.max())
    if not _DARKEST * white < top < white:
        return None
    full = int(np.count_nonzero(plane == top))
    below = int(np.count_nonzero((plane < top) & (plane >= top - _NEAR_TOP)))
    return (top, full) if full > _PILE and full > 3 * below else None
