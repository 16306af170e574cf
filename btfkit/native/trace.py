"""Face of the tracing kernel, and its plain numpy twin.

Lengths are in texels: columns and rows count texel centres (row runs down, so it is -y), heights
are in texel edges. Between four centres the height is bilinear, and along a ray through such a
cell ray height minus relief is a quadratic: the first hit is exact, whatever its size.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from btfkit import native

Array = NDArray[np.float32]

# Start of secondary rays above the surface, texels.
LIFT = np.float32(1e-3)
# Lowest z of a traced direction, 89.4 degrees: closer to the horizon a ray crosses endless tiles.
STEEPEST = np.float32(0.01)
_ROWS_DOWN = np.array([1, -1, 1], np.float32)


@final
@dataclass(frozen=True, eq=False)
class Geometry:
    """A relief as the kernel wants it.

    Attributes:
        height: (h, w) texel edges.
        maps: (h, w, 2 c + 4): albedo, specular, alpha along and across, tangent angle, opacity.
        wrap: whether it repeats.
        cellmax: (h, w) highest corner of the cell right of and below each centre.
    """

    height: Array
    maps: Array
    wrap: bool
    cellmax: Array

    @property
    def channels(self) -> int:
        """Of the reflectance."""
        return (self.maps.shape[2] - 4) // 2


class Traced(NamedTuple):
    """Per query: reflectance (b, c), opacity (b,); column, row, height, visibility seen (b,)."""

    rgb: Array
    opacity: Array
    column: Array
    row: Array
    height: Array
    visible: Array


def geometry(height: Array, maps: Array, *, wrap: bool) -> Geometry:
    """A `Geometry` with its table of cells."""
    around = ((0, 1), (0, 1))
    padded = np.pad(height, around, mode="wrap") if wrap else np.pad(height, around, mode="edge")
    corners = [padded[:-1, :-1], padded[1:, :-1], padded[:-1, 1:], padded[1:, 1:]]
    cellmax = np.maximum.reduce(corners)
    contiguous = np.ascontiguousarray(height, np.float32)
    return Geometry(contiguous, np.ascontiguousarray(maps, np.float32), wrap, cellmax)


def trace(
    relief: Geometry,
    place: Array,
    light: Array,
    view: Array,
    footprint: Array,
    *,
    samples: int = 1,
    bounces: int = 0,
    seed: int = 0,
) -> Traced:
    """Answer flat queries on the plane; compiled where the kernel was built.

    Args:
        relief: what is traced.
        place: (b, 2) column and row on the plane z = 0, texels.
        light, view: (b, 3) unit vectors, surface frame.
        footprint: (b,) deviation of the Gaussian that samples are drawn from, texels; one sample
            is taken at its centre.
        samples: rays a query. bounces: further hits of light after the first. seed: of both.
    """
    kernel = native.load("trace")
    if kernel is None:
        return trace_plain(
            relief, place, light, view, footprint, samples=samples, bounces=bounces, seed=seed
        )
    count = len(place)
    rgb = np.empty((count, relief.channels), np.float32)
    opacity, seen = np.empty(count, np.float32), np.empty((count, 4), np.float32)
    parts = (np.ascontiguousarray(part, np.float32) for part in (place, light, view, footprint))
    kernel.trace(
        relief.height, relief.cellmax, relief.maps, relief.wrap, *parts,
        samples, bounces, seed & 0xFFFFFFFF, native.threads(), rgb, opacity, seen,
    )  # fmt: skip
    return Traced(rgb, opacity, *seen.T)


def trace_plain(
    relief: Geometry,
    place: Array,
    light: Array,
    view: Array,
    footprint: Array,
    *,
    samples: int = 1,
    bounces: int = 0,
    seed: int = 0,
) -> Traced:
    """The same in numpy: one array operation for all rays, cell by cell."""
    count = len(place)
    rgb = np.zeros((count, relief.channels), np.float32)
    opacity, seen = np.zeros(count, np.float32), np.zeros((count, 4), np.float32)
    query = np.arange(count, dtype=np.uint32)
    place, light, view = (np.asarray(part, np.float32) for part in (place, light, view))
    for index in range(samples):
        offset = np.zeros_like(place)
        if samples > 1:
            radius = footprint * np.sqrt(np.float32(-2) * np.log(_uniform(query, index, 0, seed)))
            angle = np.float32(2 * np.pi) * _uniform(query, index, 1, seed)
            offset = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        one, where = _sample(relief, place + offset, light, view, bounces, query, index, seed)
        rgb += where[:, :1] * one
        opacity += where[:, 0]
        seen += where[:, 1:] - np.concatenate([offset, np.zeros_like(offset)], axis=1)
    covered = opacity > 0
    rgb[covered] /= opacity[covered, None]
    return Traced(rgb, opacity / np.float32(samples), *(seen / np.float32(samples)).T)


def _sample(
    relief: Geometry,
    place: Array,
    light: Array,
    view: Array,
    bounces: int,
    query: NDArray[np.uint32],
    index: int,
    seed: int,
) -> tuple[Array, Array]:
    """One ray a query: reflectance (b, c), and (b, 5) opacity, column, row, height, visibility."""
    up = relief.height.max() + LIFT
    v = _lifted(view)
    start = place + v[:, :2] * _ROWS_DOWN[:2] * (up / v[:, 2:])
    column, row, z, _ = _march(relief, start[:, 0], start[:, 1], np.full(len(place), up), -v)
    surface = _Surface.at(relief, column, row)
    rgb = np.zeros((len(place), relief.channels), np.float32)
    visible = np.zeros(len(place), np.float32)
    where = np.stack([surface.opacity, column, row, z, visible], axis=1).astype(np.float32)
    alive = (surface.opacity > 0) & (light[:, 2] > 0)
    throughput = np.ones_like(rgb)
    outgoing = view
    for bounce in range(bounces + 1):
        faces = alive & (_dot(surface.normal, light) > 0)
        lit = np.flatnonzero(faces)
        if lit.size:
            free = ~_occluded(
                relief, column[lit], row[lit], z[lit], surface.normal[lit], light[lit]
            )
            lit = lit[free]
            if bounce == 0:
                where[lit, 4] = 1
            rgb[lit] += throughput[lit] * surface.take(lit).shaded(light[lit], outgoing[lit])
        if bounce == bounces:
            break
        u1 = _uniform(query, index, 16 + 2 * bounce, seed)
        u2 = _uniform(query, index, 17 + 2 * bounce, seed)
        radius, angle = np.sqrt(u1), np.float32(2 * np.pi) * u2
        along = (radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - u1))
        axes = (surface.tangent, surface.bitangent, surface.normal)
        onward: Array = np.sum([s[:, None] * a for s, a in zip(along, axes, strict=True)], axis=0)
        gain = surface.shaded(onward, outgoing)
        cosine = np.maximum(_dot(surface.normal, onward), np.float32(1e-6))
        throughput = throughput * gain / cosine[:, None]
        n = surface.normal
        column, row, z, found = _march(
            relief, column + LIFT * n[:, 0], row - LIFT * n[:, 1], z + LIFT * n[:, 2], onward, alive
        )
        surface = _Surface.at(relief, column, row)
        outgoing = -onward
        alive = alive & found & (_dot(surface.normal, outgoing) > 0)
    return rgb, where


class _Surface(NamedTuple):
    """What a ray meets: (b, 3) frame and (b, ...) reflectance."""

    normal: Array
    tangent: Array
    bitangent: Array
    albedo: Array
    specular: Array
    along: Array
    across: Array
    opacity: Array

    @staticmethod
    def at(relief: Geometry, column: Array, row: Array) -> _Surface:
        """The surface under (b,) columns and rows."""
        corners, a, b = _cell(relief, column, row)
        h00, h10, h01, h11 = (relief.height[j, i] for j, i in corners)
        twist = h11 - h10 - h01 + h00
        ones = np.ones_like(a)
        slope = np.stack([-(h10 - h00 + twist * b), h01 - h00 + twist * a, ones], axis=1)
        normal = _unit(slope)
        weights = ((1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b)
        maps = [relief.maps[j, i] for j, i in corners]
        mixed: Array = np.sum([w[:, None] * m for w, m in zip(weights, maps, strict=True)], axis=0)
        c = relief.channels
        nearest = (a >= 0.5).astype(int) + 2 * (b >= 0.5)
        angle = np.choose(nearest, [m[:, 2 * c + 2] for m in maps])
        flat = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
        tangent = _unit(flat - normal * _dot(flat, normal)[:, None])
        return _Surface(
            normal, tangent, np.cross(normal, tangent), mixed[:, :c], mixed[:, c : 2 * c],
            mixed[:, 2 * c], mixed[:, 2 * c + 1], np.minimum(mixed[:, 2 * c + 3], 1),
        )  # fmt: skip

    def take(self, rows: NDArray[np.intp]) -> _Surface:
        return _Surface(*(part[rows] for part in self))

    def shaded(self, light: Array, view: Array) -> Array:
        """(b, c) pi f (n . light): Lambert under GGX, Smith's masking, Schlick's Fresnel."""
        nl = _dot(self.normal, light)
        nv = np.maximum(_dot(self.normal, view), 1e-4)
        half = _unit(light + view)
        nh = np.maximum(_dot(self.normal, half), 0)
        vh = np.maximum(_dot(view, half), 0)
        hx, hy = _dot(self.tangent, half) / self.along, _dot(self.bitangent, half) / self.across
        lobe = 1 / (np.pi * self.along * self.across * (hx**2 + hy**2 + nh**2) ** 2)
        masks = []
        for direction, cosine in ((light, nl), (view, nv)):
            x = self.along * _dot(self.tangent, direction)
            y = self.across * _dot(self.bitangent, direction)
            masks.append(cosine + np.sqrt(cosine**2 + x**2 + y**2))
        f0 = self.specular
        f90 = np.minimum(1, 50 * f0)
        rest = (1 - _schlick(f0, f90, nl)) * (1 - _schlick(f0, f90, nv))
        gloss = (np.pi * lobe / (masks[0] * masks[1]))[:, None] * _schlick(f0, f90, vh)
        return np.where(nl[:, None] > 0, (self.albedo * rest + gloss) * nl[:, None], 0)


def _march(
    relief: Geometry,
    column: Array,
    row: Array,
    z: Array,
    direction: Array,
    alive: NDArray[np.bool_] | None = None,
) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """First crossing from above to below: (b,) column, row, height, and whether there is one."""
    lowest, highest = relief.height.min(), relief.height.max()
    i, j = np.floor(column).astype(np.int64), np.floor(row).astype(np.int64)
    a, b = (column - i).astype(np.float32), (row - j).astype(np.float32)
    z = z.astype(np.float32).copy()
    d = direction.astype(np.float32) * _ROWS_DOWN
    found = np.zeros(len(z), bool)
    going = np.arange(len(z)) if alive is None else np.flatnonzero(alive)
    flat = np.hypot(d[:, 0], d[:, 1])
    reach = (highest - lowest) / np.maximum(np.abs(d[:, 2]), 1e-6) * flat
    most = 64 + 2 * int(min(1e6, float(reach[going].max(initial=0))) + 2)
    for _ in range(most):
        if not going.size:
            break
        ai, bi, zi, (da, db, dz) = a[going], b[going], z[going], d[going].T
        with np.errstate(divide="ignore", invalid="ignore"):
            ta = np.where(da > 0, (1 - ai) / da, np.where(da < 0, -ai / da, np.inf))
            tb = np.where(db > 0, (1 - bi) / db, np.where(db < 0, -bi / db, np.inf))
            ta, tb = np.maximum(ta, 0), np.maximum(tb, 0)
            leave = np.minimum(ta, tb)
            vertical = ~np.isfinite(leave)
            through = np.where(dz < 0, (zi - lowest + 1) / -dz, (highest - zi + 1) / dz)
            leave = np.where(vertical, through, leave)
        t = _crossing(relief, (i[going], j[going]), ai, bi, zi, da, db, dz)
        hit = t <= leave
        t = np.where(hit, t, leave)
        zi = zi + dz * t
        under = ~hit & (dz < 0) & (zi < lowest)
        gone = ~hit & (vertical | ((dz > 0) & (zi > highest)) | under)
        found[going] = hit | (under & ~vertical)
        z[going] = np.where(under, lowest, zi)
        ai, bi = ai + da * t, bi + db * t
        stay = hit | gone
        first = ~stay & (ta <= tb)
        second = ~stay & ~first
        i[going] += np.where(first, np.where(da > 0, 1, -1), 0)
        j[going] += np.where(second, np.where(db > 0, 1, -1), 0)
        a[going] = np.where(first, np.where(da > 0, 0, 1), np.clip(ai, 0, 1))
        b[going] = np.where(second, np.where(db > 0, 0, 1), np.clip(bi, 0, 1))
        going = going[~stay]
    return i + a, j + b, z, found


def _crossing(
    relief: Geometry,
    cell: tuple[NDArray[np.int64], NDArray[np.int64]],
    a: Array,
    b: Array,
    z: Array,
    da: Array,
    db: Array,
    dz: Array,
) -> Array:
    """Where along each ray its cell's bilinear height is met first; infinite where it is not."""
    i, j = cell
    h00, h10, h01, h11 = (relief.height[r, c] for r, c in _corners(relief, i, j))
    ha, hb, hab = h10 - h00, h01 - h00, h11 - h10 - h01 + h00
    q0 = z - (h00 + ha * a + hb * b + hab * a * b)
    q1 = dz - ha * da - hb * db - hab * (a * db + b * da)
    q2 = -hab * da * db
    with np.errstate(invalid="ignore", divide="ignore"):
        below = -q1 + np.sqrt(q1 * q1 - 4 * q2 * q0)
        t = np.where(below > 0, 2 * q0 / below, np.inf)
    return np.where(q0 <= 0, 0, t)


