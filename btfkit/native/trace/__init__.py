"""Face of the tracing kernel, and its plain numpy twin.

Lengths are in texels: columns and rows count texel centres (row runs down, so it is -y), heights
are in texel edges. Rays and cells: march.py; here are light, reflectance and samples.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from btfkit import native
from btfkit.native.trace.march import (
    Array,
    Bools,
    Floats,
    Geometry,
    Hit,
    Line,
    Patch,
    Point,
    corners,
    geometry,
    intersect,
    intersect_curved,
)

__all__ = ["Geometry", "Traced", "geometry", "trace", "trace_plain"]

# Start of secondary rays above the surface, texels.
LIFT = 1e-3
# Lowest z of a traced direction, 89.4 degrees: closer to the horizon a ray crosses endless tiles.
STEEPEST = 0.01
# Footprints beyond this are taken for this, texels.
WIDEST = 1e6


class Traced(NamedTuple):
    """Per query: reflectance (b, c), opacity (b,), and (b,) what its rays saw.

    Means over the rays that met the relief: column, row and height of what was seen, texels, and
    visibility of the light there; and the share of rays that met it at all (a hole is met, what
    passes a silhouette is not). Where none did, the place that was asked for, and height 0.
    """

    rgb: Array
    opacity: Array
    column: Array
    row: Array
    height: Array
    visible: Array
    met: Array


def trace(
    relief: Geometry,
    place: Array,
    light: Array,
    view: Array,
    footprint: Array,
    curvature: Array | None = None,
    *,
    samples: int = 1,
    bounces: int = 0,
    seed: int = 0,
) -> Traced:
    """Answer flat queries; compiled where the kernel was built.

    Args:
        relief: what is traced.
        place: (b, 2) column and row on the surface z = 0, texels.
        light, view: (b, 3) unit vectors, surface frame at the place.
        footprint: (b,) deviation of the Gaussian that samples are drawn from, texels; one sample
            is taken at its centre.
        curvature: (b,) of the surface z = 0 along the projected view, 1/texel, positive convex,
            1 + curvature * height positive throughout; None for the plane.
        samples: rays a query. bounces: further hits of light after the first. seed: of both.
    """
    if curvature is None:
        curvature = np.zeros(len(place), np.float32)
    asked = tuple(
        np.ascontiguousarray(part, np.float32)
        for part in (place, light, view, footprint, curvature)
    )
    kernel = native.load("trace")
    if kernel is None:
        return trace_plain(relief, *asked, samples=samples, bounces=bounces, seed=seed)
    count = len(place)
    rgb = np.empty((count, relief.channels), np.float32)
    opacity, seen = np.empty(count, np.float32), np.empty((count, 5), np.float32)
    kernel.trace(
        relief.height, relief.level, relief.lowest, relief.highest,
        relief.maps, relief.slot, relief.constant, relief.wrap, *asked,
        samples, bounces, seed & 0xFFFFFFFF, native.threads(), rgb, opacity, seen,
    )  # fmt: skip
    return Traced(rgb, opacity, *seen.T)


def trace_plain(
    relief: Geometry,
    place: Array,
    light: Array,
    view: Array,
    footprint: Array,
    curvature: Array | None = None,
    *,
    samples: int = 1,
    bounces: int = 0,
    seed: int = 0,
) -> Traced:
    """The same in numpy: one array operation for all rays, cell by cell."""
    count = len(place)
    if curvature is None:
        curvature = np.zeros(count, np.float32)
    rgb: Floats = np.zeros((count, relief.channels), np.float32)
    cover, met = np.zeros(count, np.float32), np.zeros(count, np.float32)
    seen = [np.zeros(count, np.float32) for _ in ("column", "row", "height", "visible")]
    patch = _patch(curvature, view)
    query = np.arange(count, dtype=np.uint32)
    for index in range(samples):
        shift: Floats = np.zeros_like(place)
        if samples > 1:
            shift = _spread(query, index, samples, seed) * np.minimum(footprint, WIDEST)[:, None]
        ray = _sample(relief, patch, place + shift, light, view, bounces, query, index, seed)
        rgb += ray.opacity[:, None] * ray.rgb
        cover += ray.opacity * ray.met
        met += ray.met
        saw: tuple[Floats, ...] = (
            ray.column - shift[:, 0],
            ray.row - shift[:, 1],
            ray.height,
            ray.visible,
        )
        for total, part in zip(seen, saw, strict=True):
            total += part * ray.met
    with np.errstate(invalid="ignore", divide="ignore"):
        rgb = np.where(cover[:, None] > 0, rgb / cover[:, None], 0)
        nowhere: tuple[Floats, ...] = (*place.T, np.zeros_like(met), np.zeros_like(met))
        column, row, height, visible = (
            np.asarray(np.where(met > 0, total / met, other), np.float32)
            for total, other in zip(seen, nowhere, strict=True)
        )
    n = np.float32(samples)
    return Traced(rgb, cover / n, column, row, height, visible, met / n)


def _patch(curvature: Array, view: Array) -> Patch:
    flat = np.sqrt(view[:, 0] * view[:, 0] + view[:, 1] * view[:, 1])
    straight = (curvature == 0) | (flat < 1e-6)
    with np.errstate(invalid="ignore", divide="ignore"):
        ex, ey = np.where(straight, 1, view[:, 0] / flat), np.where(straight, 0, view[:, 1] / flat)
    return Patch(curvature, ex, ey)


def _spread(query: NDArray[np.uint32], index: int, samples: int, seed: int) -> Floats:
    """(b, 2) of a Gaussian of deviation 1: strata of equal probability, turned by golden angles."""
    one = (np.float32(index) + _uniform(query, index, 0, seed)) / np.float32(samples)
    with np.errstate(over="ignore"):
        turned = _mixed(query, 1, 1, seed) + np.uint32(index * 2654435769 & 0xFFFFFFFF)
    angle = np.float32(2 * np.pi) * _to_unit(turned)
    radius = np.sqrt(-2 * np.log1p(-np.minimum(one, np.float32(0.99999994))))
    return radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _sample(
    relief: Geometry,
    patch: Patch,
    place: Floats,
    light: Floats,
    view: Floats,
    bounces: int,
    query: NDArray[np.uint32],
    index: int,
    seed: int,
) -> Traced:
    """One ray a query, its reflectance not yet weighted by opacity."""
    hit = _first_hit(relief, patch, place, _lifted(view))
    surface = _Surface.at(relief, patch, hit.at)
    at, alive = hit.at, hit.met
    column, row, height, opacity, met = (
        np.array(part, np.float32)
        for part in (at.i + at.a, at.j + at.b, at.z, surface.opacity, alive)
    )
    visible = np.zeros_like(height)
    # The plane goes on for ever and hides every light below its horizon; a cylinder does not.
    alive = alive & (surface.opacity > 0) & ((patch.k != 0) | (light[:, 2] > 0))
    rgb = np.zeros((len(place), relief.channels), np.float32)
    throughput: Floats = np.ones_like(rgb)
    light, outgoing = patch.turned(light, hit.turn), patch.turned(view, hit.turn)
    for bounce in range(bounces + 1):
        faces = alive & (_dot(surface.normal, light) > 0)
        towards = np.where((patch.k == 0)[:, None], _lifted(light), light)
        start = _above(at, surface.normal)
        lit = faces & ~intersect(relief, patch, start, towards, faces).met
        if bounce == 0:
            visible[lit] = 1
        rgb[lit] += throughput[lit] * surface.take(lit).shaded(light[lit], outgoing[lit])
        if bounce == bounces:
            break
        onward = _onward(surface, query, index, bounce, seed)
        cosine = np.maximum(_dot(surface.normal, onward), np.float32(1e-6))
        throughput = throughput * surface.shaded(onward, outgoing) / cosine[:, None]
        hit = intersect(relief, patch, start, onward, alive)
        at, surface = hit.at, _Surface.at(relief, patch, hit.at)
        light, outgoing = patch.turned(light, hit.turn), patch.turned(-onward, hit.turn)
        alive = alive & hit.met & (_dot(surface.normal, outgoing) > 0)
    return Traced(rgb, opacity, column, row, height, visible, met)


def _first_hit(relief: Geometry, patch: Patch, place: Floats, v: Floats) -> Hit:
    """View rays through places on z = 0, from where they come into the layer of the relief."""
    count, up = len(place), relief.highest + np.float32(LIFT)
    slope = up / v[:, 2]
    level = np.full(count, up, np.float32)
    start = Point.over(place[:, 0] + v[:, 0] * slope, place[:, 1] - v[:, 1] * slope, level)
    hit = intersect(relief, patch, start, -v, patch.k == 0)
    curved = np.flatnonzero(patch.k != 0)
    # |centre + t v| = 1/k + up; a concave patch may have no such t: the ray begins half-way across.
    p, v = patch.take(curved), v[curved]
    c = up * (2 + p.k * up)
    square = v[:, 2] * v[:, 2] + p.k * c
    zero = Point.over(place[curved, 0], place[curved, 1], np.zeros(len(curved), np.float32))
    with np.errstate(invalid="ignore"):
        t = np.where(square < 0, -v[:, 2] / p.k, c / (v[:, 2] + np.sqrt(square)))
    comes = ~((square < 0) & (p.k > 0))
    rows = curved[comes]
    p, line = p.take(comes), Line.of(p, zero.z, v).take(comes)
    begin = line.at(t[comes])
    from_ = zero.take(comes).moved(*p.steps(begin.s, begin.a), begin.rise)
    inside = intersect_curved(relief, p, from_, p.turned(-v[comes], begin.turn))
    hit.met[rows] = inside.met
    hit.at.put(rows, inside.at)
    (c0, s0), (c1, s1) = begin.turn.T, inside.turn.T
    hit.turn[rows] = np.stack([c0 * c1 - s0 * s1, s0 * c1 + c0 * s1], axis=1)
    return hit


def _onward(
    surface: _Surface, query: NDArray[np.uint32], index: int, bounce: int, seed: int
) -> Floats:
    """(b, 3) directions, cosine-weighted about the normal."""
    u1 = _uniform(query, index, 16 + 2 * bounce, seed)
    u2 = _uniform(query, index, 17 + 2 * bounce, seed)
    radius, angle = np.sqrt(u1), np.float32(2 * np.pi) * u2
    along = (radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - u1))
    axes = (surface.tangent, surface.bitangent, surface.normal)
    parts = [s[:, None] * a for s, a in zip(along, axes, strict=True)]
    return parts[0] + parts[1] + parts[2]


def _above(at: Point, normal: Floats) -> Point:
    lift = np.float32(LIFT)
    return at.moved(lift * normal[:, 0], -lift * normal[:, 1], lift * normal[:, 2])


class _Surface(NamedTuple):
    """What a ray meets: (b, 3) frame and (b, ...) reflectance."""

    normal: Floats
    tangent: Floats
    bitangent: Floats
    albedo: Floats
    specular: Floats
    along: Floats
    across: Floats
    opacity: Floats

    @staticmethod
    def at(relief: Geometry, patch: Patch, at: Point) -> _Surface:
        """The surface at points of the relief."""
        a, b = at.a[:, None], at.b[:, None]
        around = corners(relief, at.i, at.j)
        m00, m10, m01, m11 = maps = [relief.planes(j, i) for j, i in around]
        # By differences: four equal values give just that value.
        upper, lower = m10 - m00, m11 - m01
        mixed = m00 + a * upper + b * (m01 - m00 + a * (lower - upper))
        c = relief.channels
        nearest = (at.a >= 0.5).astype(int) + 2 * (at.b >= 0.5)
        angle = np.choose(nearest, [m[:, 2 * c + 2] for m in maps])
        h00, h10, h01, h11 = (relief.height[j, i] for j, i in around)
        twist = h11 - h10 - h01 + h00
        slope = np.stack([-(h10 - h00 + twist * at.b), h01 - h00 + twist * at.a], axis=1)
        flat = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        # A cylinder is wider at height z by 1 + k z.
        wide = 1 + patch.k * at.z
        e = np.stack([patch.ex, patch.ey], axis=1)
        slope = slope + e * (_dot(slope, e) * (1 / wide - 1))[:, None]
        flat = flat + e * (_dot(flat, e) * (wide - 1))[:, None]
        normal = _unit(np.column_stack([slope, np.ones_like(wide)]))
        tangent = np.column_stack([flat, np.zeros_like(wide)])
        tangent = _unit(tangent - normal * _dot(tangent, normal)[:, None])
        return _Surface(
            normal, tangent, np.cross(normal, tangent), mixed[:, :c], mixed[:, c : 2 * c],
            mixed[:, 2 * c], mixed[:, 2 * c + 1], np.clip(mixed[:, 2 * c + 3], 0, 1),
        )  # fmt: skip

    def take(self, rows: Bools) -> _Surface:
        return _Surface(*(part[rows] for part in self))

    def shaded(self, light: Floats, view: Floats) -> Floats:
        """(b, c) pi f (n . light): Lambert under GGX, Smith's masking, Schlick's Fresnel."""
        nl = _dot(self.normal, light)
        nv = np.maximum(_dot(self.normal, view), 1e-4)
        half = _unit(light + view)
        nh = np.maximum(_dot(self.normal, half), 0)
        vh = np.maximum(_dot(view, half), 0)
        hx, hy = _dot(self.tangent, half) / self.along, _dot(self.bitangent, half) / self.across
        masks = []
        for direction, cosine in ((light, nl), (view, nv)):
            x = self.along * _dot(self.tangent, direction)
            y = self.across * _dot(self.bitangent, direction)
            masks.append(cosine + np.sqrt(cosine * cosine + x * x + y * y))
        d = hx * hx + hy * hy + nh * nh
        with np.errstate(divide="ignore"):
            lobe = 1 / (self.along * self.across * (d * d) * (masks[0] * masks[1]))
        f0 = self.specular
        f90 = np.minimum(1, 50 * f0)
        rest = (1 - _schlick(f0, f90, nl)) * (1 - _schlick(f0, f90, nv))
        with np.errstate(invalid="ignore"):
            pi_f = self.albedo * rest + lobe[:, None] * _schlick(f0, f90, vh)
            return np.where(nl[:, None] > 0, pi_f * nl[:, None], 0)


def _lifted(direction: Floats) -> Floats:
    """Directions no closer to the horizon than `STEEPEST`."""
    flat = np.sqrt(np.maximum(_dot(direction[:, :2], direction[:, :2]), 1e-30))
    low = direction[:, :2] * (np.float32(np.sqrt(1 - STEEPEST**2)) / flat)[:, None]
    lifted = np.column_stack([low, np.full(len(low), STEEPEST, np.float32)])
    return np.where(direction[:, 2:] >= STEEPEST, direction, lifted)


def _schlick(f0: Floats, f90: Floats, cosine: Floats) -> Floats:
    m = 1 - cosine
    return f0 + (f90 - f0) * ((m * m) * (m * m) * m)[:, None]


def _dot(a: Floats, b: Floats) -> Floats:
    return np.einsum("ij,ij->i", a, b)


def _unit(v: Floats) -> Floats:
    return v / np.sqrt(np.maximum(_dot(v, v), np.float32(1e-30)))[:, None]


def _uniform(query: NDArray[np.uint32], index: int, dimension: int, seed: int) -> Floats:
    """Counter-based random numbers in (0, 1): the same for a query whatever else is traced."""
    return _to_unit(_mixed(query, index, dimension, seed))


def _to_unit(x: NDArray[np.uint32]) -> Floats:
    return ((x >> np.uint32(8)).astype(np.float32) + np.float32(0.5)) * np.float32(2**-24)


def _mixed(query: NDArray[np.uint32], index: int, dimension: int, seed: int) -> NDArray[np.uint32]:
    with np.errstate(over="ignore"):
        inner = _hash(np.uint32(dimension) ^ _hash(np.uint32(seed & 0xFFFFFFFF)))
        return _hash(query ^ _hash(np.uint32(index) ^ inner))


def _hash(x: NDArray[np.uint32] | np.uint32) -> Any:
    state = np.asarray(x, np.uint32) * np.uint32(747796405) + np.uint32(2891336453)
    word = ((state >> ((state >> np.uint32(28)) + np.uint32(4))) ^ state) * np.uint32(277803737)
    return (word >> np.uint32(22)) ^ word
