"""Crossing yarns: what is no height field, traced on the plane and on cylinders. All synthetic.

Yarns of elliptic section run along u (weft) and v (warp) and pass over and under each other; light
and view go between them. Nothing but queries can be made of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from btfkit.errors import unknown
from btfkit.queries import Query, QuerySet
from btfkit.relief import procedural
from btfkit.relief.trace import random_queries

Floats = NDArray[np.floating]
# Places that a ray is looked at for each pitch, and in all; halvings of the step that finds a yarn.
_A_PITCH, _MOST_LOOKS, _HALVINGS = 24, 512, 8
# Rays marched at once; how far above a yarn a ray towards the light begins, tile widths.
_BLOCK, _LIFT = 1 << 15, 1e-3
# Radius of a cylinder over the thickness, at least.
_LEAST_RADIUS = 1.1


@final
@dataclass(frozen=True)
class Weave:
    """One tile of two sets of yarns under z = 0.

    Attributes:
        yarns: of each set in a tile; a multiple of `2 block`.
        block: how many a yarn passes over, and then under.
        width: of a yarn, pitches; below 1 there are holes.
        height: from the top of the upper yarn to the underside of the lower, pitches; the axis of
            each swings by a quarter of it, and each is half of it thick.
        warp, weft: linear RGB. gloss: of both. rough: width of the highlight along a yarn, sine.
    """

    yarns: int
    block: int
    width: float
    height: float
    warp: tuple[float, float, float]
    weft: tuple[float, float, float]
    gloss: float = 0.35
    rough: float = 0.22

    @property
    def thickness(self) -> float:
        """Of the sheet, tile widths."""
        return self.height / self.yarns


CATALOGUE = {
    "basket": Weave(8, 2, 0.92, 0.62, (0.55, 0.12, 0.08), (0.42, 0.42, 0.45)),
    "tabby": Weave(8, 1, 0.62, 0.45, (0.62, 0.5, 0.3), (0.12, 0.22, 0.42)),
}
ABOUT = {
    "basket": "Basket weave of red and grey wicker, two over two: no height field, queries alone.",
    "tabby": "Plain weave with holes between its yarns: no height field, queries alone.",
}


def weave_of(name: str) -> Weave:
    """A weave of the catalogue.

    Raises:
        ValueError: no such weave.
    """
    if name not in CATALOGUE:
        raise ValueError(unknown("weave", name, CATALOGUE))
    return CATALOGUE[name]


def weave_queries(
    name: str,
    count: int,
    *,
    size: int = 128,
    seed: int = 0,
    footprints: Sequence[float] = (0.5,),
    curvatures: tuple[float, float] | None = None,
    lowest_z: float = 0.1,
    samples: int = 4,
) -> QuerySet:
    """Queries of a weave with their answers, drawn as `random_queries` draws them.

    Args:
        size: texels a side, which footprints count in. samples: rays a query.

    Raises:
        ValueError: no such weave, or cylinders thinner than it.
    """
    weave = weave_of(name)
    if curvatures and curvatures[1] * weave.thickness * _LEAST_RADIUS > 1:
        most = 1 / weave.thickness / _LEAST_RADIUS
        raise ValueError(
            f"curvature {curvatures[1]:g} / tile bends {name}, {weave.thickness:g} tiles thick, "
            f"to its axis; at most {most:.3g} here"
        )
    # What is asked is drawn by a flat relief; what it answers is not taken.
    flat = procedural.make("cobbles", size, relief_texels=1.0)
    flat = replace(flat, height=0 * flat.height)
    asked = random_queries(
        flat, count, seed=seed, footprints=footprints, curvatures=curvatures, lowest_z=lowest_z,
        samples=1,
    )  # fmt: skip
    bend = np.zeros(count, np.float32) if asked.curvature is None else asked.curvature
    assert asked.footprint is not None
    query = Query(asked.uv, asked.light, asked.view, asked.footprint, bend)
    rgb, opacity = answer(weave, query, size=size, samples=samples, seed=seed)
    told = {"source": "synthetic", "material": name, "samples": samples, "seed": seed}
    return replace(asked, rgb=rgb, opacity=opacity, size=(size, size), provenance=told)


def answer(
    weave: Weave, query: Query, *, size: int, samples: int = 4, seed: int = 0
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Reflectance (b, 3) and opacity (b,) of a flat query; curvature as in `relief.trace.trace`.

    What gets below a weave on the plane or in a cylinder has passed it; so has what leaves again.
    """
    rng, count = np.random.default_rng(seed), len(query.uv)
    rgb, opacity = np.zeros((count, 3), np.float32), np.zeros(count, np.float32)
    for start in range(0, count, _BLOCK):
        at = slice(start, start + _BLOCK)
        part = Query(*(p[at].astype(float) for p in query))
        total, hits = np.zeros((len(part.uv), 3)), np.zeros(len(part.uv))
        for _ in range(samples):
            spread = (part.footprint / size)[:, None] if samples > 1 else 0.0
            jitter = spread * rng.standard_normal(part.uv.shape)
            moved = (part.uv + jitter).astype(np.float32)
            colour, hit = _shaded(weave, part._replace(uv=moved))
            total += colour
            hits += hit
        rgb[at] = total / np.maximum(hits, 1)[:, None]
        opacity[at] = hits / samples
    return rgb, opacity


