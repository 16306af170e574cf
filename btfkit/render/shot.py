"""All that decides a picture but the material: shape, lights, eye, size, samples."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np

from btfkit.directions import from_angles
from btfkit.materials.base import Material
from btfkit.render import picture, studio
from btfkit.render.area import AreaLight
from btfkit.render.environment import Environment
from btfkit.render.preview import Rendering, Scene, enough_samples, render
from btfkit.shapes.catalogue import shape_of
from btfkit.shapes.closed import Floats, Shape

Angles = tuple[float, float]
_SIDE = 512


@final
@dataclass(frozen=True)
class Shot:
    """How a material is looked at.

    Attributes:
        shape: its name or file. repeat: tiles across its front.
        lights: THETA, PHI of distant lights, degrees, object frame.
        panels: THETA, PHI, width, height, distance of area lights.
        env: a picture of the surroundings. env_turn: about y, degrees.
        view: THETA, PHI of the eye, degrees.
        turn: of eye and lights together about y, from z towards x, degrees.
        size: (w, h) pixels; None is 512 on the longer side.
        samples: rays a pixel; None is what the picture needs.
        within_s: seconds after which no further pass begins.
        blur: factor on footprints.
    """

    shape: str = "plane"
    repeat: int = 1
    lights: Sequence[Angles] = ()
    panels: Sequence[tuple[float, float, float, float, float]] = ()
    env: Path | None = None
    env_turn: float = 0.0
    view: Angles = (0.0, 0.0)
    turn: float = 0.0
    size: tuple[int, int] | None = None
    samples: int | None = None
    seed: int = 0
    within_s: float | None = None
    blur: float = 1.0

    @property
    def in_studio(self) -> bool:
        """Whether no light was chosen: key, fill and rim then."""
        return not (self.lights or self.panels or self.env)

    @property
    def background(self) -> Sequence[float]:
        """Linear RGB behind the shape where none is chosen."""
        return studio.GREY if self.in_studio else (0.0, 0.0, 0.0)

    def size_of(self, material: Material) -> tuple[int, int]:
        """Width and height; a plane fills the picture, which has the shape of the material."""
        if self.size is not None:
            return self.size
        aspect = material.header.aspect if self.shape == "plane" else 1.0
        short = max(1, round(_SIDE * min(aspect, 1 / aspect)))
        return (_SIDE, short) if aspect >= 1 else (short, _SIDE)

    def shape_for(self, material: Material) -> Shape:
        """The shape with the tiles of a material."""
        w, h = self.size_of(material)
        return shape_of(
            self.shape, repeat=self.repeat, aspect=material.header.aspect, picture=w / h
        )

    def scene(self, material: Material, shape: Shape | None = None) -> Scene:
        """The scene with a material; `shape` where it was made before."""
        lights = studio.ANGLES if self.in_studio else self.lights
        surroundings = None
        if self.env is not None:
            radiance = picture.read_surroundings(self.env, channels=material.header.channels)
            surroundings = Environment(radiance, turn=math.radians(self.env_turn - self.turn))
        panels = [
            AreaLight(self._turned(towards((a, b))), (w, h), far) for a, b, w, h, far in self.panels
        ]
        return Scene(
            material,
            shape or self.shape_for(material),
            self._turned(from_angles(*np.radians(np.reshape(np.array(lights, float), (-1, 2))).T)),
            surroundings,
            studio.IRRADIANCE if self.in_studio else (1.0,) * len(lights),
            panels,
            self.blur,
        )

    def taken(
        self,
        scene: Scene,
        progress: Callable[[int, int], None] | None = None,
    ) -> Rendering:
        """The picture of a scene that this shot made, or of one like it."""
        w, h = self.size_of(scene.material)
        eye = self._turned(towards(self.view))
        samples = self.samples or enough_samples(scene, eye, (h, w))
        return render(
            scene, view=eye, size=(h, w), samples=samples, seed=self.seed,
            within_s=self.within_s, progress=progress,
        )  # fmt: skip

    def _turned(self, way: Floats) -> Floats:
        """Directions (..., 3) turned about y."""
        cos, sin = math.cos(math.radians(self.turn)), math.sin(math.radians(self.turn))
        x, y, z = np.moveaxis(way, -1, 0)
        return np.stack([x * cos + z * sin, y, z * cos - x * sin], axis=-1)


def towards(angles: Angles) -> Floats:
    """(3,) unit vector of THETA, PHI in degrees."""
    return from_angles(*np.radians(angles))
