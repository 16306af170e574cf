"""A ChArUco board: its pattern, its corners, and where they are in a frame.

Board frame: origin at the board's centre, x right, y up, z out of the print, millimetres.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize

from btfkit.calibration.camera_model import Camera
from btfkit.calibration.kinematics import Rigid
from btfkit.errors import CalibrationError

Floats = NDArray[np.float64]
# Corners that detection gives at least: fewer tell no pose.
_FEWEST = 6
# Half width of the part of the pattern that a corner is fitted to, in squares and in pixels.
_REACH_SQUARES, _REACH_PX = 0.6, 11
_SUBPIXELS = 2
# Windows that the drawing leaves this much more of than of most show something else too.
_COVERED = 3.0
_SETTLED_PX = 1e-2
# Corners that are enough to tell how sharp the lens is.
_BLUR_CORNERS = 24


@final
@dataclass(frozen=True)
class Board:
    """A ChArUco board as it was printed.

    Attributes:
        squares: columns and rows of squares.
        square_mm, marker_mm: edges of a square and of a marker in it.
        dictionary: name of OpenCV's dictionary, as "DICT_5X5_100".
    """

    squares: tuple[int, int]
    square_mm: float
    marker_mm: float
    dictionary: str = "DICT_5X5_100"

    def __post_init__(self) -> None:
        if min(self.squares) < 3 or not 0 < self.marker_mm < self.square_mm:
            raise CalibrationError(
                f"a board of {self.squares} squares of {self.square_mm:g} mm with markers of "
                f"{self.marker_mm:g} mm; expected at least 3 x 3 and markers inside squares"
            )

    @staticmethod
    def from_json(entry: Mapping[str, Any]) -> Board:
        """The board that `sequence.json` describes under target.board.

        Raises:
            CalibrationError: another type of board, or a size missing.
        """
        kind = entry.get("type", "charuco")
        if kind != "charuco":
            raise CalibrationError(f"target.board is {kind!r}; boards are 'charuco'")
        try:
            columns, rows = entry["squares"]
            sizes = float(entry["square_mm"]), float(entry["marker_mm"])
        except (KeyError, TypeError, ValueError) as error:
            raise CalibrationError(
                f"target.board of sequence.json lacks or garbles {error}",
                remedy="give squares, square_mm and marker_mm",
            ) from error
        return Board(
            (int(columns), int(rows)), *sizes, str(entry.get("dictionary", "DICT_5X5_100"))
        )

    @cached_property
    def corners_mm(self) -> Floats:
        """(m, 3) inner corners by their number, board frame."""
        return self._from_print(np.asarray(self._opencv.getChessboardCorners(), float))

    def pattern(self, x: Floats, y: Floats) -> Floats:
        """(...) 1 where the print is white and 0 where black, at places in mm, board frame."""
        columns, rows = self.squares
        u, v = x / self.square_mm + columns / 2, rows / 2 - y / self.square_mm
        column = np.clip(np.floor(u).astype(int), 0, columns - 1)
        row = np.clip(np.floor(v).astype(int), 0, rows - 1)
        markers = self._markers[row, column]
        bits = self._bits.shape[-1]
        share = self.marker_mm / self.square_mm
        i = np.floor(((v - row) - (1 - share) / 2) / share * bits).astype(int)
        j = np.floor(((u - column) - (1 - share) / 2) / share * bits).astype(int)
        inside = (i >= 0) & (i < bits) & (j >= 0) & (j < bits) & (markers >= 0)
        drawn = self._bits[markers, np.clip(i, 0, bits - 1), np.clip(j, 0, bits - 1)]
        return np.where(inside, drawn, self._white[row, column])

    def whiteness(self, x: Floats, y: Floats, across: Floats, along: Floats) -> Floats:
        """(...) share of white in upright rectangles of the print, exactly; 0 beyond its rim.

        Args:
            x, y: centres, mm, board frame. across, along: sides, mm; broadcast to them.
        """
        columns, rows, total = self._area
        sides = []
        for at, half, lines in ((x, across / 2, columns), (y, along / 2, rows)):
            number = np.arange(len(lines), dtype=float)
            sides.append([np.interp(at + sign * half, lines, number) for sign in (-1, 1)])
        (left, right), (low, high) = sides

        def below(row: Floats, column: Floats) -> Floats:
            # Between the lines of the print its integral is bilinear.
            return np.asarray(ndimage.map_coordinates(total, [row, column], order=1))

        white = below(high, right) - below(high, left) - below(low, right) + below(low, left)
        return np.asarray(white / (across * along))

    def detect(self, image: Floats) -> tuple[NDArray[np.intp], Floats]:
        """Corners in a frame, to some tenths of a pixel where the lens bends straight lines.

        Args:
            image: (h, w) linear values of any scale, NaN where unknown.

        Returns:
            (k,) numbers of corners and (k, 2) pixels; none where fewer than six are seen.
        """
        import cv2

        finite = image[np.isfinite(image)]
        if finite.size == 0:
            return np.zeros(0, np.intp), np.zeros((0, 2))
        low, high = np.percentile(finite, [0.5, 99.5])
        # A square root brings dark squares of dimly lit views within eight bits.
        scaled = np.sqrt(
            np.clip((np.nan_to_num(image, nan=low) - low) / max(high - low, 1e-12), 0, 1)
        )
        detector = cv2.aruco.CharucoDetector(self._opencv)
        found, numbers, _, _ = detector.detectBoard((255 * scaled).astype(np.uint8))
        if found is None or numbers is None or len(numbers) < _FEWEST:
            return np.zeros(0, np.intp), np.zeros((0, 2))
        return numbers.reshape(-1).astype(np.intp), found.reshape(-1, 2).astype(float)

    def refine(
        self,
        image: Floats,
        numbers: NDArray[np.intp],
        camera: Camera,
        pose: Rigid,
        *,
        blur_px: float,
    ) -> tuple[Floats, Floats]:
        """Corners fitted with the board's own picture as the camera would see it.

        A homography knows neither the lens nor the markers beside a corner; the picture of the
        board in the estimated pose knows both, and is moved until it lies on the frame.

        Args:
            image: (h, w) linear values.
            numbers: (k,) corners to fit.
            camera, pose: estimates, board to camera; good to about a pixel.
            blur_px: standard deviation of the lens's blur.

        Returns:
            (k, 2) pixels, NaN where the frame does not show the corner or something else lies
            on it; and (k, 2) their standard deviations, of what the drawing leaves of the frame.
        """
        start = camera.project(pose(self.corners_mm[numbers]))
        window = _Window.around(image, start, self._reach_px(camera, pose, numbers))
        shift = np.zeros_like(start)
        for _ in range(4):
            drawn = self._drawn(window, shift, camera, pose, blur_px)
            step = window.fit(drawn)
            shift += step
            # What is left then is a tenth of it and less.
            if not np.nanmedian(np.abs(step)) > _SETTLED_PX:
                break
        left = window.misfit(drawn)
        with np.errstate(invalid="ignore"):
            seen = np.abs(shift).max(axis=1) < 2.5
            # What something else lies upon is fitted worse than most.
            seen &= left < _COVERED * np.median(left[seen])
        sd = window.deviation(drawn)
        worst = sd.max(axis=1)
        seen &= worst < _COVERED * np.median(worst[seen])
        shift[~seen] = np.nan
        return start + shift, sd

    def blur(self, image: Floats, numbers: NDArray[np.intp], camera: Camera, pose: Rigid) -> float:
        """Standard deviation of the lens's blur, px, beside the pixel's own square.

        Args:
            image: (h, w) linear values of a sharp, well lit view.
            numbers: (k,) corners that it shows.
            camera, pose: board to camera; good to a pixel.
        """
        numbers = numbers[:: max(len(numbers) // _BLUR_CORNERS, 1)]
        corners = camera.project(pose(self.corners_mm[numbers]))
        window = _Window.around(image, corners, self._reach_px(camera, pose, numbers))

        def misfit(blur_px: float) -> float:
            shift = window.fit(self._drawn(window, np.zeros_like(corners), camera, pose, blur_px))
            shift = np.nan_to_num(shift)
            drawn = self._drawn(window, shift, camera, pose, blur_px)
            return float(np.median(window.misfit(drawn)))

        best = optimize.minimize_scalar(misfit, bounds=(0.05, 3.0), options={"xatol": 0.01})
        return float(best.x)

    def _reach_px(self, camera: Camera, pose: Rigid, numbers: NDArray[np.intp]) -> int:
        """Half width of the windows: the pattern's share, not more than the frame needs."""
        corners = self.corners_mm[numbers]
        reach = _REACH_SQUARES * self.square_mm
        sides = [camera.project(pose(corners + reach * np.eye(3)[i])) for i in (0, 1)]
        far = max(np.nanmax(np.abs(s - camera.project(pose(corners))), initial=3.0) for s in sides)
        return int(min(np.ceil(far), _REACH_PX))

    def _drawn(
        self, window: _Window, shift: Floats, camera: Camera, pose: Rigid, blur_px: float
    ) -> Floats:
        """(k, n, n) the pattern that each window would show, moved by its shift (k, 2)."""
        pad = int(np.ceil(3 * blur_px)) + 1
        fine = (np.arange((window.size + 2 * pad) * _SUBPIXELS) + 0.5) / _SUBPIXELS - 0.5
        fine = fine - pad - window.size // 2
        # Over a window the way back to the board is a parabola to 1e-4 px: nine exact rays.
        nodes = np.array([fine[0], 0.0, fine[-1]])
        columns, rows = np.meshgrid(nodes, nodes)
        pixels = np.stack([columns, rows], -1) + (window.centre - shift)[:, None, None, :]
        rays = camera.rays(pixels)
        normal, origin = pose.rotation[:, 2], pose.translation
        with np.errstate(invalid="ignore", divide="ignore"):
            depth = (normal @ origin) / (rays @ normal)
        on_board = ((rays * depth[..., None] - origin) @ pose.rotation)[..., :2]
        basis = _parabola(nodes, fine)
        place = np.einsum("ya,kabd,xb->kyxd", basis, np.nan_to_num(on_board), basis, optimize=True)
        # What a sample covers of the print: as far to the sides as its own square.
        steps = [np.diff(place, axis=axis).reshape(len(place), -1, 2) for axis in (1, 2)]
        sides = np.sqrt(sum((step**2).mean(axis=1) for step in steps))[:, None, None]
        sides = np.maximum(sides, 1e-9)
        drawn = self.whiteness(place[..., 0], place[..., 1], sides[..., 0], sides[..., 1])
        if blur_px > 0:
            drawn = ndimage.gaussian_filter(
                drawn, (0, blur_px * _SUBPIXELS, blur_px * _SUBPIXELS), mode="nearest"
            )
        k, side = len(drawn), window.size + 2 * pad
        return drawn.reshape(k, side, _SUBPIXELS, side, _SUBPIXELS).mean((2, 4))[
            :, pad - 1 : 1 - pad, pad - 1 : 1 - pad
        ]

    @cached_property
    def _area(self) -> tuple[Floats, Floats, Floats]:
        """Lines of the print across and up, mm, and the white up to each of them (v, u), mm^2."""
        bits, share = self._bits.shape[-1], self.marker_mm / self.square_mm
        inside = (1 - share) / 2 + share * np.arange(bits + 1) / bits
        lines = []
        for count in self.squares:
            whole = np.append((np.arange(count)[:, None] + [0.0, *inside]).reshape(-1), count)
            lines.append((whole - count / 2) * self.square_mm)
        columns, rows = lines
        middles = [(edges[1:] + edges[:-1]) / 2 for edges in lines]
        white = self.pattern(*np.meshgrid(*middles)) * np.outer(np.diff(rows), np.diff(columns))
        return columns, rows, np.pad(white.cumsum(0).cumsum(1), ((1, 0), (1, 0)))

    def _from_print(self, points: Floats) -> Floats:
        """OpenCV counts from the upper left corner, y down."""
        width, height = (count * self.square_mm for count in self.squares)
        return np.stack(
            [points[..., 0] - width / 2, height / 2 - points[..., 1], np.zeros(points.shape[:-1])],
            -1,
        )

    @cached_property
    def _opencv(self) -> Any:
        import cv2

        number = getattr(cv2.aruco, self.dictionary, None)
        if number is None:
            raise CalibrationError(f"OpenCV has no dictionary {self.dictionary!r}")
        dictionary = cv2.aruco.getPredefinedDictionary(number)
        return cv2.aruco.CharucoBoard(self.squares, self.square_mm, self.marker_mm, dictionary)

    @cached_property
    def _markers(self) -> NDArray[np.intp]:
        """(rows, columns) which of the board's markers lies in a square, -1 for none."""
        columns, rows = self.squares
        table = np.full((rows, columns), -1, np.intp)
        for which, outline in enumerate(self._opencv.getObjPoints()):
            column, row = np.floor(np.asarray(outline)[:, :2].mean(0) / self.square_mm).astype(int)
            table[row, column] = which
        return table

    @cached_property
    def _white(self) -> Floats:
        """(rows, columns) 1 where a square is white: where markers are, by its parity."""
        row, column = np.argwhere(self._markers >= 0)[0]
        parity = np.add.outer(np.arange(self.squares[1]), np.arange(self.squares[0])) % 2
        return (parity == (row + column) % 2).astype(float)

    @cached_property
    def _bits(self) -> Floats:
        """(markers, bits, bits) cells of each marker, its black border included."""
        dictionary = self._opencv.getDictionary()
        side = dictionary.markerSize + 2
        numbers = np.asarray(self._opencv.getIds()).reshape(-1)
        cells = [dictionary.generateImageMarker(int(i), side, borderBits=1) > 127 for i in numbers]
        return np.stack(cells).astype(float)


