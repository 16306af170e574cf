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
from scipy import ndimage

from btfkit.errors import CalibrationError

Floats = NDArray[np.float64]
# Corners that detection gives at least: fewer tell no pose.
_FEWEST = 6


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

    @property
    def cells(self) -> int:
        """Cells along a marker, its black border included."""
        return int(self._bits.shape[-1])

    def cell_px(self, corners: Floats) -> float:
        """Pixels along the shorter side of a marker's cell, where a frame shows the corners.

        Args:
            corners: (m, 2) pixels of all inner corners, NaN where one has none; NaN without any.
        """
        columns, rows = (count - 1 for count in self.squares)
        lattice = corners.reshape(rows, columns, 2)
        sides = [np.linalg.norm(np.diff(lattice, axis=k), axis=-1) for k in (0, 1)]
        seen = [side[np.isfinite(side)] for side in sides]
        square = min((float(np.median(side)) for side in seen if side.size), default=np.nan)
        return square * self.marker_mm / self.square_mm / self.cells

    def most_cell_px(self, width: int, height: int) -> float:
        """Pixels a cell where the board fills a frame."""
        square = min(max(width, height) / max(self.squares), min(width, height) / min(self.squares))
        return square * self.marker_mm / self.square_mm / self.cells

    def pattern(self, x: Floats, y: Floats) -> Floats:
        """(...) 1 where the print is white and 0 where black, at places in mm, board frame."""
        columns, rows = self.squares
        u, v = x / self.square_mm + columns / 2, rows / 2 - y / self.square_mm
        column = np.clip(np.floor(u).astype(int), 0, columns - 1)
        row = np.clip(np.floor(v).astype(int), 0, rows - 1)
        markers = self._markers[row, column]
        bits = self.cells
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

    @cached_property
    def _area(self) -> tuple[Floats, Floats, Floats]:
        """Lines of the print across and up, mm, and the white up to each of them (v, u), mm^2."""
        bits, share = self.cells, self.marker_mm / self.square_mm
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
