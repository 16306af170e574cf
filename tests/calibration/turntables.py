"""A small rig in numpy for the tests of calibration: its own projection, rendering and motions.

Nothing here comes from btfkit: distortion, rotations and the board's picture are written again
from their definitions, so that a shared mistake cannot pass.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

SQUARES, SQUARE, MARKER = (9, 7), 10.0, 7.0
WIDTH, HEIGHT = 1000, 750
# fx, fy, cx, cy, k1, k2, p1, p2, k3
TRUTH = np.array([1500.0, 1501.5, 505.3, 371.8, -0.12, 0.08, 4e-4, -3e-4, 0.0])


def project(points, truth=TRUTH):
    """(..., 2) pixels of points (..., 3) in the camera's frame."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = truth
    x, y = points[..., 0] / points[..., 2], points[..., 1] / points[..., 2]
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([fx * u + cx, fy * v + cy], -1)


def rays(pixels, truth=TRUTH):
    """(..., 3) rays of pixels, by fixed-point iteration."""
    goal = (pixels - truth[2:4]) / truth[:2]
    at = goal.copy()
    for _ in range(60):
        at = (
            at
            + goal
            - (project(np.concatenate([at, np.ones_like(at[..., :1])], -1), truth) - truth[2:4])
            / truth[:2]
        )
    return np.concatenate([at, np.ones_like(at[..., :1])], -1)


def turn(axis, point, angle):
    """4 x 4 rotation about a line."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(
        np.asarray(axis) / np.linalg.norm(axis) * angle
    ).as_matrix()
    matrix[:3, 3] = np.asarray(point) - matrix[:3, :3] @ np.asarray(point)
    return matrix


def look_down(distance):
    """4 x 4 from a frame with z up to a camera that looks down on it along -z, columns along x."""
    matrix = np.diag([1.0, -1.0, -1.0, 1.0])
    matrix[2, 3] = distance
    return matrix


def apply(matrix, points):
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def corners():
    """(48, 3) inner corners in the order of OpenCV, origin at the centre, y up."""
    columns, rows = SQUARES
    x = (np.arange(1, columns) - columns / 2) * SQUARE
    y = (rows / 2 - np.arange(1, rows)) * SQUARE
    return np.stack([*np.meshgrid(x, y), np.zeros((rows - 1, columns - 1))], -1).reshape(-1, 3)


def board_picture(pixels_a_square=40):
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    board = cv2.aruco.CharucoBoard(SQUARES, SQUARE, MARKER, dictionary)
    size = (SQUARES[0] * pixels_a_square, SQUARES[1] * pixels_a_square)
    return board.generateImage(size, marginSize=0) / 255.0


def board_frame(to_camera, rng, *, truth=TRUTH, blur=0.6, noise=0.004, fine=3, step=5):
    """A frame of the board (h, w), 0..1: pixels' areas integrated, blurred, then noise.

    Args:
        to_camera: 4 x 4 from board to camera.
        fine: samples a pixel each way. step: pixels between exact rays; cubic between.
    """
    coarse = np.stack(
        np.meshgrid(
            np.arange(-2 * step, WIDTH + 3 * step, step),
            np.arange(-2 * step, HEIGHT + 3 * step, step),
        ),
        -1,
    )
    ray = rays(coarse.astype(float), truth)
    normal, origin = to_camera[:3, 2], to_camera[:3, 3]
    place = ray * ((normal @ origin) / (ray @ normal))[..., None] - origin
    plane = (place @ to_camera[:3, :3])[..., :2]
    u = (np.arange(WIDTH * fine) + 0.5) / fine - 0.5
    v = (np.arange(HEIGHT * fine) + 0.5) / fine - 0.5
    down = CubicSpline(coarse[:, 0, 1], np.eye(len(coarse)))(v)
    along = CubicSpline(coarse[0, :, 0], np.eye(coarse.shape[1]))(u)
    x, y = (down @ plane[..., k] @ along.T for k in (0, 1))
    picture = board_picture()
    scale = picture.shape[1] / (SQUARES[0] * SQUARE)
    column = np.floor((x + SQUARES[0] * SQUARE / 2) * scale).astype(int)
    row = np.floor((SQUARES[1] * SQUARE / 2 - y) * scale).astype(int)
    inside = (column >= 0) & (column < picture.shape[1]) & (row >= 0) & (row < picture.shape[0])
    seen = np.where(
        inside,
        picture[np.clip(row, 0, picture.shape[0] - 1), np.clip(column, 0, picture.shape[1] - 1)],
        0.9,
    )
    image = seen.reshape(HEIGHT, fine, WIDTH, fine).mean((1, 3))
    return (
        0.05
        + 0.75 * ndimage.gaussian_filter(image, blur)
        + noise * rng.standard_normal(image.shape)
    )


class Turntable:
    """A sample on a turntable on a tilting cradle, a fixed camera, a light on an arm: misaligned.

    Readings in radians; `true` holds the axes (direction, point) as they are, `nominal` as drawn.
    """

    def __init__(self, rng, distance=260.0):
        self.nominal = {
            "tilt": (np.array([0.0, 1.0, 0.0]), np.zeros(3)),
            "turn": (np.array([0.0, 0.0, 1.0]), np.zeros(3)),
            "arm": (np.array([1.0, 0.0, 0.0]), np.zeros(3)),
        }
        self.true = {
            name: (axis + 0.01 * rng.standard_normal(3), point + 0.8 * rng.standard_normal(3))
            for name, (axis, point) in self.nominal.items()
        }
        # Rolled, so that no edge of the board runs along pixels, where few samples a pixel alias.
        off = turn(rng.standard_normal(3), np.zeros(3), 0.02) @ turn([0, 0, 1], np.zeros(3), 0.1)
        off[:3, 3] += rng.standard_normal(3)
        self.nominal_camera = look_down(distance)
        self.camera = off @ self.nominal_camera
        self.board = np.eye(4)

    def sample_to_camera(self, tilt, angle):
        moved = turn(*self.true["tilt"], tilt) @ turn(*self.true["turn"], angle)
        return self.camera @ moved

    def view_direction(self, tilt, angle):
        """(3,) unit vector from the sample's centre to the camera, sample frame."""
        centre = np.linalg.inv(self.sample_to_camera(tilt, angle))[:3, 3]
        return centre / np.linalg.norm(centre)

    def light_direction(self, light, tilt, angle, arm):
        """(3,) unit vector from the sample's centre to a light on the arm, sample frame."""
        at = apply(
            np.linalg.inv(turn(*self.true["tilt"], tilt) @ turn(*self.true["turn"], angle))
            @ turn(*self.true["arm"], arm),
            light,
        )
        return at / np.linalg.norm(at)