def _parabola(nodes: Floats, at: Floats) -> Floats:
    """(m, 3) weights of values at three nodes in the parabola through them, at places (m,)."""
    a, b, c = nodes
    return np.stack(
        [
            (at - b) * (at - c) / ((a - b) * (a - c)),
            (at - a) * (at - c) / ((b - a) * (b - c)),
            (at - a) * (at - b) / ((c - a) * (c - b)),
        ],
        -1,
    )


@final
@dataclass(frozen=True, eq=False)
class _Window:
    """Square parts of a frame about whole pixels.

    Attributes:
        values: (k, n, n), NaN outside the frame.
        centre: (k, 2) middle pixel. size: n, odd.
    """

    values: Floats
    centre: Floats
    size: int

    @staticmethod
    def around(image: Floats, pixels: Floats, reach: int) -> _Window:
        height, width = image.shape
        lost = np.isnan(pixels.sum(axis=1))
        centre = np.rint(np.where(lost[:, None], -1e6, pixels))
        offset = np.arange(-reach, reach + 1)
        rows = centre[:, 1, None, None].astype(int) + offset[:, None]
        columns = centre[:, 0, None, None].astype(int) + offset
        inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        values = image[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]
        return _Window(np.where(inside, values, np.nan), centre, 2 * reach + 1)

    def fit(self, drawn: Floats) -> Floats:
        """(k, 2) further shift that brings the drawn windows (k, n + 2, n + 2) onto the frame's.

        The frame is black level + light * drawn + slope; solved with the slopes of the drawing.
        """
        normal, right, _ = self._equations(drawn)
        shift = np.full((len(drawn), 2), np.nan)
        seen = np.isfinite(self.values).reshape(len(drawn), -1).mean(1) > 0.7
        for k in np.flatnonzero(seen):
            solved, _, rank, _ = np.linalg.lstsq(normal[k], right[k], rcond=1e-12)
            if rank == 6 and abs(solved[1]) > 0:
                shift[k] = -solved[4:] / solved[1]
        return np.clip(shift, -1, 1)

    def deviation(self, drawn: Floats) -> Floats:
        """(k, 2) standard deviations of `fit`'s shifts; infinite where nothing is told."""
        normal, right, square = self._equations(drawn)
        count = np.isfinite(self.values).reshape(len(drawn), -1).sum(1)
        out = np.full((len(drawn), 2), np.inf)
        for k in range(len(drawn)):
            solved, _, rank, _ = np.linalg.lstsq(normal[k], right[k], rcond=1e-12)
            if rank == 6 and count[k] > 6:
                noise = max(square[k] - right[k] @ solved, 0.0) / (count[k] - 6)
                spread = np.linalg.inv(normal[k])[[4, 5], [4, 5]]
                out[k] = np.sqrt(noise * spread) / max(abs(solved[1]), 1e-300)
        return out

    def misfit(self, drawn: Floats) -> Floats:
        """(k,) share of the windows' squares that the drawings leave."""
        normal, right, square = self._equations(drawn)
        left = np.empty(len(drawn))
        for k in range(len(drawn)):
            solved = np.linalg.lstsq(normal[k, :4, :4], right[k, :4], rcond=1e-12)[0]
            left[k] = (square[k] - right[k, :4] @ solved) / max(square[k], 1e-300)
        return left

    def _equations(self, drawn: Floats) -> tuple[Floats, Floats, Floats]:
        """Normal equations (k, 6, 6), right sides (k, 6) and squares (k,) of the windows."""
        inner = drawn[:, 1:-1, 1:-1]
        across = (drawn[:, 1:-1, 2:] - drawn[:, 1:-1, :-2]) / 2
        down = (drawn[:, 2:, 1:-1] - drawn[:, :-2, 1:-1]) / 2
        offset = np.arange(self.size) - self.size // 2
        columns, rows = (np.broadcast_to(a, inner.shape) for a in (offset, offset[:, None]))
        basis = np.stack([np.ones_like(inner), inner, columns, rows, across, down], -1)
        weight = np.isfinite(self.values).astype(float)
        basis = (basis * weight[..., None]).reshape(len(drawn), -1, 6)
        target = np.nan_to_num(self.values).reshape(len(drawn), -1)
        return (
            basis.transpose(0, 2, 1) @ basis,
            (basis.transpose(0, 2, 1) @ target[..., None])[..., 0],
            (target**2).sum(1),
        )
