"""The tracer: a relief in, answers to queries out, and BTFs whose textures are traced when read.

It defines the quantity by construction: pi x radiance towards the view per unit irradiance on a
surface that faces the light. Light below the horizon of the plane answers 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from btfkit import directions, queries
from btfkit.btf import BTF
from btfkit.native import trace as kernel
from btfkit.native.trace import Geometry, Traced
from btfkit.queries import Query, QuerySet, Response
from btfkit.relief.relief import Relief
from btfkit.textures import Array, Textures

# Rays a query takes by default: of a kernel one texel wide they give the mean to about 1 %.
SAMPLES = 16


def geometry(relief: Relief) -> Geometry:
    """A relief in texels, as the kernel wants it."""
    h, w = relief.size
    ones = np.ones((h, w), np.float32)
    across = relief.roughness if relief.roughness_across is None else relief.roughness_across
    single = (
        relief.roughness,
        across,
        0 * ones if relief.tangent is None else relief.tangent,
        ones if relief.opacity is None else relief.opacity,
    )
    maps = np.concatenate([relief.albedo, relief.specular, *(m[..., None] for m in single)], axis=2)
    return kernel.geometry(relief.height * np.float32(w), maps, wrap=relief.wrap == "wrap")


def trace(
    relief: Relief | Geometry,
    query: Query,
    *,
    samples: int = SAMPLES,
    bounces: int = 0,
    seed: int = 0,
) -> Traced:
    """Answer a flat query, with the place that was seen.

    Args:
        relief: what is traced; a `Geometry` saves packing it again.
        query: flat (b, ...); footprint counts texels of the relief; curvature must be 0.
        samples: rays a query; one ray ignores the footprint.
        bounces: interreflections, estimated with one path a ray, without bias.
        seed: of samples and paths.

    Returns:
        reflectance, opacity, and the mean column, row, height and visibility that rays saw.

    Raises:
        ValueError: a curvature that is not 0.
    """
    if np.any(query.curvature):
        raise ValueError("the plane tracer has no curvature")
    packed = relief if isinstance(relief, Geometry) else geometry(relief)
    h, w = packed.height.shape
    uv = query.uv.astype(np.float64)
    if packed.wrap:
        uv = uv - np.floor(uv)
    place = (uv * [w, h] - 0.5).astype(np.float32)
    return kernel.trace(
        packed, place, query.light, query.view, query.footprint,
        samples=samples, bounces=bounces, seed=seed,
    )  # fmt: skip


def answer(
    relief: Relief,
    uv: ArrayLike,
    light: ArrayLike,
    view: ArrayLike,
    footprint: ArrayLike = 0.5,
    *,
    samples: int = SAMPLES,
    bounces: int = 0,
    seed: int = 0,
) -> Response:
    """What the relief itself answers; shapes broadcast, as in `Material.evaluate`."""
    query, shape = queries.broadcast(uv, light, view, footprint)
    traced = trace(relief, query, samples=samples, bounces=bounces, seed=seed)
    return Response(traced.rgb.reshape(*shape, -1), traced.opacity.reshape(shape))


@final
class TracedTextures(Textures):
    """Textures of a relief, traced when they are asked for; each always the same.

    Args:
        relief: what is traced.
        light, view: (n, 3) unit vectors.
        samples: rays a texel. bounces: interreflections. seed: of both.
    """

    def __init__(
        self,
        relief: Relief,
        light: Array,
        view: Array,
        *,
        samples: int = 4,
        bounces: int = 0,
        seed: int = 0,
    ) -> None:
        h, w = relief.size
        self.shape = (len(light), h, w, len(relief.channels))
        self._geometry = geometry(relief)
        self._light, self._view = light, view
        self._samples, self._bounces, self._seed = samples, bounces, seed
        rows, cols = np.meshgrid(np.arange(h), np.arange(w), indexing="ij")
        self._place = np.stack([cols, rows], axis=-1).reshape(-1, 2).astype(np.float32)
        self._footprint = np.full(h * w, 0.5, np.float32)

    def _read(self, index: int) -> Array:
        light, view = (
            np.broadcast_to(d[index], (len(self._place), 3)) for d in (self._light, self._view)
        )
        traced = kernel.trace(
            self._geometry, self._place, light, view, self._footprint,
            samples=self._samples, bounces=self._bounces, seed=self._seed + 7919 * index,
        )  # fmt: skip
        return traced.rgb.reshape(self.shape[1:])


def traced_btf(
    relief: Relief,
    light: Array,
    view: Array,
    *,
    samples: int = 4,
    bounces: int = 0,
    seed: int = 0,
) -> BTF:
    """A BTF of a relief: one pair for each row of `light` and `view` (n, 3), lazily traced."""
    light, view = (directions.normalize(d).astype(np.float32) for d in (light, view))
    return BTF(
        textures=TracedTextures(relief, light, view, samples=samples, bounces=bounces, seed=seed),
        light=light,
        view=view,
        channels=relief.channels,
        texel_mm=relief.texel_mm,
        wrap=relief.wrap,
        provenance={**relief.provenance, "samples": samples, "bounces": bounces, "seed": seed},
        history=("traced from a relief",),
    )


def random_queries(
    relief: Relief,
    count: int,
    *,
    seed: int = 0,
    footprints: Sequence[float] = (0.5,),
    lowest_z: float = 0.1,
    samples: int = SAMPLES,
    bounces: int = 0,
) -> QuerySet:
    """Queries at random places, lights and views, with their answers.

    Directions are uniform over the projected hemisphere above `lowest_z`; each row takes one of
    `footprints`.
    """
    rng = np.random.default_rng(seed)
    light, view = (_on_disk(rng, count, lowest_z) for _ in range(2))
    footprint = rng.choice(np.asarray(footprints, np.float32), count)
    uv = rng.random((count, 2), np.float32)
    rgb, opacity = answer(
        relief, uv, light, view, footprint, samples=samples, bounces=bounces, seed=seed
    )
    return QuerySet(
        uv=uv,
        light=light,
        view=view,
        footprint=footprint,
        rgb=rgb,
        opacity=None if relief.opacity is None else opacity,
        size=relief.size,
        channels=relief.channels,
        provenance={**relief.provenance, "samples": samples, "bounces": bounces, "seed": seed},
    )


def _on_disk(rng: np.random.Generator, count: int, lowest_z: float) -> NDArray[np.float32]:
    radius = np.sqrt(rng.random(count) * (1 - lowest_z**2))
    angle = 2 * np.pi * rng.random(count)
    flat = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    return np.column_stack([flat, np.sqrt(1 - radius**2)]).astype(np.float32)
