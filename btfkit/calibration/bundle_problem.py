"""Residuals of a rig's geometry and their exact derivatives, as a sparse least-squares problem."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, final

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from btfkit.calibration.camera_model import PARAMETERS, Camera
from btfkit.calibration.geometry import Geometry
from btfkit.calibration.kinematics import (
    Axis,
    Rigid,
    left_jacobian,
    perpendicular,
    reading_of,
    rotation_of,
    skew,
)
from btfkit.calibration.mirrors import highlight, highlight_derivatives, outline_residuals

Floats = NDArray[np.float64]
Index = NDArray[np.intp]
# Expected noise of an observation, px: relative weights of the kinds.
_SD_PX = {"corner": 0.02, "outline": 0.15, "highlight": 0.02}
# How far the noise of a kind may be from what was expected. Highlights are few for what they tell:
# what they leave is less than their noise.
_NOISE = {"corner": (0.1, 5.0), "outline": (0.5, 5.0), "highlight": (0.5, 5.0)}
# Of a corner that was fitted to a frame, however little the fit leaves.
_LEAST_PX = 0.002
# What is assumed beforehand of each kind of parameter: the scale of the solver, and what the
# frames must tell better to be asked at all.
_SCALE_PX = {"fx": 0.05, "fy": 0.05, "cx": 0.05, "cy": 0.05}
# Of distortions, by what they do in the corner of the frame, as shares of the way to it.
_SCALE_LENS = {"k1": 0.02, "k2": 0.02, "p1": 0.005, "p2": 0.005, "k3": 1e-3}
_POWER_LENS = {"k1": 2, "k2": 4, "p1": 1, "p2": 1, "k3": 6}
_SCALE_TURN, _SCALE_MM, _SCALE_LIGHT_MM = 0.05, 5.0, 50.0
# How good a drawing of a rig is: what frames hardly tell stays near it. The camera and what lies
# on the holder are told by every frame.
_DRAWN = {"turn": 0.02, "mm": 2.0, "light": 20.0}
_LENS_GIVES_UP, _BOARD_GIVES_UP = 10.0, 100.0


@final
@dataclass(frozen=True, eq=False)
class Sighting:
    """Known points seen in one frame.

    Attributes:
        name: of the frame, for messages.
        readings: of the axes, radians or mm.
        points_mm: (m, 3) in the frame that `on` names. pixels: (m, 2).
        sd_px: (m, 2) their standard deviations; None where nothing tells.
    """

    name: str
    readings: Mapping[str, float]
    points_mm: Floats
    pixels: Floats
    on: Literal["board", "sample"] = "board"
    sd_px: Floats | None = None


@final
@dataclass(frozen=True, eq=False)
class SphereSighting:
    """One mirror sphere seen in one frame.

    Attributes:
        name: of the frame. readings: of the axes.
        sphere: number of the sphere in the geometry.
        outline: (m, 2) pixels on its outline; may be empty.
        highlights: pixel (2,) of each light that it mirrors, by the light's name.
    """

    name: str
    readings: Mapping[str, float]
    sphere: int
    outline: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    highlights: Mapping[str, Floats] = field(default_factory=dict)


@final
@dataclass(frozen=True, eq=False)
class _Moved:
    """Points in the camera's frame: (n, 3), derivatives by shared (n, 3, s) and slip (n, 3, a)."""

    points: Floats
    shared: Floats
    slip: Floats


