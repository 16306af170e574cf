"""Pictures of a material on a shape: rays in, frames and footprints out, the material answers.

Only what is seen is ever asked, and only for lights that reach it.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from btfkit.materials.base import Material
from btfkit.render.environment import Environment
from btfkit.render.gaze import Gaze, gaze
from btfkit.render.sampling import PixelSamples
from btfkit.render.shadows import Shadows
from btfkit.shapes.camera import Camera
from btfkit.shapes.closed import NEAR, Floats, Meeting, Plane, Shape, Surface

Ints = NDArray[np.intp]
# Rays traced at once: many, since a lazy BTF decodes its textures anew for each block. Sheets that
# a ray may pass. The share of light not worth following.
_BLOCK, _MOST_SHEETS, _NOTHING = 1 << 18, 64, 1e-3
_ABOVE = np.array([0.0, 0.0, 1.0])


@final
@dataclass(frozen=True, eq=False)
class Scene:
    """A material on a shape under lights.

    Attributes:
        material: what the shape is covered with.
        shape: in the object's frame.
        lights: (n, 3) directions of distant lights; each alone makes a white surface
            that faces it 1.
        environment: light from everywhere, or None.
        irradiance: (n,) of each light on a surface that faces it; None is 1 of each.
    """

    material: Material
    shape: Shape
    lights: Floats
    environment: Environment | None = None
    irradiance: Sequence[float] | None = None


class Rendering(NamedTuple):
    """What the eye sees.

    Attributes:
        radiance: (h, w, c) linear, premultiplied by cover; a white diffuser under one light that
            it faces, or in an environment of radiance 1, is 1.
        cover: (h, w) share of the pixel that is covered, 0 to 1.
        asked: queries that the material answered.
    """

    radiance: NDArray[np.float32]
    cover: NDArray[np.float32]
    asked: int


def camera_of(shape: Shape, view: Sequence[float] | Floats, size: tuple[int, int]) -> Camera:
    """The eye that sees the whole shape in a picture of `size` (h, w)."""
    h, w = size
    fit = 1.0 if isinstance(shape, Plane) else max(1.0, h / w)
    return Camera(np.asarray(view, float), size, shape.half_height * fit)


def enough_samples(scene: Scene, view: Sequence[float] | Floats, size: tuple[int, int]) -> int:
    """Rays a pixel that a picture needs.

    One where a plane is seen straight from above and its texels are no finer than pixels; 64 under
    an environment; else 4, and as many as there are texels in a pixel, 64 at most, where the
    material has no levels of detail.
    """
    camera, header = camera_of(scene.shape, view, size), scene.material.header
    texels = float(np.linalg.norm(camera.right)) / scene.shape.tile * max(header.grid)
    straight = isinstance(scene.shape, Plane) and abs(camera.direction[2]) > 1 - 1e-9
    if scene.environment is not None:
        return 64
    fine = texels > 1 + 1e-6 and not scene.material.has_levels
    if fine:
        return min(max(int(np.ceil(texels)) ** 2, 4), 64)
    return 1 if straight else 4


def render(
    scene: Scene,
    *,
    view: Sequence[float] | Floats = (0.0, 0.0, 1.0),
    size: tuple[int, int] = (512, 512),
    samples: int = 1,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Rendering:
    """Render a picture.

    Args:
        scene: what is seen.
        view: (3,) direction from the object to the eye, object frame.
        size: (h, w) pixels.
        samples: rays a pixel; one goes through its centre.
        seed: of the shifts of samples between pixels.
        progress: called with (pixels done, pixels).
    """
    h, w = size
    c = len(scene.material.header.channels)
    painter = _Painter(
        scene, camera_of(scene.shape, view, size), PixelSamples(size, samples, seed=seed)
    )
    radiance, cover = np.zeros((h * w, c), np.float32), np.zeros(h * w, np.float32)
    step = max(_BLOCK // samples, 1)
    for start in range(0, h * w, step):
        pixels = np.arange(start, min(start + step, h * w))
        light, share = painter.paint(pixels)
        block = slice(start, start + len(pixels))
        radiance[block] = light.reshape(len(pixels), samples, c).mean(axis=1)
        cover[block] = share.reshape(len(pixels), samples).mean(axis=1)
        if progress:
            progress(start + len(pixels), h * w)
    if painter.not_finite:
        warnings.warn(
            f"{painter.not_finite} of {painter.asked} answers of the material are not finite; "
            "they count as black",
            stacklevel=2,
        )
    return Rendering(radiance.reshape(h, w, c), cover.reshape(h, w), painter.asked)


@final
class _Painter:
    """Follows the rays of some pixels at a time, and counts what the material is asked."""

    def __init__(self, scene: Scene, camera: Camera, drawn: PixelSamples) -> None:
        self._scene, self._camera, self._drawn = scene, camera, drawn
        # Samples share the pixel: each answers for its part.
        self._pixel = np.stack([camera.right, camera.down]) / np.sqrt(drawn.samples)
        self._shadows = Shadows(scene.material, scene.shape, self._pixel)
        self._own = self.not_finite = 0

    @property
    def asked(self) -> int:
        """Queries that the material answered so far."""
        return self._own + self._shadows.asked

    def paint(self, pixels: Ints) -> tuple[Floats, Floats]:
        """Radiance (m, c), premultiplied, and cover (m,) of all rays of some pixels."""
        scene, toward = self._scene, -self._camera.direction
        origin = self._camera.origins(self._drawn.places(pixels))
        direction = np.broadcast_to(self._camera.direction, origin.shape)
        numbers = self._drawn.lights(pixels)
        radiance = np.zeros((len(origin), len(scene.material.header.channels)))
        through, beyond = np.ones(len(origin)), np.full(len(origin), -np.inf)
        alive = np.arange(len(origin))
        for _ in range(_MOST_SHEETS):
            met = scene.shape.meet(origin[alive], direction[alive], beyond[alive])
            hit = np.isfinite(met.distance)
            alive, met = alive[hit], Meeting(met.distance[hit], met.part[hit])
            if not alive.size:
                break
            surface = scene.shape.surface(origin[alive], direction[alive], met)
            seen = gaze(
                scene.material, scene.shape, surface,
                np.broadcast_to(toward, (len(alive), 3)), self._pixel,
            )  # fmt: skip
            light, opacity = self._lit(surface, seen, numbers[alive])
            if self._shadows.body:
                opacity = np.where(seen.outside, opacity, 0.0)
            radiance[alive] += (through[alive] * opacity)[:, None] * light
            through[alive] *= 1 - opacity
            beyond[alive] = met.distance + NEAR
            alive = alive[through[alive] > _NOTHING]
        return radiance, 1 - through

    def _lit(self, surface: Surface, seen: Gaze, numbers: Floats) -> tuple[Floats, Floats]:
        """Radiance (m, c) towards the eye and opacity (m,); numbers (m, 2) choose from the sky."""
        scene, count = self._scene, len(seen.uv)
        total = np.zeros((count, len(scene.material.header.channels)))
        opacity: Floats = np.ones(count)
        strength = scene.irradiance or [1.0] * len(scene.lights)
        sources: list[tuple[Floats, Floats]] = [
            (np.broadcast_to(light, (count, 3)), np.full((1, 1), irradiance))
            for light, irradiance in zip(scene.lights, strength, strict=True)
        ]
        if scene.environment is not None:
            sources.append(scene.environment.sample(numbers, seen.frame[:, 2]))
        for index, (light, weight) in enumerate(sources):
            local = np.einsum("ijk,ik->ij", seen.frame, light)
            lit = scene.material.full_sphere | (local[:, 2] > 0)
            # Holes are asked for once, lit or not, by a light that every material answers.
            ask_holes = index == 0 and self._shadows.holes
            rows = np.arange(count) if ask_holes else np.flatnonzero(lit)
            if not rows.size:
                continue
            rgb, cover = self._answer(
                seen.uv[rows], np.where(lit[rows, None], local[rows], _ABOVE), seen.view[rows],
                seen.footprint[rows], seen.curvature[rows],
            )  # fmt: skip
            if ask_holes:
                opacity = cover
            reached = lit[rows] * self._shadows.reached(surface, seen, light, local, rows)
            share = np.broadcast_to(weight, (count, weight.shape[1]))[rows]
            total[rows] += rgb * share * reached[:, None]
        return total, opacity

    def _answer(self, *query: Floats) -> tuple[Floats, Floats]:
        """What the material answers; what is not finite counts as black and opaque."""
        rgb, cover = self._scene.material.evaluate(*query)
        self._own += len(rgb)
        bad = ~np.isfinite(cover) | ~np.isfinite(rgb).all(axis=1)
        if bad.any():
            self.not_finite += int(bad.sum())
            rgb, cover = np.where(bad[:, None], 0, rgb), np.where(bad, 1, cover)
        return rgb, cover.astype(float)
