"""Rays of a picture: what they meet, which lights reach it, what the material answers."""

from __future__ import annotations

from collections.abc import Callable
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit.render.gaze import Gaze, gaze
from btfkit.render.sampling import STEP, PixelSamples
from btfkit.render.scene import Scene
from btfkit.render.shadows import Shadows
from btfkit.shapes.camera import Camera
from btfkit.shapes.closed import NEAR, Floats, Meeting, Surface

Ints = NDArray[np.intp]
# Rays traced at once: many, since a lazy BTF decodes its textures anew for each block. Sheets that
# a ray may pass. The share of light not worth following.
_BLOCK, _MOST_SHEETS, _NOTHING = 1 << 18, 64, 1e-3
# Lights times points whose answers are held at once, and points below which that saves nothing.
_HELD, _FEWEST = 1 << 19, 1 << 11
_ABOVE = np.array([0.0, 0.0, 1.0], np.float32)


@final
class Painter:
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
            seen.uv, local, seen.view, seen.footprint, seen.curvature, seen.told_drift
        )
        if np.isfinite(cover).all() and np.isfinite(rgb).all():
            return rgb, cover.astype(float)
        bad = ~np.isfinite(cover) | ~np.isfinite(rgb).all(axis=2)
        self.not_finite += int(bad.sum())
        return np.where(bad[..., None], 0, rgb), np.where(np.isfinite(cover), cover, 1.0)