class Problem:
    """Parameters are offsets from the start; residuals are in expected standard deviations.

    Attributes:
        names, scale: of the parameters: lens, camera pose, axes, board, spheres, lights, slips.
        told: how many residuals come from frames and readings; those after them, to `count`, say
            how near to its drawing a rig is.
        give_up: how willingly a parameter is held where frames do not tell it from others.
    """

    def __init__(
        self,
        start: Geometry,
        sightings: Sequence[Sighting],
        spheres: Sequence[SphereSighting],
        *,
        slip_sd: Mapping[str, float],
    ) -> None:
        self.start = start
        self._sightings, self._spheres = tuple(sightings), tuple(spheres)
        self.names_of_sightings = [sighting.name for sighting in sightings]
        self.axis_names = [axis.name for axis in start.kinematics.axes]
        self._slip_sd = np.array([slip_sd.get(name, 0.0) for name in self.axis_names])
        every: list[Sighting | SphereSighting] = [*sightings, *spheres]
        self._frames = [entry.name for entry in every]
        self._readings = np.array([self._row(entry.readings) for entry in every])
        self._parameters()
        self._observations()

    @property
    def size(self) -> int:
        return len(self.names)

    def rows(self, kind: str) -> Index:
        """Residuals of one kind of observation."""
        return self._rows[kind]

    @staticmethod
    def width(kind: str) -> int:
        """Residuals that one observation has."""
        return 1 if kind == "outline" else 2

    def sd_px(self, kind: str) -> Floats:
        """Expected standard deviation of each residual of a kind, px."""
        expected = (
            self._corner_sd.reshape(-1)
            if kind == "corner"
            else np.full(len(self._rows[kind]), _SD_PX[kind])
        )
        return self._noise[kind] * expected

    def reweigh(self, residual: Floats, use: NDArray[np.bool_]) -> None:
        """Expect of each kind of observation what its residuals are, within a factor of some."""
        for kind, rows in self._rows.items():
            mine = residual[rows[use[rows]]]
            if len(mine):
                noise = self._noise[kind] * float(np.sqrt((mine**2).mean()))
                self._noise[kind] = float(np.clip(noise, *_NOISE[kind]))

    def by_sighting(self, residual: Floats, of: Callable[[Floats], Any]) -> Floats:
        """(v,) a figure of the distances in each sighting, px."""
        pairs = (residual[self._rows["corner"]] * self.sd_px("corner")).reshape(-1, 2)
        distance = np.linalg.norm(pairs, axis=1)
        views = range(len(self._sightings))
        return np.array([float(of(distance[self._view == v])) for v in views])

    def slips(self, x: Floats) -> Floats:
        """(v, a) corrections of readings."""
        out = np.zeros_like(self._readings)
        out[:, self._slip_sd > 0] = x[self._shared :].reshape(len(out), -1)
        return out

    def geometry(self, x: Floats) -> Geometry:
        """The geometry at an offset."""
        start = self.start
        camera = start.camera.parameters + x[self._at["lens"]]
        axes = [self._axis(axis, x) for axis in start.kinematics.axes]
        lights = {
            name: np.asarray(at, float) + x[self._at[f"light.{name}"]]
            for name, at in start.lights_mm.items()
        }
        return replace(
            start,
            camera=Camera(start.camera.width, start.camera.height, camera),
            camera_pose=_offset(start.camera_pose, x[self._at["camera_pose"]]),
            kinematics=start.kinematics.with_axes(axes),
            board=_offset(start.board, x[self._at["board"]]),
            spheres_mm=start.spheres_mm + x[self._at["spheres"]].reshape(-1, 3),
            lights_mm=lights,
        )

    def evaluate(self, x: Floats) -> tuple[Floats, sparse.csr_array]:
        """Residuals (m,) and their derivatives (m, p)."""
        geometry = self.geometry(x)
        parts = [self._corners(geometry, x)]
        if self._spheres:
            parts += self._mirrored(geometry, x)
        residuals = [part[0] for part in parts]
        jacobians = [self._sparse(*part[1:]) for part in parts]
        free = self.size - self._shared
        if free:
            weight = 1 / self.scale[self._shared :]
            residuals.append(x[self._shared :] * weight)
            jacobians.append(
                sparse.csr_array(
                    (weight, (np.arange(free), self._shared + np.arange(free))),
                    shape=(free, self.size),
                )
            )
        if len(self._drawn):
            rows = np.arange(len(self._drawn))
            residuals.append(x[self._drawn] / self._drawn_sd)
            jacobians.append(
                sparse.csr_array(
                    (1 / self._drawn_sd, (rows, self._drawn)), shape=(len(rows), self.size)
                )
            )
        return np.concatenate(residuals), sparse.csr_array(sparse.vstack(jacobians))

    def _row(self, readings: Mapping[str, float]) -> list[float]:
        return [reading_of(readings, name) for name in self.axis_names]

    def _parameters(self) -> None:
        start = self.start
        names: list[str] = []
        scales: list[float] = []
        gives: list[float] = []
        self._at: dict[str, slice] = {}

        def block(key: str, entries: Sequence[tuple[str, float]], give: float = 1.0) -> None:
            self._at[key] = slice(len(names), len(names) + len(entries))
            names.extend(name for name, _ in entries)
            scales.extend(scale for _, scale in entries)
            gives.extend([give] * len(entries))

        camera = start.camera
        focal = camera.parameters[0]
        corner = np.hypot(camera.width, camera.height) / 2 / focal
        lens = {name: part * focal for name, part in _SCALE_PX.items()}
        lens |= {name: part / corner ** _POWER_LENS[name] for name, part in _SCALE_LENS.items()}
        block("lens", [(f"camera.{name}", lens[name]) for name in PARAMETERS], _LENS_GIVES_UP)
        block("camera_pose", _pose_names("camera_pose"))
        for axis in start.kinematics.axes:
            entries = [(f"axis.{axis.name}.direction.{i}", _SCALE_TURN) for i in (0, 1)]
            if axis.kind == "rotary":
                entries += [(f"axis.{axis.name}.point.{i}", _SCALE_MM) for i in (0, 1)]
            block(f"axis.{axis.name}", entries)
        block("board", _pose_names("board_to_sample"), _BOARD_GIVES_UP)
        count = len(start.spheres_mm)
        block("spheres", [(f"sphere.{s}.{k}", _SCALE_MM) for s in range(count) for k in "xyz"])
        for name in start.lights_mm:
            block(f"light.{name}", [(f"light.{name}.{k}", _SCALE_LIGHT_MM) for k in "xyz"])
        self._shared = len(names)
        slips = [
            (name, sd)
            for name, sd in zip(self.axis_names, self._slip_sd.tolist(), strict=True)
            if sd > 0
        ]
        block("slips", [(f"slip.{f}.{name}", sd) for f in self._frames for name, sd in slips])
        self.names, self.scale, self.give_up = tuple(names), np.array(scales), np.array(gives)

    def _observations(self) -> None:
        self._view = np.repeat(
            np.arange(len(self._sightings)), [len(s.points_mm) for s in self._sightings]
        )
        self._points = np.concatenate([s.points_mm for s in self._sightings])
        self._pixels = np.concatenate([s.pixels for s in self._sightings])
        self._noise = dict.fromkeys(_SD_PX, 1.0)
        self._corner_sd = np.concatenate(
            [
                np.full((len(s.pixels), 2), _SD_PX["corner"])
                if s.sd_px is None
                else np.maximum(s.sd_px, _LEAST_PX)
                for s in self._sightings
            ]
        )
        self._on_board = np.array([s.on == "board" for s in self._sightings])[self._view]
        first = len(self._sightings)
        self._outline_of = np.repeat(
            np.arange(len(self._spheres)), [len(s.outline) for s in self._spheres]
        ).astype(np.intp)
        self._shown = [
            (k, name, at) for k, s in enumerate(self._spheres) for name, at in s.highlights.items()
        ]
        self._sphere_view = first + np.arange(len(self._spheres))
        counts = {"corner": 2 * len(self._points)}
        counts["outline"] = len(self._outline_of)
        counts["highlight"] = 2 * len(self._shown)
        ends = np.cumsum([0, *counts.values()])
        self._rows = {
            kind: np.arange(a, b) for kind, a, b in zip(counts, ends[:-1], ends[1:], strict=True)
        }
        self.told = int(ends[-1]) + self.size - self._shared
        drawn = [
            (
                i,
                _DRAWN[
                    "light" if name.startswith("light") else "turn" if "direction" in name else "mm"
                ],
            )
            for i, name in enumerate(self.names)
            if name.startswith(("axis.", "light."))
        ]
        self._drawn = np.array([i for i, _ in drawn], np.intp)
        self._drawn_sd = np.array([sd for _, sd in drawn])
        self.count = self.told + len(drawn)

    def _axis(self, axis: Axis, x: Floats) -> Axis:
        offset = x[self._at[f"axis.{axis.name}"]]
        across = perpendicular(axis.direction)
        point = axis.point_mm + across @ offset[2:] if len(offset) > 2 else axis.point_mm
        return Axis(axis.name, axis.kind, axis.direction + across @ offset[:2], point)

    def _corners(self, geometry: Geometry, x: Floats) -> tuple[Floats, Floats, Floats, Index]:
        n = len(self._points)
        shared = np.zeros((n, 3, self._shared))
        on = self._on_board
        points = np.where(on[:, None], geometry.board(self._points), self._points)
        turned = self._points @ geometry.board.rotation.T
        shared[:, :, self._at["board"]] = on[:, None, None] * _by_pose(turned, x[self._at["board"]])
        start = _Moved(points, shared, np.zeros((n, 3, len(self.axis_names))))
        moved = self._to_camera(geometry, x, "sample", start, self._view)
        return self._projected(geometry, moved, self._pixels, self._view, "corner")

    def _mirrored(
        self, geometry: Geometry, x: Floats
    ) -> list[tuple[Floats, Floats, Floats, Index]]:
        centres = self._centres(geometry, x)
        radii = geometry.radii_mm[[s.sphere for s in self._spheres]]
        parts = []
        of = self._outline_of
        if len(of):
            pixels = np.concatenate([s.outline for s in self._spheres])
            miss, by_centre, by_camera = outline_residuals(
                geometry.camera, pixels, centres.points[of], radii[of]
            )
            shared = (by_centre[:, None] @ centres.shared[of])[:, 0]
            shared[:, self._at["lens"]] += by_camera
            slip = (by_centre[:, None] @ centres.slip[of])[:, 0]
            sd = self._noise["outline"] * _SD_PX["outline"]
            parts.append((miss / sd, shared / sd, slip / sd, self._sphere_view[of]))
        if self._shown:
            at = np.array([k for k, _, _ in self._shown])
            lights = self._lights(geometry, x, self._sphere_view[at])
            where = highlight(centres.points[at], lights.points, radii[at])
            by_centre, by_light = highlight_derivatives(
                centres.points[at], lights.points, radii[at]
            )
            moved = _Moved(
                where,
                by_centre @ centres.shared[at] + by_light @ lights.shared,
                by_centre @ centres.slip[at] + by_light @ lights.slip,
            )
            pixels = np.array([pixel for _, _, pixel in self._shown], float)
            view = self._sphere_view[at]
            parts.append(self._projected(geometry, moved, pixels, view, "highlight"))
        return parts

    def _centres(self, geometry: Geometry, x: Floats) -> _Moved:
        which = np.array([s.sphere for s in self._spheres])
        n = len(which)
        shared = np.zeros((n, 3, self._shared))
        first = self._at["spheres"].start
        for k in range(3):
            shared[np.arange(n), k, first + 3 * which + k] = 1
        start = _Moved(geometry.spheres_mm[which], shared, np.zeros((n, 3, len(self.axis_names))))
        return self._to_camera(geometry, x, "sample", start, self._sphere_view)

    def _lights(self, geometry: Geometry, x: Floats, view: Index) -> _Moved:
        n = len(self._shown)
        shared = np.zeros((n, 3, self._shared))
        for row, (_, name, _) in enumerate(self._shown):
            shared[row, :, self._at[f"light.{name}"]] = np.eye(3)
        points = np.stack([np.asarray(geometry.lights_mm[name]) for _, name, _ in self._shown])
        start = _Moved(points, shared, np.zeros((n, 3, len(self.axis_names))))
        return self._to_camera(geometry, x, "light", start, view)

    def _moves(self, body: str) -> Iterator[tuple[str, int]]:
        """Axes from what moves with a body to what moves with the camera, and their sense."""
        chains = self.start.kinematics.chains
        for name in reversed(chains.get(body, ())):
            yield name, 1
        for name in chains.get("camera", ()):
            yield name, -1

    def _to_camera(
        self, geometry: Geometry, x: Floats, body: str, start: _Moved, view: Index
    ) -> _Moved:
        readings = self._readings + self.slips(x)
        moved = start
        for name, sense in self._moves(body):
            moved = self._turned(geometry.kinematics.axis(name), x, moved, sense, readings, view)
        pose = geometry.camera_pose
        turned = moved.points @ pose.rotation.T
        shared = pose.rotation @ moved.shared
        shared[:, :, self._at["camera_pose"]] += _by_pose(turned, x[self._at["camera_pose"]])
        return _Moved(turned + pose.translation, shared, pose.rotation @ moved.slip)

    def _turned(
        self, axis: Axis, x: Floats, moved: _Moved, sense: int, readings: Floats, view: Index
    ) -> _Moved:
        """What one axis does to points and to their derivatives."""
        number = self.axis_names.index(axis.name)
        at = self._at[f"axis.{axis.name}"]
        angle = sense * readings[view, number]
        nominal = self.start.kinematics.axis(axis.name)
        across = perpendicular(nominal.direction)
        length = np.linalg.norm(nominal.direction + across @ x[at][:2])
        by_offset = (np.eye(3) - np.outer(axis.direction, axis.direction)) @ across / length
        slip = moved.slip.copy()
        if axis.kind == "linear":
            shared = moved.shared.copy()
            shared[:, :, at] += angle[:, None, None] * by_offset
            slip[:, :, number] += sense * axis.direction
            return _Moved(moved.points + angle[:, None] * axis.direction, shared, slip)
        turn = rotation_of(axis.direction * (sense * readings[:, number])[:, None])[view]
        arm = moved.points - axis.point_mm
        turned = (turn @ arm[..., None])[..., 0]
        shared, slip = turn @ moved.shared, turn @ slip
        sin, versine = np.sin(angle)[:, None, None], (1 - np.cos(angle))[:, None, None]
        along = (arm @ axis.direction)[:, None, None]
        by_direction = -sin * skew(arm) + versine * (
            along * np.eye(3) + axis.direction[:, None] * arm[:, None, :]
        )
        shared[:, :, at.start : at.start + 2] += by_direction @ by_offset
        shared[:, :, at.start + 2 : at.stop] += (np.eye(3) - turn) @ across
        slip[:, :, number] += sense * np.cross(axis.direction, turned)
        return _Moved(axis.point_mm + turned, shared, slip)

    def _projected(
        self, geometry: Geometry, moved: _Moved, pixels: Floats, view: Index, kind: str
    ) -> tuple[Floats, Floats, Floats, Index]:
        found, by_point, by_camera = geometry.camera.project_with_derivatives(moved.points)
        shared = by_point @ moved.shared
        shared[:, :, self._at["lens"]] += by_camera
        slip = by_point @ moved.slip
        # A point behind the camera is no observation: it must not draw the solver anywhere.
        lost = np.isnan(found.sum(axis=1))
        miss = np.where(lost[:, None], 1e4, found - pixels)
        shared[lost] = slip[lost] = 0
        rows = 2 * len(pixels)
        sd = self.sd_px(kind)
        shape = (rows, -1)
        return (
            miss.reshape(rows) / sd,
            shared.reshape(shape) / sd[:, None],
            slip.reshape(shape) / sd[:, None],
            np.repeat(view, 2),
        )

    def _sparse(self, shared: Floats, slip: Floats, view: Index) -> sparse.csr_array:
        rows = len(shared)
        slip = slip[:, self._slip_sd > 0]
        count = slip.shape[1]
        if count == 0:
            return sparse.csr_array(shared)
        columns = view[:, None] * count + np.arange(count)
        row = np.broadcast_to(np.arange(rows)[:, None], columns.shape)
        apart = sparse.csr_array(
            (slip.ravel(), (row.ravel(), columns.ravel())), shape=(rows, self.size - self._shared)
        )
        return sparse.csr_array(sparse.hstack([sparse.csr_array(shared), apart]))


def _pose_names(key: str) -> list[tuple[str, float]]:
    turns = [(f"{key}.turn.{k}", _SCALE_TURN) for k in "xyz"]
    return turns + [(f"{key}.shift.{k}", _SCALE_MM) for k in "xyz"]


def _offset(pose: Rigid, by: Floats) -> Rigid:
    return Rigid(rotation_of(by[:3]) @ pose.rotation, pose.translation + by[3:])


def _by_pose(turned: Floats, by: Floats) -> Floats:
    """(n, 3, 6) derivative of moved points by an offset; `turned` is before the shift."""
    out = np.empty((len(turned), 3, 6))
    out[:, :, :3] = -skew(turned) @ left_jacobian(by[:3])
    out[:, :, 3:] = np.eye(3)
    return out
