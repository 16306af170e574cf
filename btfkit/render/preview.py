"""Pictures of a material on a shape: rays in, frames and footprints out, the material answers.

Only what is seen is ever asked, and only for lights that reach it.
"""

from __future__ import annotations

import itertools
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from btfkit.materials.base import Material
from btfkit.render.area import AreaLight
from btfkit.render.environment import Environment
from btfkit.render.gaze import Gaze, gaze
from btfkit.render.sampling import STEP, PixelSamples
from btfkit.render.shadows import Shadows
from btfkit.shapes.camera import Camera
from btfkit.shapes.closed import NEAR, Floats, Meeting, Plane, Shape, Surface

Ints = NDArray[np.intp]
# Rays traced at once: many, since a lazy BTF decodes its textures anew for each block. Sheets that
# a ray may pass. The share of light not worth following.
_BLOCK, _MOST_SHEETS, _NOTHING = 1 << 18, 64, 1e-3
# Lights times points whose answers are held at once, and points below which that saves nothing.
_HELD, _FEWEST = 1 << 19, 1 << 11
# Rays a pixel that are followed in one pass.
_ONE_PASS = 4
_ABOVE = np.array([0.0, 0.0, 1.0], np.float32)


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
        panels: area lights near the object.
        blur: factor on footprints: 1 is a pixel's own.
    """

    material: Material
    shape: Shape
    lights: Floats
    environment: Environment | None = None
    irradiance: Sequence[float] | None = None
    panels: Sequence[AreaLight] = ()
    blur: float = 1.0


class Rendering(NamedTuple):
    """What the eye sees.

    Attributes:
        radiance: (h, w, c) linear, premultiplied by cover; a white diffuser under one light that
            it faces, or in an environment of radiance 1, is 1.
        cover: (h, w) share of the pixel that is covered, 0 to 1.
        asked: queries that the material answered.
        samples: rays a pixel that were followed.
        interrupted: whether an interruption ended it before all of them were.
    """

    radiance: NDArray[np.float32]
    cover: NDArray[np.float32]
    asked: int
    samples: int = 1
    interrupted: bool = False


def camera_of(shape: Shape, view: Sequence[float] | Floats, size: tuple[int, int]) -> Camera:
    """The eye that sees the whole shape in a picture of `size` (h, w)."""
    h, w = size
    fit = 1.0 if isinstance(shape, Plane) else max(1.0, h / w)
    return Camera(np.asarray(view, float), size, shape.half_height * fit)


def enough_samples(scene: Scene, view: Sequence[float] | Floats, size: tuple[int, int]) -> int:
    """Rays a pixel that a picture needs.

    One where a plane is seen straight from above and its texels are no finer than pixels; 64 under
    an environment or a panel; else 4, and as many as there are texels in a pixel, 64 at most, where
    the material has no levels of detail.
    """
    camera, header = camera_of(scene.shape, view, size), scene.material.header
    texels = float(np.linalg.norm(camera.right)) / scene.shape.tile * max(header.grid)
    straight = isinstance(scene.shape, Plane) and abs(camera.direction[2]) > 1 - 1e-9
    if scene.environment is not None or scene.panels:
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
    within_s: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Rendering:
    """Render a picture, in passes that each double the rays of a pixel.

    Args:
        scene: what is seen.
        view: (3,) direction from the object to the eye, object frame.
        size: (h, w) pixels.
        samples: rays a pixel; one goes through its centre.
        seed: of the shifts of samples between pixels.
        within_s: seconds after which no further pass begins that is expected to end later; the
            first is always finished.
        progress: called with (rays done, rays).

    An interruption after the first pass ends the picture; before, it is passed on.
    """
    h, w = size
    c = len(scene.material.header.channels)
    painter = _Painter(
        scene, camera_of(scene.shape, view, size), PixelSamples(size, samples, seed=seed)
    )
    radiance, cover = np.zeros((h * w, c)), np.zeros(h * w)
    start, done, interrupted = time.perf_counter(), 0, False
    # A lazy BTF decodes its textures anew in every pass.
    arrays = scene.material.weights.values()
    lazy = not all(isinstance(array, np.ndarray) for array in arrays)
    for some in _passes(samples, whole=within_s is None and (lazy or samples <= _ONE_PASS)):
        spent = time.perf_counter() - start
        if done and within_s is not None and spent * (1 + len(some) / done) > within_s:
            break
        try:
            light, share = painter.paint_pass(some, progress)
        except KeyboardInterrupt:
            if not done:
                raise
            interrupted = True
            break
        radiance += light
        cover += share
        done += len(some)
    if painter.not_finite:
        warnings.warn(
            f"{painter.not_finite} of {painter.asked} answers of the material are not finite; "
            "they count as black",
            stacklevel=2,
        )
    mean = (radiance / done).astype(np.float32), (cover / done).astype(np.float32)
    return Rendering(
        mean[0].reshape(h, w, c), mean[1].reshape(h, w), painter.asked, done, interrupted
    )


def _passes(samples: int, *, whole: bool) -> list[range]:
    """Which samples each pass takes: one at first, then as many as before; or all at once."""
    bounds = [0, samples if whole else 1]
    while bounds[-1] < samples:
        bounds.append(min(2 * bounds[-1], samples))
    return [range(a, b) for a, b in itertools.pairwise(bounds)]


@final
class _Painter:
    """Follows the rays of some pixels at a time, and counts what the material is asked."""

    def __init__(self, scene: Scene, camera: Camera, drawn: PixelSamples) -> None:
        self._scene, self._camera, self._drawn = scene, camera, drawn
        # Samples share the pixel: each answers for its part.
        steps = np.stack([camera.right, camera.down]) / np.sqrt(drawn.samples)
        self._pixel = steps * scene.blur
        self._shadows = Shadows(scene.material, scene.shape, self._pixel)
        self._own = self.not_finite = 0

    @property
    def asked(self) -> int:
        """Queries that the material answered so far."""
        return self._own + self._shadows.asked

    def paint_pass(
        self, some: range, progress: Callable[[int, int], None] | None
    ) -> tuple[Floats, Floats]:
        """Sums over some samples of every pixel: radiance (p, c), premultiplied, and cover (p,)."""
        pixels = self._drawn.size[0] * self._drawn.size[1]
        c = len(self._scene.material.header.channels)
        radiance, cover = np.zeros((pixels, c)), np.zeros(pixels)
        step = max(_BLOCK // len(some), 1)
        for start in range(0, pixels, step):
            at = np.arange(start, min(start + step, pixels))
            light, share = self._paint(at, some)
            radiance[at] = light.reshape(len(at), len(some), c).sum(axis=1)
            cover[at] = share.reshape(len(at), len(some)).sum(axis=1)
            if progress:
                done = some.start * pixels + (start + len(at)) * len(some)
                progress(done, pixels * self._drawn.samples)
        return radiance, cover

    def _paint(self, pixels: Ints, some: range) -> tuple[Floats, Floats]:
        """Radiance (m, c), premultiplied, and cover (m,) of some rays of some pixels."""
        scene, toward = self._scene, -self._camera.direction
        origin = self._camera.origins(self._drawn.places(pixels, some))
        direction = np.broadcast_to(self._camera.direction, origin.shape)
        numbers = self._drawn.lights(pixels, some)
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
        drawn = self._drawn_lights(surface, seen, numbers)
        sources = np.arange(len(scene.lights) + len(drawn))
        # Where the views of several lights are shared, few points and all lights; else one light.
        shared = scene.material.shares_views and len(sources) > 1
        points = max(_HELD // len(sources), _FEWEST) if shared else count
        together = len(sources) if shared else 1
        for first in range(0, count, points):
            at = slice(first, first + points)
            part = (
                Surface._make(row[at] for row in surface),
                Gaze._make(row[at] for row in seen),
            )
            own = [(way[at], weight[at]) for way, weight in drawn]
            for start in range(0, len(sources), together):
                light, cover = self._under(*part, sources[start : start + together], own)
                total[at] += light
                if start == 0 and self._shadows.holes:
                    opacity[at] = cover
        return total, opacity

    def _drawn_lights(
        self, surface: Surface, seen: Gaze, numbers: Floats
    ) -> list[tuple[Floats, Floats]]:
        """Directions (m, 3) and weights (m, 1 or c) of lights that differ from point to point."""
        drawn: list[tuple[Floats, Floats]] = []
        for k, panel in enumerate(self._scene.panels, 1):
            own: Floats = (numbers + float(k) * STEP) % 1
            drawn.append(panel.sample(own, surface.point))
        if self._scene.environment is not None:
            drawn.append(self._scene.environment.sample(numbers, seen.frame[:, 2]))
        return drawn

    def _under(
        self, surface: Surface, seen: Gaze, which: Ints, drawn: list[tuple[Floats, Floats]]
    ) -> tuple[Floats, Floats]:
        """Radiance (m, c) that some lights make, and opacity (m,) where it was asked for."""
        scene, count = self._scene, len(seen.uv)
        distant = len(scene.lights)
        frame = seen.frame.astype(np.float32)
        local = np.empty((len(which), count, 3), np.float32)
        reached = np.empty((len(which), count), np.float32)
        for row, k in enumerate(which):
            if k < distant:
                way = np.broadcast_to(scene.lights[k], (count, 3))
                np.matmul(frame.reshape(-1, 3), scene.lights[k].astype(np.float32),
                          out=local[row].reshape(-1))  # fmt: skip
            else:
                way = drawn[k - distant][0]
                local[row] = np.einsum("ijk,ik->ij", frame, way)
            lit = scene.material.full_sphere | (local[row, :, 2] > 0)
            reached[row] = lit
            if not self._shadows.none_on(seen):
                rows = np.flatnonzero(lit)
                reached[row, rows] = self._shadows.reached(surface, seen, way, local[row], rows)
        asked = reached > 0
        # A vector of zeros is not asked.
        local *= asked[..., None]
        if self._shadows.holes and which[0] == 0:
            # Holes are asked for once, lit or not, by a light that every material answers.
            dark = np.flatnonzero(~asked.any(axis=0))
            local[0, dark] = _ABOVE
            self._own += len(dark)
        self._own += int(np.count_nonzero(asked))
        rgb, cover = self._answer(seen, local)
        total = np.zeros((count, rgb.shape[2]))
        strength = scene.irradiance or [1.0] * distant
        for row, k in enumerate(which):
            weight = strength[k] if k < distant else drawn[k - distant][1]
            total += rgb[row] * (reached[row, :, None] * weight)
        return total, cover

    def _answer(self, seen: Gaze, local: NDArray[np.float32]) -> tuple[Floats, Floats]:
        """What the material answers; what is not finite counts as black and opaque."""
        rgb, cover = self._scene.material.under_lights(
            seen.uv, local, seen.view, seen.footprint, seen.curvature
        )
        if np.isfinite(cover).all() and np.isfinite(rgb).all():
            return rgb, cover.astype(float)
        bad = ~np.isfinite(cover) | ~np.isfinite(rgb).all(axis=2)
        self.not_finite += int(bad.sum())
        return np.where(bad[..., None], 0, rgb), np.where(np.isfinite(cover), cover, 1.0)
