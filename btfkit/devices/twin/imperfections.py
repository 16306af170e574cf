"""What is wrong with the twin, by name; each can be switched off alone."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import final

IMPERFECTIONS: dict[str, str] = {
    "backlash": "play of the axes, 0.05 degrees",
    "eccentricity": "encoders that are off centre, 0.003 degrees, and rounded",
    "homing": "switches that repeat to 0.002 degrees",
    "axes": "axes that are tilted by up to 0.1 degrees and displaced by up to 0.3 mm",
    "camera-pose": "a camera up to 1 mm and 0.2 degrees off, its focal length up to 0.5 %",
    "lamp-pose": "a lamp displaced by up to 2 mm",
    "holder": "board, patches and spheres displaced by up to 0.02, 0.15 and 0.2 mm",
    "warm-up": "a lamp that starts 8 % too bright",
    "lamp-drift": "power that wanders by 0.5 % in hours and 0.1 % in minutes",
    "monitor": "a lamp monitor with 0.02 % of noise",
    "lamp-size": "a lamp of 3 mm radius",
    "shot-noise": "photons that are counted",
    "read-noise": "3 electrons rms",
    "prnu": "pixels whose sensitivity differs by 1 % rms",
    "dark-current": "2 electrons a second at 25 degrees C, doubling every 7, and hot pixels",
    "quantisation": "12 bits; without it 16",
    "mosaic": "one colour a pixel (RGGB); without it three",
    "colour": "filters that mix colours",
    "distortion": "3 pixels at the corners of a 640 x 480 sensor",
    "vignetting": "corners 20 % darker than the centre",
    "defocus": "a blur of 0.5 pixels, and more out of the plane of focus",
    "stray-light": "1 % of the light spread over the whole frame",
}  # fmt: skip


@final
@dataclass(frozen=True)
class Imperfections:
    """The ones that are on."""

    on: frozenset[str] = frozenset(IMPERFECTIONS)

    @staticmethod
    def without(names: Iterable[str]) -> Imperfections:
        """All but these.

        Raises:
            ValueError: no such imperfection.
        """
        off = frozenset(names)
        for name in sorted(off - IMPERFECTIONS.keys()):
            raise ValueError(f"imperfection {name!r}; expected one of {', '.join(IMPERFECTIONS)}")
        return Imperfections(frozenset(IMPERFECTIONS) - off)

    @staticmethod
    def none() -> Imperfections:
        """A perfect rig."""
        return Imperfections(frozenset())

    def __contains__(self, name: str) -> bool:
        if name not in IMPERFECTIONS:
            raise KeyError(name)
        return name in self.on

    def of(self, name: str, value: float) -> float:
        """`value` where the imperfection is on, else 0."""
        return value if name in self else 0.0
