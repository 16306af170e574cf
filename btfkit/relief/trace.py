"""The tracer: a relief in, answers to queries out, and BTFs whose textures are traced when read.

It defines the quantity by construction: pi x radiance towards the view per unit irradiance on a
surface that faces the light. The plane hides every light below its horizon; on a cylinder such
light may still reach what the ray saw further round.
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
        query: flat (b, ...); footprint counts texels of the relief. Curvature bends the surface
            z = 0 into a cylinder along the projected view ray (along x for a view straight down),
            light and view are in the frame where the ray passes z = 0.
        samples: rays a query, one to a stratum of the footprint; one ray ignores it.
        bounces: interreflections, estimated with one path a ray, without bias.
        seed: of samples and paths.

    Returns:
        reflectance, opacity, and the mean column, row, height and visibility that rays saw. Rows
        that are not finite, or seen from below the horizon, answer 0 with opacity 0.

    Raises:
        ValueError: a curvature at which the relief reaches the axis of its cylinder, or whose
            radius is under a texel.
    """
    packed = relief if isinstance(relief, Geometry) else geometry(relief)
    h, w = packed.height.shape
    curvature = (query.curvature / np.float32(w)).astype(np.float32)
    valid = (query.view[:, 2] >= 0) & (query.footprint >= 0)
    for part in query:
        valid &= np.isfinite(part.reshape(len(part), -1)).all(axis=1)
    valid &= np.abs(query.uv).max(axis=1, initial=0) < _FARTHEST
    _check_curvature(packed, curvature[valid])
    uv = np.where(valid[:, None], query.uv.astype(np.float64), 0.5)
    uv = uv - np.floor(uv) if packed.wrap else np.clip(uv, 0, 1)
    place = (uv * [w, h] - 0.5).astype(np.float32)
    up = np.array([0, 0, 1], np.float32)
    traced = kernel.trace(
        packed, place,
        np.where(valid[:, None], query.light, up), np.where(valid[:, None], query.view, up),
        np.where(valid, query.footprint, 0), np.where(valid, curvature, 0),
        samples=samples, bounces=bounces, seed=seed,
    )  # fmt: skip
    if not valid.all():
        traced.rgb[~valid], traced.opacity[~valid] = 0, 0
    return traced


# uv beyond this has lost its texel in float64.
_FARTHEST = 1e12
# Share of its radius that a cylinder keeps at the lowest (or, concave, highest) relief.
_LEAST_RADIUS = 0.1
# 1/texel.
_SHARPEST = 1.0


