"""Queries: where, from where, towards where, how blurred, on what curvature."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float32]
# Of every number of a drift: a ray that is that far off its circle has left what it stands for.
MOST_DRIFT = 8.0


class Query(NamedTuple):
    """What a material is asked; leading shapes broadcast against each other.

    Attributes:
        uv: (..., 2) u in tile widths along +x, v in tile heights down the rows.
        light, view: (..., 3) unit vectors away from the surface, surface frame.
        footprint: (...) standard deviation of the Gaussian kernel, texels of the data's grid.
        curvature: (...) along the projected view ray, 1/tile width, positive convex.
    """

    uv: Array
    light: Array
    view: Array
    footprint: Array
    curvature: Array


class Response(NamedTuple):
    """What a material answers.

    Attributes:
        reflectance: (..., c) pi x radiance per unit irradiance on a surface facing the
            light; not premultiplied by opacity; 0 where opacity is 0.
        opacity: (...) share of the kernel that the material covers, 0 to 1.
    """

    reflectance: Array
    opacity: Array


def broadcast(
    uv: ArrayLike,
    light: ArrayLike,
    view: ArrayLike,
    footprint: ArrayLike = 0.5,
    curvature: ArrayLike = 0.0,
) -> tuple[Query, tuple[int, ...]]:
    """One flat, contiguous query from parts whose leading shapes broadcast.

    Returns:
        query: every part flattened to (b, ...); uv float64, the rest float32.
        shape: the leading shape that the flat answer unfolds to.

    Raises:
        ValueError: wrong last axes, or leading shapes that do not broadcast.
    """
    query, shape = flatten(uv, light, view, footprint, curvature)
    b = math.prod(shape)
    first, *rest = (
        part
        if len(part) == b
        else np.ascontiguousarray(np.broadcast_to(part, (b, *part.shape[1:])))
        for part in query
    )
    return Query(first.astype(np.float64, copy=False), *rest), shape


def flatten(
    uv: ArrayLike,
    light: ArrayLike,
    view: ArrayLike,
    footprint: ArrayLike = 0.5,
    curvature: ArrayLike = 0.0,
) -> tuple[Query, tuple[int, ...]]:
    """As `broadcast`, but copies as little as it can.

    uv keeps its texel where it is huge: it is reduced to one tile by the caller that knows the
    wrap, so it is left in float64 here unless it came in float32.

    Returns:
        query: every part flattened to (b, ...), or to one row where that holds for all; uv
            float32 or float64, the rest float32; all contiguous.
        shape: the leading shape that the flat answer unfolds to.

    Raises:
        ValueError: wrong last axes, or leading shapes that do not broadcast.
    """
    place = np.asarray(uv)
    parts: tuple[NDArray[Any], ...] = (
        np.asarray(place, np.float32 if place.dtype == np.float32 else np.float64),
        np.asarray(light, np.float32),
        np.asarray(view, np.float32),
    )
    for name, part, size in zip(("uv", "light", "view"), parts, (2, 3, 3), strict=True):
        if part.ndim < 1 or part.shape[-1] != size:
            raise ValueError(f"{name} has shape {part.shape}; expected (..., {size})")
    scalars = (np.asarray(footprint, np.float32), np.asarray(curvature, np.float32))
    leading = [part.shape[:-1] for part in parts] + [scalar.shape for scalar in scalars]
    try:
        shape = np.broadcast_shapes(*leading)
    except ValueError as error:
        raise ValueError(f"leading shapes {leading} do not broadcast") from error
    flat = [_rows(part, shape, part.shape[-1:]) for part in parts]
    return Query(*flat, *(_rows(part, shape, ()) for part in scalars)), shape


def flat_drift(drift: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Drifts (..., 4) of queries of a leading shape as (b, 4), held within `MOST_DRIFT`.

    Raises:
        ValueError: wrong last axis, or a leading shape that does not broadcast to `shape`.
    """
    part = np.asarray(drift, np.float32)
    if part.ndim < 1 or part.shape[-1] != 4:
        raise ValueError(f"drift has shape {part.shape}; expected (..., 4)")
    try:
        every = np.broadcast_to(part, (*shape, 4))
    except ValueError as error:
        raise ValueError(
            f"drift has leading shape {part.shape[:-1]}; the other parts have {shape}"
        ) from error
    flat = np.ascontiguousarray(every).reshape(-1, 4)
    if len(flat) and flat.min() >= -MOST_DRIFT and flat.max() <= MOST_DRIFT:
        return flat
    return np.clip(flat, -MOST_DRIFT, MOST_DRIFT)