def _occluded(
    relief: Geometry, column: Array, row: Array, z: Array, normal: Array, light: Array
) -> NDArray[np.bool_]:
    start = (column + LIFT * normal[:, 0], row - LIFT * normal[:, 1], z + LIFT * normal[:, 2])
    return _march(relief, *start, _lifted(light))[3]


def _cell(
    relief: Geometry, column: Array, row: Array
) -> tuple[list[tuple[NDArray[np.int64], NDArray[np.int64]]], Array, Array]:
    i, j = np.floor(column).astype(np.int64), np.floor(row).astype(np.int64)
    return _corners(relief, i, j), (column - i).astype(np.float32), (row - j).astype(np.float32)


def _corners(
    relief: Geometry, i: NDArray[np.int64], j: NDArray[np.int64]
) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """(row, column) of the corners 00, 10, 01, 11 of cells."""
    h, w = relief.height.shape
    if relief.wrap:
        cols, rows = (i % w, (i + 1) % w), (j % h, (j + 1) % h)
    else:
        cols = np.clip(i, 0, w - 1), np.clip(i + 1, 0, w - 1)
        rows = np.clip(j, 0, h - 1), np.clip(j + 1, 0, h - 1)
    return [(r, c) for r in rows for c in cols]


def _lifted(direction: Array) -> Array:
    """Directions no closer to the horizon than `STEEPEST`."""
    flat = np.hypot(direction[:, 0], direction[:, 1])
    keep = np.sqrt(1 - STEEPEST**2) / np.maximum(flat, 1e-15)
    low = direction[:, :2] * keep[:, None]
    bent = np.column_stack([low, np.full(len(low), STEEPEST)])
    return np.where(direction[:, 2:] >= STEEPEST, direction, bent).astype(np.float32)


