"""Residuals of a rig's geometry and their exact derivatives, as a sparse least-squares problem."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from btfkit.calibration.bundle_motion import Motion, Moved, by_pose
from btfkit.calibration.bundle_parameters import Parameters
from btfkit.calibration.geometry import Geometry
from btfkit.calibration.kinematics import reading_of
from btfkit.calibration.mirrors import highlight, highlight_derivatives, outline_residuals
from btfkit.calibration.sightings import Sighting, SphereSighting

Floats = NDArray[np.float64]
Index = NDArray[np.intp]
# Expected noise of an observation, px: relative weights of the kinds.
_SD_PX = {"corner": 0.02, "outline": 0.15, "highlight": 0.02}
# How far the noise of a kind may be from what was expected. Highlights are few for what they tell:
# what they leave is less than their noise.
_NOISE = {"corner": (0.1, 5.0), "outline": (0.5, 5.0), "highlight": (0.5, 5.0)}
# Of a corner that was fitted to a frame, however little the fit leaves.
_LEAST_PX = 0.002


class Problem:
    """Parameters are offsets from the start; residuals are in expected standard deviations.

    Attributes:
        parameters: what is asked for.
        told: how many residuals come from frames and readings; those after them, to `count`, say
            how near to its drawing a rig is.
    """

    def __init__(
        self,
        start: Geometry,
        sightings: Sequence[Sighting],
        spheres: Sequence[SphereSighting],
        *,
        slip_sd: Mapping[str, float],
    ) -> None:
        self._sightings, self._spheres = tuple(sightings), tuple(spheres)
        self.names_of_sightings = [sighting.name for sighting in sightings]
        every: list[Sighting | SphereSighting] = [*sightings, *spheres]
        self.parameters = Parameters(start, [entry.name for entry in every], slip_sd)
        axes = self.parameters.axis_names
        self._readings = np.array([[reading_of(e.readings, a) for a in axes] for e in every])
        self._observations()

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

    def evaluate(self, x: Floats) -> tuple[Floats, sparse.csr_array]:
        """Residuals (m,) and their derivatives (m, p)."""
        of = self.parameters
        motion = Motion(of, of.geometry(x), x, self._readings)
        parts = [self._corners(motion)]
        if self._spheres:
            parts += self._mirrored(motion)
        residuals = [part[0] for part in parts]
        jacobians = [self._sparse(*part[1:]) for part in parts]
        free = of.size - of.shared
        if free:
            weight = 1 / of.scale[of.shared :]
            residuals.append(x[of.shared :] * weight)
            jacobians.append(
                sparse.csr_array(
                    (weight, (np.arange(free), of.shared + np.arange(free))), shape=(free, of.size)
                )
            )
        if len(of.drawn):
            rows = np.arange(len(of.drawn))
            residuals.append(x[of.drawn] / of.drawn_sd)
            jacobians.append(
                sparse.csr_array((1 / of.drawn_sd, (rows, of.drawn)), shape=(len(rows), of.size))
            )
        return np.concatenate(residuals), sparse.csr_array(sparse.vstack(jacobians))

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
        of = self.parameters
        self.told = int(ends[-1]) + of.size - of.shared
        self.count = self.told + len(of.drawn)

    def _corners(self, motion: Motion) -> tuple[Floats, Floats, Floats, Index]:
        board, at = motion.geometry.board, self.parameters.at["board"]
        on = self._on_board
        start = motion.still(np.where(on[:, None], board(self._points), self._points))
        turned = self._points @ board.rotation.T
        start.shared[:, :, at] = on[:, None, None] * by_pose(turned, motion.x[at])
        moved = motion.to_camera("sample", start, self._view)
        return self._projected(motion.geometry, moved, self._pixels, self._view, "corner")

    def _mirrored(self, motion: Motion) -> list[tuple[Floats, Floats, Floats, Index]]:
        geometry = motion.geometry
        centres = self._centres(motion)
        radii = geometry.radii_mm[[s.sphere for s in self._spheres]]
        parts = []
        of = self._outline_of
        if len(of):
            pixels = np.concatenate([s.outline for s in self._spheres])
            miss, by_centre, by_camera = outline_residuals(
                geometry.camera, pixels, centres.points[of], radii[of]
            )
            shared = (by_centre[:, None] @ centres.shared[of])[:, 0]
            shared[:, self.parameters.at["lens"]] += by_camera
            slip = (by_centre[:, None] @ centres.slip[of])[:, 0]
            sd = self._noise["outline"] * _SD_PX["outline"]
            parts.append((miss / sd, shared / sd, slip / sd, self._sphere_view[of]))
        if self._shown:
            at = np.array([k for k, _, _ in self._shown])
            lights = self._lights(motion, self._sphere_view[at])
            where = highlight(centres.points[at], lights.points, radii[at])
            by_centre, by_light = highlight_derivatives(
                centres.points[at], lights.points, radii[at]
            )
            moved = Moved(
                where,
                by_centre @ centres.shared[at] + by_light @ lights.shared,
                by_centre @ centres.slip[at] + by_light @ lights.slip,
            )
            pixels = np.array([pixel for _, _, pixel in self._shown], float)
            view = self._sphere_view[at]
            parts.append(self._projected(geometry, moved, pixels, view, "highlight"))
        return parts

    def _centres(self, motion: Motion) -> Moved:
        which = np.array([s.sphere for s in self._spheres])
        start = motion.still(motion.geometry.spheres_mm[which])
        first = self.parameters.at["spheres"].start
        for k in range(3):
            start.shared[np.arange(len(which)), k, first + 3 * which + k] = 1
        return motion.to_camera("sample", start, self._sphere_view)

    def _lights(self, motion: Motion, view: Index) -> Moved:
        lights = motion.geometry.lights_mm
        start = motion.still(np.stack([np.asarray(lights[name]) for _, name, _ in self._shown]))
        for row, (_, name, _) in enumerate(self._shown):
            start.shared[row, :, self.parameters.at[f"light.{name}"]] = np.eye(3)
        return motion.to_camera("light", start, view)

    def _projected(
        self, geometry: Geometry, moved: Moved, pixels: Floats, view: Index, kind: str
    ) -> tuple[Floats, Floats, Floats, Index]:
        found, by_point, by_camera = geometry.camera.project_with_derivatives(moved.points)
        shared = by_point @ moved.shared
        shared[:, :, self.parameters.at["lens"]] += by_camera
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
        slip = slip[:, self.parameters.slip_sd > 0]
        count = slip.shape[1]
        if count == 0:
            return sparse.csr_array(shared)
        columns = view[:, None] * count + np.arange(count)
        row = np.broadcast_to(np.arange(rows)[:, None], columns.shape)
        apart = sparse.csr_array(
            (slip.ravel(), (row.ravel(), columns.ravel())),
            shape=(rows, self.parameters.size - self.parameters.shared),
        )
        return sparse.csr_array(sparse.hstack([sparse.csr_array(shared), apart]))