SPHERES, RADIUS, LIGHT = (
    np.array([[52.0, 0, 5], [-52, 8, 5], [5, 44, 5], [0, -44, 5]]),
    6.0,
    np.array([150.0, -60, 380]),
)


def sphere_outline(centre, radius, count, truth=TRUTH):
    """(count, 2) pixels of the circle in which the rays to the origin touch a sphere."""
    distance = np.linalg.norm(centre)
    along = centre / distance
    u = np.cross(along, [0.0, 1, 0])
    u /= np.linalg.norm(u)
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)[:, None]
    ring = radius * np.sqrt(1 - (radius / distance) ** 2)
    touch = centre - along * radius**2 / distance
    return project(touch + ring * (np.cos(angle) * u + np.sin(angle) * np.cross(along, u)), truth)


def sphere_highlight(centre, radius, light, truth=TRUTH):
    """(2,) pixel of a light in a mirror sphere: the shortest way from the light over it."""
    from scipy.optimize import minimize

    def normal(angles):
        a, b = angles
        return np.array([np.cos(a) * np.sin(b), np.sin(a) * np.sin(b), np.cos(b)])

    along, aside = -centre / np.linalg.norm(centre), light - centre
    half = along + aside / np.linalg.norm(aside)
    start = half / np.linalg.norm(half)
    first = np.array([np.arctan2(start[1], start[0]), np.arccos(start[2])])

    def way(angles):
        point = centre + radius * normal(angles)
        return np.linalg.norm(point) + np.linalg.norm(light - point)

    found = minimize(
        way, first, method="Nelder-Mead", options={"xatol": 1e-10, "fatol": 1e-13, "maxiter": 800}
    )
    return project(centre + radius * normal(found.x), truth)
