"""Pictures of a material on a shape: rays in, frames and footprints out, the material answers.

Every hit asks the material in its own frame: x along dp/du, y against dp/dv, z the normal. A sheet
seen from behind is the mirror image of its front. Only what is seen is ever asked.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from btfkit.materials.base import Material
from btfkit.render.camera import Camera
from btfkit.render.environment import Environment
from btfkit.render.sampling import Samples
from btfkit.render.shapes import NEAR, Meeting, Plane, Shape, Surface

Floats = NDArray[np.floating]
# Rays traced at once; sheets that a ray may pass; the share of light not worth following.
_BLOCK, _MOST_SHEETS, _NOTHING = 1 << 15, 64, 1e-4
# Interpolated normals may turn from the eye at silhouettes; a material is seen from above.
_LOWEST_Z = 1e-3


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
    """

    material: Material
    shape: Shape
    lights: Floats
    environment: Environment | None = None


class Picture(NamedTuple):
    """What the eye sees.

    Attributes:
        radiance: (h, w, c) linear, premultiplied by cover; a white diffuser under one light that
            it faces, or in a white furnace, is 1.
        cover: (h, w) share of the pixel that is covered, 0 to 1.
        asked: queries that the material answered.
    """

    radiance: NDArray[np.float32]
    cover: NDArray[np.float32]
    asked: int


class _Asked(NamedTuple):
    """Where on the material rays look, in its frame: all of a query but the light."""

    frame: Floats
    uv: Floats
    view: Floats
    footprint: Floats
    curvature: Floats
    out: Floats
    point: Floats


