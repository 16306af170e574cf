"""Relighting files with hemispherical harmonics (`*.rti`).

    #HSH1.2
    3                          hemispherical harmonics
    width height 3
    terms 2 1                  red, green and blue apart, one byte a coefficient
    float32 x terms            scales, then as many biases, little-endian
    bytes                      row by row, of each texel the terms of red, of green and of blue

A coefficient is byte / 255 x scale + bias.
Source: Gautron et al., "A Novel Hemispherical Basis for Accurate and Efficient Rendering", 2004;
the files of RTIBuilder and relight.
"""

from __future__ import annotations

from pathlib import Path
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit import directions
from btfkit.btf import BTF
from btfkit.errors import FormatError
from btfkit.io import relit
from btfkit.io.magic import begins

_MAGIC = b"#HSH1."
_TERMS = (1, 4, 9, 16)
_MOST_HEAD = 4096


def detect(path: Path) -> bool:
    """Whether a file begins as RTI files with hemispherical harmonics do."""
    return begins(path, _MAGIC)


def read(
    path: Path,
    *,
    transfer: str | None = None,
    cosine: str | None = None,
    sampling: str | None = None,
    orientation: str | None = None,
) -> BTF:
    """An RTI as a BTF of one view; images are evaluated when they are asked for.

    Args:
        path: the file.
        transfer: of the photographs that were fitted; sRGB is assumed.
        cosine: "in" is assumed: photographs hold it.
        sampling: lights it is evaluated at: "bonn81" (default), "bonn151", or an .lp file.
        orientation: "top_down" (assumed) or "bottom_up": where the first row lies.

    Raises:
        FormatError: damaged, or of another basis.
    """
    order = orientation or "top_down"
    if order not in ("top_down", "bottom_up"):
        raise ValueError(f"orientation {order!r}; expected top_down or bottom_up")
    found = load(path, upward=order == "bottom_up")
    return relit.assembled(
        path, found, name="hsh", transfer=transfer, cosine=cosine, sampling=sampling,
        said={"terms": found.terms}, orientation=(orientation, "top_down"),
    )  # fmt: skip


def load(path: Path, *, upward: bool = False) -> HSH:
    """An RTI, to be evaluated at any light.

    Args:
        upward: whether the first row lies at the bottom.

    Raises:
        FormatError: as `read`.
    """
    with path.open("rb") as file:
        head = file.read(_MOST_HEAD)
    lines: list[str] = []
    at = 0
    while len(lines) < 4:
        end = head.find(b"\n", at)
        if end < 0:
            raise FormatError(path, "ends within its header", remedy="copy it again")
        line = head[at:end].decode("latin-1").strip()
        at = end + 1
        # Lines that begin with # are comments, but for the first.
        if not lines or not line.startswith("#"):
            lines.append(line)
    if lines[0] != "#HSH1.2":
        raise FormatError(path, f"is {lines[0][:40]!r}; expected #HSH1.2")
    try:
        numbers = [[int(word) for word in line.split()] for line in lines[1:]]
    except ValueError as error:
        raise FormatError(path, f"its header holds {error}; expected numbers") from error
    if [len(row) for row in numbers] != [1, 3, 3]:
        raise FormatError(path, f"its header is {lines[1:]}; expected 1, 3 and 3 numbers")
    ((basis,), (width, height, channels), (terms, layout, size)) = numbers
    if basis != 3 or channels != 3 or layout != 2 or size != 1 or terms not in _TERMS:
        raise FormatError(
            path,
            f"basis {basis}, {channels} channels, {terms} terms, layout {layout}, {size} bytes; "
            f"expected 3, 3, one of {', '.join(map(str, _TERMS))}, 2 and 1",
            remedy="save it as RGB with hemispherical harmonics",
        )
    h, w = relit.sized(path, width, height)
    after = at + 8 * terms
    with path.open("rb") as file:
        file.seek(at)
        table = file.read(8 * terms)
    if len(table) < 8 * terms:
        raise FormatError(path, "ends within its scales", remedy="copy it again")
    with np.errstate(invalid="ignore"):  # numbers that signal: refused below
        scale, bias = np.frombuffer(table, "<f4").astype(np.float64).reshape(2, terms)
    if not (np.isfinite(scale).all() and np.isfinite(bias).all()):
        raise FormatError(path, "a scale or bias is not finite")
    data = relit.mapped(path, after, (h, w, 3, terms))
    return HSH(path, scale, bias, data[::-1] if upward else data)


@final
class HSH(relit.Relighting):
    """Coefficients (h, w, 3, terms), row 0 on top."""

    def __init__(
        self,
        path: Path,
        scale: NDArray[np.float64],
        bias: NDArray[np.float64],
        data: NDArray[np.uint8],
    ) -> None:
        self.path, self.size = path, (data.shape[0], data.shape[1])
        self._scale, self._bias, self._data = scale, bias, data

    @property
    def terms(self) -> int:
        """How many harmonics there are."""
        return len(self._scale)

    def codes(self, light: NDArray[np.float64], rows: slice, cols: slice) -> NDArray[np.float64]:
        basis = harmonics(light[None])[0, : self.terms]
        part = self._data[rows, cols].astype(np.float64) / 255 * self._scale + self._bias
        return np.asarray(part @ basis)


def harmonics(light: NDArray[np.floating]) -> NDArray[np.float64]:
    """(n, 16) hemispherical harmonics up to degree 3 at unit directions (n, 3).

    Within a degree from the cosine of the largest multiple of the azimuth to its sine; orthonormal
    over the hemisphere.
    """
    theta, phi = directions.to_angles(light)
    c = np.clip(np.cos(theta), 0, 1)
    x = 2 * c - 1
    s = np.sqrt(np.maximum(c - c * c, 0))
    one, two, three = (np.array([np.cos(k * phi), np.sin(k * phi)]) for k in (1, 2, 3))
    first, second, third = np.sqrt(6 / np.pi), np.sqrt(30 / np.pi), np.sqrt(210 / np.pi)
    cubic = 2 * np.sqrt(21 / np.pi) * s * (1 - 5 * c + 5 * c * c)
    last = 2 * np.sqrt(35 / np.pi) * s**3
    return np.stack(
        [
            np.full_like(c, 1 / np.sqrt(2 * np.pi)),
            first * one[0] * s, np.sqrt(1.5 / np.pi) * x, first * one[1] * s,
            second * two[0] * -(s**2), second * one[0] * x * s,
            np.sqrt(2.5 / np.pi) * (1 - 6 * c + 6 * c * c),
            second * one[1] * x * s, second * two[1] * -(s**2),
            last * three[0], third * two[0] * x * -(s**2), cubic * one[0],
            np.sqrt(3.5 / np.pi) * (-1 + 12 * c - 30 * c**2 + 20 * c**3),
            cubic * one[1], third * two[1] * x * -(s**2), last * three[1],
        ],
        axis=-1,
    )  # fmt: skip
