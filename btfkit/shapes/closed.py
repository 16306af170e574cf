"""Shapes in closed form: where a ray meets them, and the frame, uv and curvature there.

Object frame: right-handed, x right, y up, z towards a viewer at `view` 0,0. Every shape carries
tiles that stand upright on the side that faces this viewer, u to the right and v down.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]
# Roots closer than this to a ray's start are the surface it starts on; shapes are of size 1.
NEAR = 1e-6
# Of the stretch from a surface to a parallel one through a point, at least for a step.
_LEAST_AREA = 0.02


class Meeting(NamedTuple):
    """Where rays meet a shape.

    Attributes:
        distance: (m,) along the ray in its direction's lengths; inf where it misses.
        part: (m,) which part of the shape is met (a triangle of a mesh), 0 for one-part shapes.
    """

    distance: Floats
    part: NDArray[np.intp]


class Surface(NamedTuple):
    """A shape at points of its surface.

    Attributes:
        point: (m, 3) object frame.
        normal: (m, 3) unit, outwards; may be interpolated over the faces of a mesh.
        flat: (m, 3) unit normal of the very surface, outwards.
        uv: (m, 2) tiles. du, dv: (m, 3) step of the point a tile in u and in v.
        bend: (m, 3) second fundamental form xx, xy, yy along unit x = du and y = normal x du,
            in 1/length, positive convex.
        start: (m, 3) where rays towards lights start.
    """

    point: Floats
    normal: Floats
    flat: Floats
    uv: Floats
    du: Floats
    dv: Floats
    bend: Floats
    start: Floats


class Foot(NamedTuple):
    """The surface over points below it: where the normal there passes through them.

    Attributes:
        uv: (m, 2) tiles. depth: (m,) below it, lengths; not finite where none was found.
    """

    uv: Floats
    depth: Floats


class Shape(ABC):
    """A surface with tiles on it.

    Attributes:
        half_height: of a square picture that shows it whole from everywhere; of a plane, that it
            fills from the front.
        tile: width of a tile where it is not distorted; curvature counts in it.
        convex: whether no point of its outside shadows another.
    """

    half_height: float
    tile: float
    convex: ClassVar[bool] = True

    @abstractmethod
    def meet(self, origin: Floats, direction: Floats, beyond: Floats) -> Meeting:
        """First meeting of each ray that is farther than `beyond` (m,).

        Args:
            origin, direction: (m, 3) object frame; directions are of length 1.
        """

    def blocks(self, origin: Floats, direction: Floats, beyond: Floats) -> NDArray[np.bool_]:
        """Whether each ray meets the shape farther than `beyond` (m,)."""
        return np.isfinite(self.meet(origin, direction, beyond).distance)

    @abstractmethod
    def surface(self, origin: Floats, direction: Floats, met: Meeting) -> Surface:
        """The surface where rays meet it; every distance is finite."""

    def foot(self, point: Floats, up: Floats) -> Foot:
        """The surface over points (m, 3), sought from directions up (m, 3), of length 1.

        A ray upwards meets the surface near the foot, and how it bends there tells where the
        normal passes through the point: once of Newton's steps.
        """
        for last in (False, True):
            met = self.meet(point, up, np.zeros(len(point)))
            ended = Meeting(np.where(np.isfinite(met.distance), met.distance, 0.0), met.part)
            found = self.surface(point, up, ended)
            if not last:
                up = _towards_foot(found, up, ended.distance)
        return Foot(found.uv, met.distance)


def _towards_foot(found: Surface, up: Floats, depth: Floats) -> Floats:
    """Unit directions (m, 3) towards the foot of points `depth` (m,) below what is found.

    Off the foot by e the normal is off by B e and the ray by e / depth, B being the second
    fundamental form: of the two the difference tells e.
    """
    x = found.du / np.maximum(np.linalg.norm(found.du, axis=1, keepdims=True), 1e-30)
    x = x - found.normal * np.einsum("ij,ij->i", x, found.normal)[:, None]
    x /= np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-30)
    y = np.cross(found.normal, x)
    gap = found.normal - up
    a, b = np.einsum("ij,ij->i", gap, x), np.einsum("ij,ij->i", gap, y)
    xx, xy, yy = (
        1 - depth * found.bend[:, 0],
        -depth * found.bend[:, 1],
        1 - depth * found.bend[:, 2],
    )
    area = xx * yy - xy**2
    # Below the axis of curvature there is no foot.
    known = (area > _LEAST_AREA) & (xx > 0)
    area = np.where(known, area, 1.0)
    a, b = (yy * a - xy * b) / area, (xx * b - xy * a) / area
    moved = up + np.where(known[:, None], a[:, None] * x + b[:, None] * y, 0)
    return np.asarray(moved / np.maximum(np.linalg.norm(moved, axis=1, keepdims=True), 1e-30))


@final
class Plane(Shape):
    """The rectangle z = 0 that fills the picture at view 0,0, `repeat` tiles across.

    Args:
        repeat: tiles across. aspect: tile width / tile height.
        picture: width / height of the picture.
    """

    def __init__(self, *, repeat: int = 1, aspect: float = 1.0, picture: float = 1.0) -> None:
        self.half_height = 1.0
        self._half = np.array([picture, 1.0])
        self.tile = 2 * picture / repeat
        self._tile_height = self.tile / aspect

    def meet(self, origin: Floats, direction: Floats, beyond: Floats) -> Meeting:
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = -origin[:, 2] / direction[:, 2]
            at = origin[:, :2] + distance[:, None] * direction[:, :2]
            inside = (np.abs(at) <= self._half).all(axis=1) & (distance > beyond)
        return met_once(np.where(inside & np.isfinite(distance), distance, np.inf))

    def surface(self, origin: Floats, direction: Floats, met: Meeting) -> Surface:
        point = origin + met.distance[:, None] * direction
        right, down = point[:, 0] + self._half[0], self._half[1] - point[:, 1]
        uv = np.stack([right / self.tile, down / self._tile_height], axis=1)
        return exact(
            point,
            alike([0.0, 0.0, 1.0], len(point)),
            uv,
            alike([self.tile, 0.0, 0.0], len(point)),
            alike([0.0, -self._tile_height, 0.0], len(point)),
            np.zeros((len(point), 3)),
        )


@final
class Sphere(Shape):
    """The unit sphere, poles on the y axis; `repeat` tiles over the front half, 2 `repeat` around.

    Tiles keep their proportions on the equator and shrink towards the poles. Its radius is
    repeat / pi tile widths.
    """

    def __init__(self, *, repeat: int = 1, aspect: float = 1.0) -> None:
        self.half_height = 1.04
        self.tile = np.pi / repeat
        self._aspect = aspect

    def meet(self, origin: Floats, direction: Floats, beyond: Floats) -> Meeting:
        along = np.einsum("ij,ij->i", origin, direction)
        return met_once(
            nearest(_roots(1.0, along, np.einsum("ij,ij->i", origin, origin) - 1), beyond)
        )

    def surface(self, origin: Floats, direction: Floats, met: Meeting) -> Surface:
        point = origin + met.distance[:, None] * direction
        normal = point / np.linalg.norm(point, axis=1, keepdims=True)
        x, y, z = normal.T
        round_y = np.arctan2(x, z)
        radius = np.hypot(x, z)
        polar = np.arctan2(radius, y)
        # On the very pole any tangent will do: the one at azimuth 0.
        east = np.stack([np.cos(round_y), 0 * x, -np.sin(round_y)], axis=1)
        south = np.cross(east, normal)
        uv = np.stack([0.5 + round_y / np.pi, polar / np.pi], axis=1) * (np.pi / self.tile)
        uv[:, 1] *= self._aspect
        du = east * np.maximum(radius, NEAR)[:, None] * self.tile
        return exact(
            normal, normal, uv, du, south * (self.tile / self._aspect),
            alike([1.0, 0.0, 1.0], len(point)),
        )  # fmt: skip

    def foot(self, point: Floats, up: Floats) -> Foot:
        away = np.linalg.norm(point, axis=1)
        return Foot(self.surface(point, up, met_once(np.zeros(len(point)))).uv, 1 - away)


@final
class Cylinder(Shape):
    """An open tube of radius 1 about the y axis; its front half shows `repeat` x `repeat` tiles."""

    def __init__(self, *, repeat: int = 1, aspect: float = 1.0) -> None:
        self.tile = np.pi / repeat
        self._tile_height = self.tile / aspect
        self._half = np.pi / aspect / 2
        self.half_height = 1.04 * float(np.hypot(1.0, self._half))

    def meet(self, origin: Floats, direction: Floats, beyond: Floats) -> Meeting:
        flat, way = origin[:, ::2], direction[:, ::2]
        square = np.einsum("ij,ij->i", way, way)
        along = np.einsum("ij,ij->i", flat, way)
        roots = _roots(square, along, np.einsum("ij,ij->i", flat, flat) - 1)
        with np.errstate(invalid="ignore"):
            height = origin[:, 1:2] + roots * direction[:, 1:2]
            roots = np.where(np.abs(height) <= self._half, roots, np.inf)
        return met_once(nearest(roots, beyond))

    def surface(self, origin: Floats, direction: Floats, met: Meeting) -> Surface:
        point = origin + met.distance[:, None] * direction
        round_y = np.arctan2(point[:, 0], point[:, 2])
        sin, cos = np.sin(round_y), np.cos(round_y)
        normal = np.stack([sin, 0 * sin, cos], axis=1)
        uv = np.stack(
            [(np.pi / 2 + round_y) / self.tile, (self._half - point[:, 1]) / self._tile_height],
            axis=1,
        )
        du = np.stack([cos, 0 * sin, -sin], axis=1) * self.tile
        dv = alike([0.0, -self._tile_height, 0.0], len(point))
        return exact(point, normal, uv, du, dv, alike([1.0, 0.0, 0.0], len(point)))

    def foot(self, point: Floats, up: Floats) -> Foot:
        away = np.hypot(point[:, 0], point[:, 2])
        return Foot(self.surface(point, up, met_once(np.zeros(len(point)))).uv, 1 - away)


def met_once(distance: Floats) -> Meeting:
    """The meeting with a shape of one part."""
    return Meeting(distance, np.zeros(len(distance), np.intp))


def exact(
    point: Floats, normal: Floats, uv: Floats, du: Floats, dv: Floats, bend: Floats
) -> Surface:
    """A surface whose normals are its own."""
    return Surface(point, normal, normal, uv, du, dv, bend, point)


def alike(vector: list[float], count: int) -> Floats:
    """One vector for `count` rows."""
    return np.broadcast_to(np.array(vector), (count, len(vector)))


def _roots(square: Floats | float, half_linear: Floats, constant: Floats) -> Floats:
    """(m, 2) real roots of square t² + 2 half_linear t + constant; inf where there is none."""
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.sqrt(half_linear**2 - square * constant)
        # The sum without cancellation; the other root from the product of both.
        far = -half_linear - np.copysign(root, half_linear)
        roots = np.stack([far / square, constant / far], axis=1)
    return np.where(np.isfinite(roots), roots, np.inf)


def nearest(roots: Floats, beyond: Floats) -> Floats:
    """(m,) least of the roots (m, k) that are beyond; inf where none is."""
    return np.where(roots > beyond[:, None], roots, np.inf).min(axis=1)