def render(
    scene: Scene,
    *,
    view: Sequence[float] | Floats = (0.0, 0.0, 1.0),
    size: tuple[int, int] = (512, 512),
    samples: int = 1,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Picture:
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
    half = scene.shape.half_height
    if not isinstance(scene.shape, Plane):
        half *= max(1.0, h / w)
    camera = Camera(np.asarray(view, float), size, half)
    c = len(scene.material.header.channels)
    radiance, cover = np.zeros((h * w, c), np.float32), np.zeros(h * w, np.float32)
    drawn, asked = Samples(size, samples, seed=seed), 0
    step = max(_BLOCK // samples, 1)
    for start in range(0, h * w, step):
        pixels = np.arange(start, min(start + step, h * w))
        block = slice(pixels[0], pixels[-1] + 1)
        light, share, queries = _seen(scene, camera, drawn, pixels)
        radiance[block] = light.reshape(len(pixels), samples, c).mean(axis=1)
        cover[block] = share.reshape(len(pixels), samples).mean(axis=1)
        asked += queries
        if progress:
            progress(int(pixels[-1]) + 1, h * w)
    return Picture(radiance.reshape(h, w, c), cover.reshape(h, w), asked)


def _seen(
    scene: Scene, camera: Camera, drawn: Samples, pixels: NDArray[np.intp]
) -> tuple[Floats, Floats, int]:
    """Radiance (m, c), cover (m,) of all rays of some pixels, and how many queries it took."""
    origin = camera.origins(drawn.places(pixels))
    count = len(origin)
    direction = np.broadcast_to(camera.direction, (count, 3))
    radiance = np.zeros((count, len(scene.material.header.channels)))
    through, beyond = np.ones(count), np.full(count, -np.inf)
    alive, asked = np.arange(count), 0
    for _ in range(_MOST_SHEETS):
        met = scene.shape.meet(origin[alive], direction[alive], beyond[alive])
        hit = np.isfinite(met.distance)
        alive = alive[hit]
        if not alive.size:
            break
        met = Meeting(met.distance[hit], met.part[hit])
        surface = scene.shape.surface(origin[alive], direction[alive], met)
        place = _asked(scene, camera, surface, drawn.samples)
        light, opacity, queries = _lit(scene, place, drawn, pixels, alive)
        radiance[alive] += (through[alive] * opacity)[:, None] * light
        through[alive] *= 1 - opacity
        beyond[alive] = met.distance + NEAR
        asked += queries
        alive = alive[through[alive] > _NOTHING]
    return radiance, 1 - through, asked


def _asked(scene: Scene, camera: Camera, surface: Surface, samples: int) -> _Asked:
    """What the material is asked where rays meet the shape."""
    grid = np.array(scene.material.header.grid[::-1], float)
    x = surface.du / np.linalg.norm(surface.du, axis=1, keepdims=True)
    y = np.cross(surface.normal, x)
    toward = -camera.direction
    # A sheet seen from behind is its mirror image: its normal turns, its texture stays.
    side = np.where(surface.normal @ toward < 0, -1.0, 1.0)
    out = surface.normal * side[:, None]
    frame = np.stack([x, y, out], axis=1)
    view = frame @ toward
    view[:, 2] = np.maximum(view[:, 2], _LOWEST_Z)
    steps = [
        _uv_step(surface, moved - np.outer(surface.normal @ moved / _away(surface, toward), toward))
        for moved in (camera.right, camera.down)
    ]
    # The isotropic kernel of the same mean variance as the pixel's own, of 0.5 pixels.
    texels = np.sqrt(sum(np.square(step * grid).sum(axis=1) for step in steps) / 2)
    footprint = 0.5 * texels / np.sqrt(samples)
    curvature = np.zeros(len(view))
    if scene.material.has_curvature:
        curvature = side * scene.shape.tile * _bend_along(surface.bend, view)
    if not scene.material.has_levels:
        footprint = np.minimum(footprint, 0.5)
    uv = surface.uv - np.floor(surface.uv)
    return _Asked(frame, uv, view, footprint, curvature, out, surface.point)


def _away(surface: Surface, toward: Floats) -> Floats:
    """Cosine (m,) of the view with the normal, kept from 0."""
    cosine = surface.normal @ toward
    return np.copysign(np.maximum(np.abs(cosine), _LOWEST_Z), cosine)


def _uv_step(surface: Surface, step: Floats) -> Floats:
    """Steps in uv (m, 2) for steps on the surface (m, 3)."""
    du, dv = surface.du, surface.dv
    uu, uv, vv = (np.einsum("ij,ij->i", a, b) for a, b in ((du, du), (du, dv), (dv, dv)))
    pu, pv = (np.einsum("ij,ij->i", step, d) for d in (du, dv))
    area = np.maximum(uu * vv - uv**2, 1e-30)
    return np.stack([(vv * pu - uv * pv) / area, (uu * pv - uv * pu) / area], axis=1)


def _bend_along(bend: Floats, view: Floats) -> Floats:
    """Curvature (m,) along the projected view; the mean of all directions where it is a point."""
    x, y = view[:, 0], view[:, 1]
    square = x**2 + y**2
    mean = (bend[:, 0] + bend[:, 2]) / 2
    safe = np.where(square > 1e-12, square, 1.0)
    along = (bend[:, 0] * x**2 + 2 * bend[:, 1] * x * y + bend[:, 2] * y**2) / safe
    return np.where(square > 1e-12, along, mean)


def _lit(
    scene: Scene, place: _Asked, drawn: Samples, pixels: NDArray[np.intp], rays: NDArray[np.intp]
) -> tuple[Floats, Floats, int]:
    """Radiance (m, c) towards the eye, opacity (m,), and how many queries it took."""
    total = np.zeros((len(place.uv), len(scene.material.header.channels)))
    opacity = None
    asked = 0
    sources = [(np.broadcast_to(light, (len(rays), 3)), np.ones(1)) for light in scene.lights]
    if scene.environment is not None:
        sources.append(scene.environment.sample(drawn.lights(pixels)[rays], place.out))
    for light, weight in sources:
        local = np.einsum("ijk,ik->ij", place.frame, light)
        rows = np.arange(len(rays))
        if opacity is not None and not scene.material.full_sphere:
            rows = np.flatnonzero(local[:, 2] > 0)
        if not rows.size:
            continue
        rgb, cover = scene.material.evaluate(
            place.uv[rows], local[rows], place.view[rows], place.footprint[rows],
            place.curvature[rows],
        )  # fmt: skip
        asked += len(rows)
        opacity = cover.astype(float) if opacity is None else opacity
        total[rows] += rgb * np.broadcast_to(weight, (len(rays), weight.shape[-1]))[rows]
    if opacity is None:
        opacity = np.ones(len(rays))
    return total, opacity, asked
