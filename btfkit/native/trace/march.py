"""Rays against a relief, in numpy: the twin of march.hpp.

Lengths are in texels: columns and rows count texel centres (row runs down, so it is -y), heights
are in texel edges. Between four centres the height is bilinear, and along a straight ray through
such a cell ray height minus relief is a quadratic: the first hit is exact, whatever its size.
A cylinder is the same relief, unrolled; a straight ray is a curve over it, followed in pieces.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
Floats = NDArray[np.floating[Any]]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

INF = 1e30
# A ray that has gone so far without a hit has left, texels.
FAR = 1e6
# Most that a piece of a curved path leaves it, texels; that it turns, radians; its length, texels.
SAG, BEND, LONGEST = 1 / 256, 0.25, 1024.0
# Steps of the table of cells over the range of heights.
LEVELS = 253


@final
@dataclass(frozen=True, eq=False)
class Geometry:
    """A relief as the kernel wants it.

    Attributes:
        height: (h, w) texel edges.
        maps: (h, w, k) those of the 2 c + 4 planes that vary: albedo, specular, alpha along and
            across, tangent angle, opacity.
        slot: (2 c + 4,) int32, where in `maps` a plane is; -1 where it is `constant`.
        constant: (2 c + 4,) values of planes that are the same everywhere.
        wrap: whether it repeats.
        level: (h, w) bytes; no less than the highest corner of the cell right of and below each
            centre, as `LEVELS` steps over the range of heights. It spares the kernel most cells
            and decides nothing, so the twin goes without.
    """

    height: Array
    maps: Array
    slot: NDArray[np.int32]
    constant: Array
    wrap: bool
    level: NDArray[np.uint8]

    @property
    def channels(self) -> int:
        """Of the reflectance."""
        return (len(self.slot) - 4) // 2

    def planes(self, j: Ints, i: Ints) -> Array:
        """(b, 2 c + 4) values of all planes at texels."""
        values = np.tile(self.constant, (len(i), 1))
        values[:, self.slot >= 0] = self.maps[j, i]
        return values

    @property
    def lowest(self) -> np.float32:
        """Of all heights."""
        return self.height.min()

    @property
    def highest(self) -> np.float32:
        """Of all heights."""
        return self.height.max()


def geometry(height: Array, maps: Array, *, wrap: bool) -> Geometry:
    """A `Geometry` of (h, w) heights and all (h, w, 2 c + 4) maps."""
    height = np.ascontiguousarray(height, np.float32)
    around = ((0, 1), (0, 1))
    padded = np.pad(height, around, mode="wrap") if wrap else np.pad(height, around, mode="edge")
    around_each = [padded[:-1, :-1], padded[1:, :-1], padded[:-1, 1:], padded[1:, 1:]]
    above = np.maximum.reduce(around_each).astype(np.float64) - float(height.min())
    # A hundredth of a step for the rounding of the kernel's comparison.
    level = np.ceil(above * (LEVELS / max(float(np.ptp(height)), 1e-30)) + 0.01).astype(np.uint8)
    maps = np.asarray(maps, np.float32)
    constant = maps[0, 0].copy()
    varies = (maps != constant).any(axis=(0, 1))
    slot = np.where(varies, np.cumsum(varies) - 1, -1).astype(np.int32)
    return Geometry(height, np.ascontiguousarray(maps[..., varies]), slot, constant, wrap, level)


class Point(NamedTuple):
    """(b,) cells (column i, row j), places in them (0..1), and heights."""

    i: Ints
    j: Ints
    a: Floats
    b: Floats
    z: Floats

    @staticmethod
    def over(column: Floats, row: Floats, z: Floats) -> Point:
        """The points at (b,) columns and rows."""
        i, j = np.floor(column).astype(np.int64), np.floor(row).astype(np.int64)
        return Point(
            i, j, (column - i).astype(np.float32), (row - j).astype(np.float32),
            z.astype(np.float32),
        )  # fmt: skip

    def moved(self, da: Floats, db: Floats, dz: Floats) -> Point:
        """Points that far right, down and up."""
        near = Point.over(self.a + da, self.b + db, self.z + dz)
        return Point(self.i + near.i, self.j + near.j, near.a, near.b, near.z)

    def take(self, rows: NDArray[Any]) -> Point:
        """Some of the points."""
        i, j, a, b, z = self
        return Point(i[rows], j[rows], a[rows], b[rows], z[rows])

    def put(self, rows: NDArray[Any], other: Point) -> None:
        """Overwrite some of the points."""
        for mine, theirs in zip(self, other, strict=True):
            mine[rows] = theirs


class Patch(NamedTuple):
    """(b,) curvature, 1/texel, along the unit directions (ex, ey) of the surface frame."""

    k: Floats
    ex: Floats
    ey: Floats

    def take(self, rows: NDArray[Any]) -> Patch:
        """Some of the patches."""
        return Patch(*(part[rows] for part in self))

    def turned(self, v: Floats, turn: Floats) -> Floats:
        """(b, 3) vectors in the frame turned by `turn` (b, 2), cosine and sine."""
        along, axis = v[:, 0] * self.ex + v[:, 1] * self.ey, v[:, 1] * self.ex - v[:, 0] * self.ey
        s = along * turn[:, 0] - v[:, 2] * turn[:, 1]
        z = along * turn[:, 1] + v[:, 2] * turn[:, 0]
        bent = np.stack([s * self.ex - axis * self.ey, s * self.ey + axis * self.ex, z], axis=1)
        return np.where((self.k == 0)[:, None], v, bent)

    def steps(self, s: Floats, a: Floats) -> tuple[Floats, Floats]:
        """Columns and rows of arcs along (ex, ey) and lengths along the axis."""
        return s * self.ex - a * self.ey, -(s * self.ey + a * self.ex)


class Hit(NamedTuple):
    """(b,) whether there is one, where, how far along the ray, and (b, 2) the turn of the frame."""

    met: Bools
    at: Point
    t: Floats
    turn: Floats


def corners(relief: Geometry, i: Ints, j: Ints) -> list[tuple[Ints, Ints]]:
    """(row, column) of the corners 00, 10, 01, 11 of cells."""
    h, w = relief.height.shape
    if relief.wrap:
        cols, rows = (i % w, (i + 1) % w), (j % h, (j + 1) % h)
    else:
        cols = np.clip(i, 0, w - 1), np.clip(i + 1, 0, w - 1)
        rows = np.clip(j, 0, h - 1), np.clip(j + 1, 0, h - 1)
    return [(r, c) for r in rows for c in cols]


def intersect(relief: Geometry, patch: Patch, at: Point, d: Floats, alive: Bools) -> Hit:
    """Rays from points along (b, 3) directions of the frames there, until they hit or leave."""
    count = len(at.z)
    hit = Hit(
        np.zeros(count, bool), at.take(np.arange(len(at.z))),
        np.zeros(count, np.float32), np.tile(np.array([1, 0], np.float32), (count, 1)),
    )  # fmt: skip
    for rows in (np.flatnonzero(alive & (patch.k == 0)), np.flatnonzero(alive & (patch.k != 0))):
        if not rows.size:
            continue
        some, p = at.take(rows), patch.take(rows)
        one = (
            _plane(relief, some, d[rows])
            if p.k[0] == 0
            else intersect_curved(relief, p, some, d[rows])
        )
        hit.met[rows], hit.t[rows], hit.turn[rows] = one.met, one.t, one.turn
        hit.at.put(rows, one.at)
    return hit


def _plane(relief: Geometry, at: Point, d: Floats) -> Hit:
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        down, up = (at.z - relief.lowest) / -d[:, 2], (relief.highest - at.z) / d[:, 2]
        last = np.where(d[:, 2] < 0, down, np.where(d[:, 2] > 0, up, FAR))
    most = np.minimum(np.maximum(last, 0), FAR).astype(np.float32) + 1
    hit = march(relief, at, d[:, 0], -d[:, 1], d[:, 2], most)
    fallen = ~hit.met & (d[:, 2] < 0)
    hit.met[fallen] = True
    hit.at.z[fallen] = relief.lowest
    return hit


def intersect_curved(relief: Geometry, patch: Patch, at: Point, d: Floats) -> Hit:
    """The same on cylinders, piece by piece."""
    line = Line.of(patch, at.z, d)
    bend = np.abs(patch.k)
    thin = np.minimum(1 + patch.k * relief.lowest, 1 + patch.k * relief.highest)
    flat = np.maximum(np.sqrt(line.q), 1e-3)
    piece = np.minimum(thin * np.minimum(np.sqrt(8 * SAG / bend), BEND / bend) / flat, LONGEST)
    t, start = np.zeros_like(piece), line.at(np.zeros_like(piece))
    here = at.take(np.arange(len(at.z)))
    hit = Hit(np.zeros(len(t), bool), here, np.ones_like(t), start.turn.copy())
    going = np.arange(len(t))
    s, a, rise = start.s.copy(), start.a.copy(), start.rise.copy()
    while going.size:
        going = going[t[going] < FAR]
        t[going] += piece[going]
        to, p = line.take(going).at(t[going]), patch.take(going)
        da, db = p.steps(to.s - s[going], to.a - a[going])
        dz = to.rise - rise[going]
        one = march(relief, here.take(going), da, db, dz, np.ones_like(dz))
        found = one.met | (at.z[going] + to.rise < relief.lowest)
        met = going[found]
        hit.met[met] = True
        here.put(met, one.at.take(found))
        back = t[met] - piece[met] * (1 - one.t[found])
        hit.turn[met] = line.take(met).at(back).turn
        on = ~found
        da, db = p.steps(to.s, to.a)
        next_ = at.take(going).moved(da, db, to.rise)
        here.put(going[on], next_.take(on))
        hit.turn[going[on]] = to.turn[on]
        s[going], a[going], rise[going] = to.s, to.a, to.rise
        going = going[on & ~((dz > 0) & (next_.z > relief.highest))]
    return hit


class _At(NamedTuple):
    s: Floats
    a: Floats
    rise: Floats
    turn: Floats


class Line(NamedTuple):
    """Straight lines in unrolled coordinates: arc along (ex, ey), axis, height."""

    k: Floats
    above: Floats
    dx: Floats
    da: Floats
    dz: Floats
    q: Floats

    @staticmethod
    def of(patch: Patch, z: Floats, d: Floats) -> Line:
        """From height z (b,) along d (b, 3)."""
        dx = d[:, 0] * patch.ex + d[:, 1] * patch.ey
        da = d[:, 1] * patch.ex - d[:, 0] * patch.ey
        return Line(patch.k, 1 + patch.k * z, dx, da, d[:, 2], dx * dx + d[:, 2] * d[:, 2])

    def take(self, rows: NDArray[Any]) -> Line:
        """Some of the lines."""
        return Line(*(part[rows] for part in self))

    def at(self, t: Floats) -> _At:
        """Arc, axis, rise since t = 0, and (b, 2) cosine and sine of the frame's turn."""
        x, up = self.k * t * self.dx, self.above + self.k * t * self.dz
        m = np.sqrt(x * x + up * up)
        # Height and arc without the differences of almost equal numbers that small k would bring.
        rise = t * (2 * self.above * self.dz + self.k * t * self.q) / (m + self.above)
        y = x / up
        series = 1 - y * y * (1 / 3 - y * y * (0.2 - y * y / 7))
        with np.errstate(divide="ignore", invalid="ignore"):
            s = np.where(np.abs(y) < 0.05, t * self.dx / up * series, np.arctan2(x, up) / self.k)
        return _At(s, t * self.da, rise, np.stack([up / m, x / m], axis=1))