def _schlick(f0: Array, f90: Array, cosine: Array) -> Array:
    return f0 + (f90 - f0) * ((1 - cosine) ** 5)[:, None]


def _dot(a: Array, b: Array) -> Array:
    return np.einsum("ij,ij->i", a, b)


def _unit(v: Array) -> Array:
    return v / np.sqrt(np.maximum(_dot(v, v), np.float32(1e-30)))[:, None]


def _uniform(query: NDArray[np.uint32], index: int, dimension: int, seed: int) -> Array:
    """Counter-based random numbers in (0, 1): the same for a query whatever else is traced."""
    with np.errstate(over="ignore"):
        inner = _hash(np.uint32(dimension) ^ _hash(np.uint32(seed & 0xFFFFFFFF)))
        mixed = _hash(query ^ _hash(np.uint32(index) ^ inner))
    return (((mixed >> np.uint32(8)) + np.float32(0.5)) * np.float32(2**-24)).astype(np.float32)


def _hash(x: NDArray[np.uint32] | np.uint32) -> NDArray[np.uint32]:
    state = np.asarray(x, np.uint32) * np.uint32(747796405) + np.uint32(2891336453)
    word = ((state >> ((state >> np.uint32(28)) + np.uint32(4))) ^ state) * np.uint32(277803737)
    return (word >> np.uint32(22)) ^ word
