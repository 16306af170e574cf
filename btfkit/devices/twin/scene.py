"""What the twin's sensor would see without noise: sample, plate and spheres under the lamp."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, final

import cv2
import numpy as np
from numpy.typing import NDArray

from btfkit.devices.poses import Floats
from btfkit.devices.twin import layout
from btfkit.devices.twin.geometry import Placed, Truth
from btfkit.devices.twin.holder import Plate
from btfkit.devices.twin.imperfections import Imperfections
from btfkit.devices.twin.lens import Lens
from btfkit.devices.twin.spheres import Spheres
from btfkit.native import trace as kernel
from btfkit.relief.relief import Relief
from btfkit.relief.trace import geometry

Image = NDArray[np.float32]
# Rays a side of a pixel, by default.
GRID = 2
# Places a side of each ray's part of a pixel at which plate and sample are looked at: borders and
# threads are finer.
_FINER = 2
# Shading of the plate is smooth: it is worked out every fourth pixel or so, and read between.
_SHADING = 2.0 / 640
_DARKEST_COSINE = 1e-3
_DRAWING, _FINEST = 0.75, 16.0


@final
class Scene:
    """The holder with its sample, as light meets it.

    Args:
        relief: of the sample; its tile is 36 mm wide.
        nominal: description of the rig. truth: how it really is.
        imperfections: what is on. grid: rays a side of a pixel.
    """

    def __init__(
        self,
        relief: Relief,
        nominal: dict[str, Any],
        truth: Truth,
        imperfections: Imperfections,
        *,
        grid: int = GRID,
    ) -> None:
        sensor = nominal["sensor"]
        size = (int(sensor["height"]), int(sensor["width"]))
        self.lens = Lens(truth, size, grid, imperfections)
        self._grid = grid
        self._truth = truth
        self._relief = geometry(relief)
        self._size_mm = (layout.SAMPLE_MM, layout.SAMPLE_MM / relief.aspect)
        # A little coarser than what reads it, so that no part of a border is missed.
        fine = min(_DRAWING * grid * _FINER * size[1] / layout.SEEN_MM, _FINEST)
        self._plate = Plate(nominal["target"], truth, fine)
        self._spheres = Spheres(truth.spheres)
        self._lamp_mm = imperfections.of("lamp-size", layout.LAMP_RADIUS_MM)
        self._white = layout.WHITE_ANGULAR
        self._per_mm = _SHADING * size[1]

    def image(self, placed: Placed) -> Image:
        """(h, w, 3) linear sRGB, pi x radiance for irradiance 1 at the origin, through the lens."""
        lens = self.lens
        flat = self._plane(placed, np.eye(3), np.zeros(3))
        board = self._truth.board
        plate_xy = self._plane(placed, board.turn, board.shift)
        shading = self._shading(placed)
        fine = self._on_plate(plate_xy, shading, around=_FINER)
        self._add_sample(fine, flat, placed)
        for rows, cols, hit, ray in self._spheres.seen(lens, placed, self._grid):
            if not hit.any():
                continue
            fine[rows, cols][hit] = self._mirrored(ray[hit], shading)
        image = cv2.resize(fine, lens.size[::-1], interpolation=cv2.INTER_AREA)
        image += self._spheres.highlights(lens, placed, 1.0, self._lamp_mm)[..., None]
        depth = self._depth(flat, placed)
        focus = float(placed.rotation[2] @ -placed.camera)
        return lens.dimmed(lens.blurred(image, depth, focus))

    def _plane(self, placed: Placed, turn: Floats, shift: Floats) -> Image:
        """(H, W, 2) x and y in its own frame at which each ray meets a plane."""
        # In the plane's frame; rows of `to` take a ray (x, y, 1) there.
        to = placed.rotation @ turn
        eye = (placed.camera - shift) @ turn
        # x = eye_x - eye_z d_x / d_z and so for y: a homography of the ray.
        matrix = np.stack(
            [eye[0] * to[:, 2] - eye[2] * to[:, 0], eye[1] * to[:, 2] - eye[2] * to[:, 1], to[:, 2]]
        )
        rays = self.lens.rays.reshape(1, -1, 2)
        points = cv2.perspectiveTransform(rays, matrix)
        return np.asarray(points, np.float32).reshape(self.lens.rays.shape)

    def _shading(self, placed: Placed) -> Image:
        """(h, w, 2) over the plate: pi x radiance of a white Lambertian surface, and of the white
        reference of reflectance 1.
        """
        width, height = self._plate.size_mm
        w, h = round(width * self._per_mm), round(height * self._per_mm)
        x = (np.arange(w) + 0.5) / self._per_mm - width / 2
        y = height / 2 - (np.arange(h) + 0.5) / self._per_mm
        points = np.stack([*np.meshgrid(x, y), np.zeros((h, w))], axis=-1)
        points = self._truth.board.of(points).astype(np.float32)
        up = self._truth.board.turn[:, 2].astype(np.float32)
        to_lamp, to_camera = (
            np.asarray(at - points, np.float32) for at in (placed.lamp, placed.camera)
        )
        distance2 = (to_lamp * to_lamp).sum(-1)
        cosine_l = np.maximum(to_lamp @ up / np.sqrt(distance2), 0)
        cosine_v = np.maximum(to_camera @ up / np.linalg.norm(to_camera, axis=-1), 0)
        lit = cosine_l * np.float32(layout.LAMP_MM**2) / distance2
        lit[self._spheres.shaded(points, placed.lamp)] = 0
        a, b, c = self._white
        angular = a + b * (cosine_l + cosine_v) + c * cosine_l * cosine_v
        return np.stack([lit, lit * angular], axis=-1).astype(np.float32)

    def _on_plate(self, where: Image, shading: Image, *, around: int = 1) -> Image:
        """(H, W, 3) pi x radiance of the plate at (H, W, 2) x and y, of `around`^2 places each."""
        width, height = self._plate.size_mm
        col = (where[..., 0] + np.float32(width / 2)) * np.float32(self._per_mm) - np.float32(0.5)
        row = (np.float32(height / 2) - where[..., 1]) * np.float32(self._per_mm) - np.float32(0.5)
        lit = cv2.remap(shading, col, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        if around == 1:
            drawn = self._plate.at(where)
        else:
            drawn = np.zeros((*where.shape[:2], 4), np.float32)
            for step in _parts(where, around):
                drawn += self._plate.at(where + step)
            drawn /= around**2
        light = lit[..., 0] + drawn[..., 3] * (lit[..., 1] - lit[..., 0])
        return np.asarray(drawn[..., :3] * light[..., None])

    def _mirrored(self, ray: Image, shading: Image) -> Image:
        """(b, 3) what spheres show: the plate where the ray goes down, else a dark room."""
        at, to = ray[:, :3], ray[:, 3:]
        down = to[:, 2] < -_DARKEST_COSINE
        step = np.where(down, -at[:, 2] / np.where(down, to[:, 2], -1), 0)
        where = (at + step[:, None] * to)[:, :2]
        # Lines of a kilo-ray: OpenCV's images end at 32767 columns.
        lines = np.resize(where, (-(-len(where) // 1024), 1024, 2))
        seen = self._on_plate(lines.astype(np.float32), shading).reshape(-1, 3)[: len(where)]
        return np.where(down[:, None], 0.9 * seen, 0).astype(np.float32)

    def _add_sample(self, fine: Image, where: Image, placed: Placed) -> None:
        """Trace the rays that meet the sample."""
        half = np.array([self._size_mm[0] / 2, self._size_mm[1] / 2], np.float32)
        inside = np.asarray((np.abs(where) < half).all(-1))
        if not inside.any():
            return
        lamp = self._lamp_points(placed, inside)
        total = np.zeros((int(inside.sum()), 3), np.float32)
        for step in _parts(where, _FINER):
            xy = np.clip((where + step)[inside], -half, half)
            total += self._traced(xy, lamp, placed)
        fine[inside] = total / _FINER**2

    def _traced(self, xy: Image, lamp: Image, placed: Placed) -> Image:
        """(b, 3) pi x radiance of the sample at (b, 2) mm under (b, 3) points of the lamp."""
        half = np.array([self._size_mm[0] / 2, self._size_mm[1] / 2], np.float32)
        points = np.column_stack([xy, np.zeros(len(xy), np.float32)])
        to_lamp = lamp - points
        to_camera = placed.camera.astype(np.float32) - points
        distance2 = (to_lamp * to_lamp).sum(-1)
        light = to_lamp / np.sqrt(distance2)[:, None]
        view = to_camera / np.linalg.norm(to_camera, axis=-1, keepdims=True)
        h, w = self._relief.height.shape
        place = (xy / (2 * half) * np.array([1, -1], np.float32) + np.float32(0.5)) * np.array(
            [w, h], np.float32
        )
        traced = kernel.trace(
            self._relief, place - np.float32(0.5), light, view,
            np.zeros(len(xy), np.float32), samples=1,
        )  # fmt: skip
        irradiance = np.float32(layout.LAMP_MM**2) / distance2
        # Below its horizon the sample's plane hides the lamp.
        irradiance = np.where(light[:, 2] > 0, irradiance, 0)
        return np.asarray(traced.rgb * irradiance[:, None])

    def _lamp_points(self, placed: Placed, inside: NDArray[np.bool_]) -> Image:
        """A point of the lamp's disc for each ray: the rays of a pixel share the disc out."""
        grid = self._grid
        number = np.arange(grid * grid)
        # A sunflower: equal areas.
        radius = self._lamp_mm * np.sqrt((number + 0.5) / grid**2)
        angle = number * np.pi * (3 - np.sqrt(5))
        disc = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], -1)
        points = (placed.lamp + disc @ placed.lamp_turn.T).astype(np.float32)
        rows, cols = np.nonzero(inside)
        return np.asarray(points[(rows % grid) * grid + cols % grid])

    def _depth(self, where: Image, placed: Placed) -> Image:
        """(h, w) distance along the optical axis of the plane z = 0, mm."""
        grid = self._grid
        middle = where[grid // 2 :: grid, grid // 2 :: grid]
        points = middle @ placed.rotation[2, :2].astype(np.float32)
        return np.asarray(points - np.float32(placed.rotation[2] @ placed.camera), np.float32)


def _parts(where: Image, around: int) -> Iterator[Image]:
    """(H, W, 2) ways from each ray's place to the middles of the parts of its share of a pixel."""
    # A ray's neighbour tells how the plane runs; half a ray on it runs alike.
    down, across = np.empty_like(where), np.empty_like(where)
    np.subtract(where[1:], where[:-1], out=down[:-1])
    np.subtract(where[:, 1:], where[:, :-1], out=across[:, :-1])
    down[-1], across[:, -1] = down[-2], across[:, -2]
    steps = (np.arange(around, dtype=np.float32) + np.float32(0.5)) / around - np.float32(0.5)
    for row in steps:
        for col in steps:
            yield row * down + col * across