class _Bent(NamedTuple):
    """Cylinders along the projected views of b queries, straight space in units of a tile.

    Attributes:
        uv: (b, 2) of the entry. along, across: (b, 2) unit directions on the surface, y up.
        bend: (b,) 1/tile width.
    """

    uv: Floats
    along: Floats
    across: Floats
    bend: Floats

    def on_surface(self, point: Floats) -> tuple[Floats, Floats]:
        """uv (b, 2) and height (b,) of points (b, 3): along, across, up."""
        x, y, z = point.T
        k = self.bend
        turned = np.arctan2(k * x, 1 + k * z)
        way = np.where(np.abs(k) < 1e-9, x, turned / np.where(np.abs(k) < 1e-9, 1, k))
        far = np.sqrt((k * x) ** 2 + (1 + k * z) ** 2)
        height = (k * x**2 + 2 * z + k * z**2) / (far + 1)
        step = way[:, None] * self.along + y[:, None] * self.across
        return self.uv + step * [1, -1], height

    def straight(self, way: Floats, vector: Floats) -> Floats:
        """Vectors (b, 3) x, y, z of the surface's frame at a way (b,) along, in straight space."""
        angle = self.bend * way
        ahead = (vector[:, :2] * self.along).sum(axis=1)
        aside = (vector[:, :2] * self.across).sum(axis=1)
        cos, sin = np.cos(angle), np.sin(angle)
        return np.stack(
            [ahead * cos + vector[:, 2] * sin, aside, vector[:, 2] * cos - ahead * sin], axis=1
        )


def _shaded(weave: Weave, query: Query) -> tuple[Floats, Floats]:
    """Colour (b, 3) of one ray each, and whether it is stopped (b,)."""
    flat = query.view[:, :2]
    length = np.linalg.norm(flat, axis=1, keepdims=True)
    along = np.where(length > 1e-6, -flat / np.maximum(length, 1e-12), [1.0, 0.0])
    bent = _Bent(query.uv, along, np.stack([-along[:, 1], along[:, 0]], 1), query.curvature)
    toward, light = (bent.straight(np.zeros(len(flat)), d) for d in (query.view, query.light))
    way, hit = _met(weave, bent, np.zeros_like(toward), -toward)
    colour = np.zeros((len(flat), 3))
    rows = np.flatnonzero(hit)
    if rows.size:
        bent = _Bent(*(part[rows] for part in bent))
        toward, light = toward[rows], light[rows]
        point = -way[rows, None] * toward
        normal, tangent, warp = _surface(weave, bent, point)
        cosine = np.einsum("ij,ij->i", normal, light)
        # A plane hides lights below its horizon.
        lit = np.flatnonzero((cosine > 0) & ((query.light[rows, 2] > 0) | (bent.bend != 0)))
        own = _Bent(*(part[lit] for part in bent))
        _, dark = _met(weave, own, point[lit] + _LIFT * normal[lit], light[lit])
        lit = lit[~dark]
        sines = [np.einsum("ij,ij->i", tangent[lit], d[lit]) for d in (light, toward)]
        shine = weave.gloss * np.exp(-((sines[0] + sines[1]) ** 2) / (2 * weave.rough**2))
        dye = np.where(warp[lit, None], weave.warp, weave.weft)
        colour[rows[lit]] = (dye + shine[:, None]) * cosine[lit, None]
    return colour, hit.astype(float)