def march(relief: Geometry, at: Point, da: Floats, db: Floats, dz: Floats, most: Floats) -> Hit:
    """First crossing from above to below of at + t (da, db, dz), 0 <= t <= most."""
    with np.errstate(divide="ignore", over="ignore"):
        pa, pb = (np.minimum(1 / np.abs(d), INF).astype(np.float32) for d in (da, db))
    ta = np.where(da != 0, np.where(da > 0, 1 - at.a, at.a) * pa, INF).astype(np.float32)
    tb = np.where(db != 0, np.where(db > 0, 1 - at.b, at.b) * pb, INF).astype(np.float32)
    i, j, t0 = at.i.copy(), at.j.copy(), np.zeros_like(ta)
    found, t_hit = np.zeros(len(ta), bool), np.array(most, np.float32)
    a_hit, b_hit = at.a.copy(), at.b.copy()
    z_hit = (at.z + dz * most).astype(np.float32)
    going = np.arange(len(ta))
    while going.size:
        g = going
        t1 = np.minimum(np.minimum(ta[g], tb[g]), most[g])
        a = np.clip(at.a[g] + (at.i - i)[g].astype(np.float32) + da[g] * t0[g], 0, 1)
        b = np.clip(at.b[g] + (at.j - j)[g].astype(np.float32) + db[g] * t0[g], 0, 1)
        z = at.z[g] + dz[g] * t0[g]
        t = _crossing(relief, i[g], j[g], a, b, z, da[g], db[g], dz[g])
        hit = t <= t1 - t0[g]
        h = g[hit]
        found[h], t_hit[h] = True, t0[h] + t[hit]
        a_hit[h], b_hit[h] = a[hit] + da[h] * t[hit], b[hit] + db[h] * t[hit]
        z_hit[h] = z[hit] + dz[h] * t[hit]
        ended = ~hit & (t1 >= most[g])
        e = g[ended]
        a_hit[e] = np.clip(at.a[e] + (at.i - i)[e].astype(np.float32) + da[e] * most[e], 0, 1)
        b_hit[e] = np.clip(at.b[e] + (at.j - j)[e].astype(np.float32) + db[e] * most[e], 0, 1)
        going = g[~hit & ~ended]
        t0[going] = t1[~hit & ~ended]
        # Through a corner, both.
        columns, rows = going[ta[going] <= tb[going]], going[tb[going] <= ta[going]]
        ta[columns], tb[rows] = ta[columns] + pa[columns], tb[rows] + pb[rows]
        i[columns] += np.where(da[columns] > 0, 1, -1)
        j[rows] += np.where(db[rows] > 0, 1, -1)
    turn = np.tile(np.array([1, 0], np.float32), (len(ta), 1))
    return Hit(found, Point(i, j, a_hit, b_hit, z_hit), t_hit, turn)


def _crossing(
    relief: Geometry,
    i: Ints,
    j: Ints,
    a: Floats,
    b: Floats,
    z: Floats,
    da: Floats,
    db: Floats,
    dz: Floats,
) -> Floats:
    """Where along each ray its cell's bilinear height is met first; infinite where it is not."""
    h00, h10, h01, h11 = (relief.height[r, c] for r, c in corners(relief, i, j))
    ha, hb, hab = h10 - h00, h01 - h00, h11 - h10 - h01 + h00
    q0 = z - (h00 + ha * a + hb * b + hab * (a * b))
    q1 = dz - ha * da - hb * db - hab * (a * db + b * da)
    q2 = -hab * (da * db)
    with np.errstate(invalid="ignore", divide="ignore"):
        below = -q1 + np.sqrt(q1 * q1 - 4 * q2 * q0)
        t = np.where(below > 0, 2 * q0 / below, INF)
    return np.where(q0 <= 0, 0, t)
