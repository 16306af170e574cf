"""Pictures of a material on a shape: rays in, frames and footprints out, the material answers.

Only what is seen is ever asked, and only for lights that reach it.
"""

from __future__ import annotations

import itertools
import time
import warnings
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from btfkit.render.painter import Painter
from btfkit.render.sampling import PixelSamples
from btfkit.render.scene import Scene
from btfkit.shapes.camera import Camera
from btfkit.shapes.closed import Floats, Plane, Shape

__all__ = ["Rendering", "Scene", "camera_of", "enough_samples", "render"]
# Rays a pixel that are followed in one pass.
_ONE_PASS = 4


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
    painter = Painter(
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
