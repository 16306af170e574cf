"""The sensor of the twin: light to electrons to counts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.devices.twin.imperfections import Imperfections

Image = NDArray[np.float32]
# A full well, and how fast a white surface under the lamp fills it.
FULL_E = 9600.0
WHITE_E_PER_S = 0.8 * FULL_E / 0.02
_READ_E = 3.0
_PRNU = 0.01
_DARK_E_PER_S, _DARK_AT_C, _DOUBLING_K = 2.0, 25.0, 7.0
_HOT_SHARE, _HOT_E_PER_S = 2e-4, 400.0
# Rows: what the red, green and blue filter pass of linear sRGB light.
_FILTERS = ((0.62, 0.22, 0.03), (0.16, 0.82, 0.12), (0.02, 0.16, 0.66))


@final
class Sensor:
    """A mosaic of pixels, each with faults of its own.

    Args:
        section: "sensor" of the description. imperfections: what is on.
        rng: draws what differs from pixel to pixel.

    Attributes:
        gain: electrons a count.
    """

    def __init__(
        self, section: Mapping[str, Any], imperfections: Imperfections, rng: np.random.Generator
    ) -> None:
        self.size = (int(section["height"]), int(section["width"]))
        self._black, self._white = float(section["black"]), float(section["white"])
        self.gain = FULL_E / (self._white - self._black)
        self._imperfections = imperfections
        self._mosaic = section["cfa"] == "RGGB"
        response = 1 + imperfections.of("prnu", _PRNU) * rng.standard_normal(self.size)
        self._response = np.asarray(response, np.float32)
        hot = rng.random(self.size) < _HOT_SHARE
        level = _DARK_E_PER_S + np.where(hot, _HOT_E_PER_S * rng.random(self.size), 0)
        self._dark = np.asarray(imperfections.of("dark-current", 1.0) * level, np.float32)

    def filtered(self, image: Image) -> Image:
        """Linear sRGB (h, w, 3) as each pixel's filter passes it: (h, w), or (h, w, 3)."""
        if "colour" in self._imperfections:
            image = image @ np.array(_FILTERS, np.float32).T
        if not self._mosaic:
            return image
        out = np.empty(self.size, np.float32)
        for channel, row, col in ((0, 0, 0), (1, 0, 1), (1, 1, 0), (2, 1, 1)):
            out[row::2, col::2] = image[row::2, col::2, channel]
        return out

    def exposed(
        self,
        light: Image,
        exposure_s: float,
        *,
        iso: float,
        temperature_c: float,
        rng: np.random.Generator,
    ) -> NDArray[np.uint16]:
        """Counts of one exposure.

        Args:
            light: (h, w) or (h, w, 3) what `filtered` gives, 1 for a white surface at the lamp's
                nominal power; 0 when dark.
            exposure_s: shutter time. iso: 100 is the gain of the description.
            temperature_c: of the sensor.
            rng: of photons and read-out.
        """
        warm = 2 ** ((temperature_c - _DARK_AT_C) / _DOUBLING_K)
        response = self._response if light.ndim == 2 else self._response[..., None]
        dark = self._dark if light.ndim == 2 else self._dark[..., None]
        electrons = light * response * np.float32(WHITE_E_PER_S) + dark * np.float32(warm)
        electrons = electrons * np.float32(exposure_s)
        if "shot-noise" in self._imperfections:
            electrons = _counted(electrons, rng)
        if "read-noise" in self._imperfections:
            electrons = electrons + np.float32(_READ_E) * rng.standard_normal(
                electrons.shape, np.float32
            )
        counts = electrons * np.float32(iso / 100 / self.gain) + np.float32(self._black)
        return np.clip(np.rint(counts), 0, self._white).astype(np.uint16)


def _counted(electrons: Image, rng: np.random.Generator) -> Image:
    """Poisson numbers; beyond 1e6, where every pixel saturates, the mean will do."""
    few = np.minimum(electrons, 1e6)
    return rng.poisson(few).astype(np.float32)