def _met(
    weave: Weave, bent: _Bent, origin: Floats, direction: Floats
) -> tuple[Floats, NDArray[np.bool_]]:
    """Way (b,) along straight rays (b, 3) to the first yarn, and whether there is one."""
    count, deep = len(origin), weave.thickness
    way, hit = np.zeros(count), np.zeros(count, bool)
    alive, step = np.arange(count), 1 / (weave.yarns * _A_PITCH)
    # The surface itself is where rays begin: they count as within from the first step on.
    for k in range(1, _MOST_LOOKS + 1):
        if not alive.size:
            break
        some = _Bent(*(part[alive] for part in bent))
        at = origin[alive] + (k * step) * direction[alive]
        uv, height = some.on_surface(at)
        inside = (height <= 0) & (height >= -deep) & (_within(weave, uv, height)[0] < 0)
        way[alive[inside]], hit[alive[inside]] = k * step, True
        alive = alive[~inside & (height <= 0) & (height >= -deep)]
    rows = np.flatnonzero(hit)
    some, low = _Bent(*(part[rows] for part in bent)), way[rows]
    high = low - step
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        uv, height = some.on_surface(origin[rows] + middle[:, None] * direction[rows])
        inside = _within(weave, uv, height)[0] < 0
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    way[rows] = high
    return way, hit


def _within(weave: Weave, uv: Floats, height: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Below 0 within a yarn, (b,), and whether the nearer one is of the warp."""
    found = [_yarn(weave, uv, height, warp) for warp in (True, False)]
    return np.minimum(*found), found[0] < found[1]


def _yarn(weave: Weave, uv: Floats, height: Floats, warp: bool) -> Floats:
    """(b,) below 0 within the nearest yarn of one set."""
    n, (u, v) = weave.yarns, uv.T
    beside, along = (u * n, v * n) if warp else (v * n, u * n)
    number = np.floor(beside)
    aside = (beside - number - 0.5) / (weave.width / 2)
    half = weave.height / 4
    up = (height * n + 2 * half - _lift(weave, along, number, warp)) / half
    return np.asarray(aside**2 + up**2 - 1)


def _lift(weave: Weave, along: Floats, number: Floats, warp: bool) -> Floats:
    """Height of a yarn's axis over the middle of the sheet, pitches."""
    rise, group = weave.height / 4, np.floor(number / weave.block)
    phase = np.sin(np.pi * along / weave.block) * np.where(group % 2, -1, 1)
    # Steeper than a sine, so that a yarn is all the way up over each that it crosses.
    wave = phase * np.sqrt(1.15 / (phase**2 + 0.15))
    return np.asarray(rise * wave * (1 if warp else -1))


def _surface(weave: Weave, bent: _Bent, point: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Unit normals and tangents along the yarn (b, 3), straight space, and which are warp."""
    step = 1e-4
    uv, height = bent.on_surface(point)
    _, warp = _within(weave, uv, height)
    slopes = []
    for axis in range(3):
        to, back = point.copy(), point.copy()
        to[:, axis] += step
        back[:, axis] -= step
        ends = []
        for at in (to, back):
            there, z = bent.on_surface(at)
            both = [_yarn(weave, there, z, kind) for kind in (True, False)]
            ends.append(np.where(warp, *both))
        slopes.append(ends[0] - ends[1])
    normal = np.stack(slopes, axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    # Along the yarn: its direction on the surface, without what points out of it.
    way = np.where(warp[:, None], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0])
    turned = np.arctan2(bent.bend * point[:, 0], 1 + bent.bend * point[:, 2])
    arc = np.where(np.abs(bent.bend) < 1e-9, 0, turned / np.where(bent.bend == 0, 1, bent.bend))
    tangent = bent.straight(arc, way)
    tangent -= normal * np.einsum("ij,ij->i", tangent, normal)[:, None]
    return normal, tangent / np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12), warp
