"""From raw frames to radiance: the sensor's own part of a calibration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from btfkit.calibration.calibration import Section
from btfkit.calibration.demosaic import sites
from btfkit.calibration.merge import Merged, merge_exposures
from btfkit.calibration.noise import NoiseModel
from btfkit.errors import CalibrationError
from btfkit.sequence import Sequence as Frames

Floats = NDArray[np.floating]


@final
@dataclass(frozen=True, eq=False)
class Radiometry:
    """How counts of this sensor become radiance.

    Attributes:
        noise: black, gain, read noise, response; dark current at `temperature_c`.
        cfa: colours of the mosaic, "none" without one.
        temperature_c: of the dark current, None where it is not known. doubling_k: kelvin.
        shading: (h, w) of the lens, part of the noise model's sensitivity, or (h, 3 w) as
            `as_plane` lays it; None without flats.
        factors: nominal exposure in seconds to what it is to be multiplied by.
    """

    noise: NoiseModel
    cfa: str = "none"
    temperature_c: float | None = None
    doubling_k: float = 6.5
    shading: Floats | None = None
    factors: Mapping[float, float] = field(default_factory=dict)

    def radiance(
        self, sequence: Frames, indices: Sequence[int], *, lamp: ArrayLike = 1.0
    ) -> Merged:
        """The merged exposures of one pose, flat-fielded: (h, w) of a mosaic, or (h, w, c).

        Args:
            sequence: that holds the frames.
            indices: of the exposures.
            lamp: (k,) brightness of the lamp during each, relative.

        Raises:
            CalibrationError: a frame without exposure time, or of another size than the maps.
        """
        frames = [sequence.frames[i] for i in indices]
        nominal = [float(frame.need("exposure_s")) for frame in frames]
        exposure = [t * self.factor(t) for t in nominal]
        warm = [f.temperature_c for f in frames if f.temperature_c is not None]
        noise = self.at_temperature(float(np.mean(warm)) if warm else None)
        raw = [as_plane(sequence.image(i)) for i in indices]
        for frame, counts in zip(frames, raw, strict=True):
            if np.ndim(noise.black) == 2 and counts.shape != np.shape(noise.black):
                h, w = np.shape(noise.black)
                raise CalibrationError(
                    f"{frame.file} has {counts.shape[1]} x {counts.shape[0]} values; the sensor "
                    f"was calibrated with {w} x {h}",
                    remedy="leave the frame out, or calibrate anew",
                )
        merged = merge_exposures(raw, exposure, noise, lamp=lamp)
        if sequence.image(indices[0]).ndim == 2:
            return merged
        shape = (merged.radiance.shape[0], -1, 3)
        return Merged(
            merged.radiance.reshape(shape),
            merged.variance.reshape(shape),
            merged.validity.reshape(shape),
        )

    def at_temperature(self, temperature_c: float | None) -> NoiseModel:
        """The noise model with the dark current of a temperature."""
        if temperature_c is None or self.temperature_c is None:
            return self.noise
        warm = 2 ** ((temperature_c - self.temperature_c) / self.doubling_k)
        return replace(self.noise, dark=np.asarray(self.noise.dark) * warm)

    def factor(self, exposure_s: float) -> float:
        """What a nominal exposure is to be multiplied by; 1 where no overlap told it."""
        near = [f for t, f in self.factors.items() if abs(t / exposure_s - 1) < 1e-6]
        return near[0] if near else 1.0

    def lens(self, shape: tuple[int, ...]) -> Floats:
        """The shading for a whole frame (h, w) or (h, w, 3); 1 without flats."""
        return np.ones(shape) if self.shading is None else self.shading.reshape(shape)

    def colours(self, shape: tuple[int, int]) -> NDArray[np.intp] | None:
        """(h, w) channel of each pixel of the mosaic; None without one."""
        return None if self.cfa == "none" else sites(self.cfa, shape)

    def to_section(self, inputs: str, details: Mapping[str, Any]) -> Section:
        """The document's section, with what the fits say of themselves in `details`."""
        maps = {
            "black": self.noise.black, "dark": self.noise.dark,
            "sensitivity": self.noise.sensitivity, "shading": self.shading,
        }  # fmt: skip
        data = {
            "noise": self.noise.record(), "cfa": self.cfa, "temperature_c": self.temperature_c,
            "doubling_k": self.doubling_k,
            "exposure_factors": [[t, f] for t, f in self.factors.items()], **details,
        }  # fmt: skip
        kept = {k: np.asarray(v, np.float32) for k, v in maps.items() if np.ndim(v) == 2}  # type: ignore[arg-type]
        return Section(inputs, data, kept)

    @staticmethod
    def from_section(section: Section) -> Radiometry:
        """What `to_section` wrote."""
        data, maps = section.data, section.maps
        noise = data["noise"]
        model = NoiseModel(
            gain=noise["gain_e_per_count"], read=noise["read_counts"], white=noise["white"],
            black=maps.get("black", noise["black"]),
            dark=maps.get("dark", noise["dark_counts_per_s"]),
            sensitivity=maps.get("sensitivity"), curve=tuple(noise["curve"]),
        )  # fmt: skip
        return Radiometry(
            model, data["cfa"], data["temperature_c"], data["doubling_k"], maps.get("shading"),
            {float(t): float(f) for t, f in data["exposure_factors"]},
        )  # fmt: skip


def as_plane(counts: NDArray[Any]) -> NDArray[Any]:
    """(h, w) of a frame; (h, 3 w) of one with three colours, which lie side by side."""
    return counts if counts.ndim == 2 else counts.reshape(counts.shape[0], -1)