def _rows(part: NDArray[Any], shape: tuple[int, ...], last: tuple[int, ...]) -> NDArray[Any]:
    """A part as (b, ...) or, where one row holds for all, (1, ...)."""
    if part.size == math.prod(last):
        return np.ascontiguousarray(part).reshape(1, *last)
    return np.ascontiguousarray(np.broadcast_to(part, (*shape, *last))).reshape(-1, *last)


def share_lights(
    uv: ArrayLike,
    light: ArrayLike,
    view: ArrayLike,
    footprint: ArrayLike = 0.5,
    curvature: ArrayLike = 0.0,
) -> bool:
    """Whether several lights (m, 1, ..., 3) meet several views that have no axis of theirs."""
    lights = np.shape(light)[:-1]
    if len(lights) < 2 or lights[0] < 2 or math.prod(lights[1:]) != 1:
        return False
    views = [np.shape(uv)[:-1], np.shape(view)[:-1], np.shape(footprint), np.shape(curvature)]
    own = [len(shape) < len(lights) or (len(shape) == len(lights) and shape[0] == 1)
           for shape in views]  # fmt: skip
    return all(own) and max(math.prod(shape) for shape in views) > 1


@final
@dataclass(frozen=True, eq=False)
class QuerySet:
    """b queries, and where they were measured or traced, their answers.

    Attributes:
        uv: (b, 2); light, view: (b, 3); footprint, curvature: (b,) — as in `Query`.
        rgb: (b, c) answers, or None. opacity, weight: (b,), or None.
        size: (h, w) of the data's grid that footprint counts in, or None.
        channels: one name a channel of `rgb`.
        provenance: where the queries come from; JSON types only.

    Raises:
        ValueError: arrays that do not fit each other.
    """

    uv: Array
    light: Array
    view: Array
    footprint: Array | None = None
    curvature: Array | None = None
    rgb: Array | None = None
    opacity: Array | None = None
    weight: Array | None = None
    size: tuple[int, int] | None = None
    channels: tuple[str, ...] = ("R", "G", "B")
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        put = object.__setattr__
        for name, tail in (("uv", 2), ("light", 3), ("view", 3)):
            value = np.ascontiguousarray(getattr(self, name), np.float32)
            if value.ndim != 2 or value.shape[1] != tail:
                raise ValueError(f"{name} has shape {value.shape}; expected (b, {tail})")
            put(self, name, value)
        b = len(self.uv)
        if self.rgb is not None:
            rgb = np.ascontiguousarray(self.rgb, np.float32)
            if rgb.ndim != 2:
                raise ValueError(f"rgb has shape {rgb.shape}; expected ({b}, c)")
            put(self, "rgb", rgb)
            if len(self.channels) != rgb.shape[1]:
                raise ValueError(f"{len(self.channels)} channel names for {rgb.shape[1]} channels")
        for name in ("footprint", "curvature", "opacity", "weight"):
            if (value := getattr(self, name)) is not None:
                put(self, name, np.ascontiguousarray(value, np.float32).reshape(-1))
        for name in _ROWS:
            value = getattr(self, name)
            if value is not None and len(value) != b:
                raise ValueError(f"{name} has {len(value)} rows; uv has {b}")
        if self.size is not None and min(self.size) < 1:
            raise ValueError(f"size = {self.size}; expected (h, w), both positive")

    def __len__(self) -> int:
        return len(self.uv)

    def __repr__(self) -> str:
        """Short: how many, and what comes with them."""
        known = [name for name in _ROWS[3:] if getattr(self, name) is not None]
        return f"QuerySet({len(self)} queries{', with ' if known else ''}{', '.join(known)})"

    def valid(self) -> NDArray[np.bool_]:
        """(b,) rows that are finite throughout and not seen from below the horizon."""
        with np.errstate(over="ignore", invalid="ignore"):
            keep = self.view[:, 2] >= 0
            for direction in (self.light, self.view):
                keep &= np.einsum("ij,ij->i", direction, direction) > 0
        for name in _ROWS:
            value = getattr(self, name)
            # Looking at rows costs ten times what looking at everything does.
            if value is not None and not (finite := np.isfinite(value)).all():
                keep &= finite.reshape(len(value), -1).all(axis=1)
        return keep

    def subset(self, rows: NDArray[Any] | slice) -> QuerySet:
        """The given rows, by index, mask or slice."""
        columns: dict[str, Any] = {name: getattr(self, name) for name in _ROWS}
        picked: dict[str, Any] = {
            name: None if v is None else v[rows] for name, v in columns.items()
        }
        return replace(self, **picked)


_ROWS = tuple(f.name for f in fields(QuerySet) if f.name not in ("size", "channels", "provenance"))
