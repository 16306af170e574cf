"""Photographs of mirror balls, made by tracing rays: no code is shared with the calibration."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from skimage import data
from skimage.transform import resize


@functools.cache
def gravel(shape):
    """A photograph of gravel, 0..1, in any size."""
    return resize(data.gravel(), shape)


@dataclass(frozen=True)
class Scene:
    """Balls on a table z = 0 under a camera on the z axis that looks straight down.

    Attributes:
        balls: ((x, y), radius) in mm. width, height: pixels. mm_per_px: on the table.
        camera_mm: height of the camera, None for parallel rays.
        lamp_mm: radius of the round lamp.
    """

    balls: tuple[tuple[tuple[float, float], float], ...]
    width: int = 640
    height: int = 480
    mm_per_px: float = 0.25
    camera_mm: float | None = None
    lamp_mm: float = 12.0
    noise: float = 0.004

    def focal_px(self):
        return None if self.camera_mm is None else self.camera_mm / self.mm_per_px

    def photograph(self, lamp, seed=0, finest=4):
        """(h, w) linear 0..1 under a lamp at (3,) mm; balls are traced at finer rays."""
        rows, cols = np.mgrid[: self.height, : self.width].astype(float)
        paper = 0.25 + 0.35 * gravel((self.height, self.width))
        out = paper * self._lambert(self._table(cols, rows), lamp)
        inner = (np.arange(finest) + 0.5) / finest - 0.5
        for (x, y), r in self.balls:
            scale = 1 if self.camera_mm is None else self.camera_mm / (self.camera_mm - 2 * r)
            middle = [
                (self.width - 1) / 2 + x / self.mm_per_px * scale,
                (self.height - 1) / 2 - y / self.mm_per_px * scale,
            ]
            reach = 1.3 * r / self.mm_per_px * scale
            left, right = int(max(middle[0] - reach, 0)), int(middle[0] + reach)
            top, bottom = int(max(middle[1] - reach, 0)), int(middle[1] + reach)
            at = (slice(top, bottom), slice(left, right))
            c = (cols[at][..., None, None] + inner).repeat(finest, axis=2)
            w = (rows[at][..., None, None] + inner[:, None]).repeat(finest, axis=3)
            seen, hit = self._ball(c, w, ((x, y), r), lamp)
            share = hit.mean((2, 3))
            out[at] = (1 - share) * out[at] + np.where(hit, seen, 0).mean((2, 3))
        out = out + np.random.default_rng(seed).normal(0, self.noise, out.shape)
        return np.clip(out, 0, 1)

    def _table(self, cols, rows):
        x = (cols - (self.width - 1) / 2) * self.mm_per_px
        y = ((self.height - 1) / 2 - rows) * self.mm_per_px
        return np.stack([x, y, np.zeros_like(x)], axis=-1)

    def _ball(self, cols, rows, ball, lamp):
        """What rays see in one ball, and whether they meet it."""
        (bx, by), r = ball
        table = self._table(cols, rows)
        if self.camera_mm is None:
            eye, ray = table + [0, 0, 1000.0], np.broadcast_to([0, 0, -1.0], table.shape)
        else:
            eye = np.broadcast_to([0, 0, self.camera_mm], table.shape)
            ray = (table - eye) / np.linalg.norm(table - eye, axis=-1, keepdims=True)
        to = eye - [bx, by, r]
        along = np.sum(to * ray, -1)
        inside = along**2 - np.sum(to**2, -1) + r**2
        hit = inside > 0
        point = eye + (-along - np.sqrt(np.where(hit, inside, 0)))[..., None] * ray
        normal = (point - [bx, by, r]) / r
        mirror = ray - 2 * np.sum(ray * normal, -1, keepdims=True) * normal
        off = lamp - point
        far = np.linalg.norm(off, axis=-1)
        angle = np.arccos(np.clip(np.sum(mirror * off, -1) / far, -1, 1))
        spot = np.clip((self.lamp_mm / far - angle) / 0.004 + 0.5, 0, 1)
        room = 0.03 + 0.04 * np.clip(mirror[..., 2], 0, 1) * (mirror[..., 0] > 0.2)
        # Below the horizon the ball shows the table.
        return np.where(mirror[..., 2] < 0, 0.12, room) + 3 * spot, hit

    @staticmethod
    def _lambert(table, lamp):
        off = lamp - table
        square = np.sum(off**2, -1)
        return off[..., 2] / np.sqrt(square) * (300.0**2) / square


def dome(count, radius=400.0, lowest=20.0, seed=0):
    """(n, 3) lamps on a dome, mm."""
    golden = np.pi * (3 - np.sqrt(5))
    z = np.linspace(1, np.sin(np.radians(lowest)), count)
    phi = golden * np.arange(count) + seed
    s = np.sqrt(1 - z**2)
    return radius * np.stack([s * np.cos(phi), s * np.sin(phi), z], axis=-1)