def _check_curvature(relief: Geometry, curvature: Array) -> None:
    if not np.any(curvature):
        return
    sharpest = [curvature.min(), curvature.max()]
    if max(map(abs, sharpest)) > _SHARPEST:
        w = relief.height.shape[1]
        raise ValueError(
            f"curvature {max(sharpest, key=abs) * w:g} / tile: the cylinder is thinner than a "
            f"texel; at most {_SHARPEST * w:g} here"
        )
    thin = [1 + k * z for k in sharpest for z in (relief.lowest, relief.highest)]
    if min(thin) < _LEAST_RADIUS:
        worst = sharpest[int(np.argmin(thin)) // 2] * relief.height.shape[1]
        depth = float(np.abs([relief.lowest, relief.highest]).max()) / relief.height.shape[1]
        raise ValueError(
            f"curvature {worst:g} / tile bends a relief that reaches {depth:g} tile widths from "
            f"z = 0 to its axis; at most {(1 - _LEAST_RADIUS) / max(depth, 1e-30):g} here"
        )


def answer(
    relief: Relief,
    uv: ArrayLike,
    light: ArrayLike,
    view: ArrayLike,
    footprint: ArrayLike = 0.5,
    curvature: ArrayLike = 0.0,
    *,
    samples: int = SAMPLES,
    bounces: int = 0,
    seed: int = 0,
) -> Response:
    """What the relief itself answers; shapes broadcast, as in `Material.evaluate`."""
    query, shape = queries.broadcast(uv, light, view, footprint, curvature)
    traced = trace(relief, query, samples=samples, bounces=bounces, seed=seed)
    return Response(traced.rgb.reshape(*shape, -1), traced.opacity.reshape(shape))


def silhouette(
    relief: Relief | Geometry, uv: ArrayLike, azimuth: ArrayLike, curvature: ArrayLike
) -> NDArray[np.float32]:
    """The cosine of the view at which a curved relief begins to let rays past.

    Of all rays through one place on the bounding surface, a steeper one lies lower: under it
    (no height above 0, see `Relief.under_surface`) the opacity of a height field is a step.

    Args:
        relief: heights of 0 and below.
        uv: (..., 2). azimuth: (...) of the views, radians. curvature: (...) 1/tile width.

    Returns:
        (...) view z below which the ray passes; 0 where every ray meets the relief. To 1e-5,
        but not below the lowest traced direction, 0.01.

    Raises:
        ValueError: a relief that stands above the surface; curvature as in `trace`.

    Source: Kuznetsov et al., "Rendering Neural Materials on Curved Surfaces", 2022, section 4.4.
    """
    packed = relief if isinstance(relief, Geometry) else geometry(relief)
    if packed.highest > 0:
        raise ValueError(
            f"the relief stands {packed.highest:g} texels above the surface; "
            "take relief.under_surface()"
        )
    phi = np.asarray(azimuth, np.float64)
    query, shape = queries.broadcast(uv, [0, 0, 1], directions.from_angles(0.0 * phi, phi),
                                     0.0, curvature)  # fmt: skip
    phi = np.broadcast_to(phi, shape).reshape(-1)
    low, high = np.zeros(len(phi)), np.ones(len(phi))
    for _ in range(17):
        middle = (low + high) / 2
        view = directions.from_angles(np.arccos(middle), phi).astype(np.float32)
        met = trace(packed, query._replace(view=view), samples=1).met > 0
        low, high = np.where(met, low, middle), np.where(met, middle, high)
    return np.where(low == 0, 0, high).reshape(shape).astype(np.float32)


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
    curvatures: tuple[float, float] | None = None,
    lowest_z: float = 0.1,
    samples: int = SAMPLES,
    bounces: int = 0,
) -> QuerySet:
    """Queries at random places, lights and views, with their answers.

    Without `curvatures`: the plane, directions uniform over the projected hemisphere above
    `lowest_z`. With them: the relief under its surface (highest point at 0), half the rows
    convex, a quarter concave, a quarter on the plane, |curvature| log-uniform between the two
    (1/tile width); views uniform over the hemisphere above `lowest_z`, so that silhouettes are
    met, and lights over the whole sphere. Each row takes one of `footprints`.

    Raises:
        ValueError: curvatures that are not 0 < low <= high, or as in `trace`.
    """
    rng = np.random.default_rng(seed)
    curvature: NDArray[np.float32] | None = None
    provenance = {**relief.provenance, "samples": samples, "bounces": bounces, "seed": seed}
    if curvatures is None:
        light, view = (_on_disk(rng, count, lowest_z) for _ in range(2))
    else:
        relief, shift = relief.under_surface()
        light, view = _on_sphere(rng, count, -1), _on_sphere(rng, count, lowest_z)
        curvature = _curvatures(rng, count, *curvatures)
        provenance |= {"shift": shift, "curvatures": list(curvatures)}
    footprint = rng.choice(np.asarray(footprints, np.float32), count)
    uv = rng.random((count, 2), np.float32)
    rgb, opacity = answer(
        relief, uv, light, view, footprint, 0.0 if curvature is None else curvature,
        samples=samples, bounces=bounces, seed=seed,
    )  # fmt: skip
    return QuerySet(
        uv=uv,
        light=light,
        view=view,
        footprint=footprint,
        curvature=curvature,
        rgb=rgb,
        opacity=None if relief.opacity is None and curvature is None else opacity,
        size=relief.size,
        channels=relief.channels,
        provenance=provenance,
    )


def _curvatures(
    rng: np.random.Generator, count: int, low: float, high: float
) -> NDArray[np.float32]:
    if not 0 < low <= high:
        raise ValueError(f"curvatures {low:g}, {high:g}; expected 0 < low <= high")
    sign = rng.choice([1, 1, -1, 0], count)
    return (sign * np.exp(rng.uniform(np.log(low), np.log(high), count))).astype(np.float32)


def _on_sphere(rng: np.random.Generator, count: int, lowest_z: float) -> NDArray[np.float32]:
    z, phi = rng.uniform(lowest_z, 1, count), rng.uniform(0, 2 * np.pi, count)
    return directions.from_angles(np.arccos(z), phi).astype(np.float32)


def _on_disk(rng: np.random.Generator, count: int, lowest_z: float) -> NDArray[np.float32]:
    radius = np.sqrt(rng.random(count) * (1 - lowest_z**2))
    angle = 2 * np.pi * rng.random(count)
    flat = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    return np.column_stack([flat, np.sqrt(1 - radius**2)]).astype(np.float32)
