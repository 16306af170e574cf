"""Polynomial texture maps (`*.ptm`): an image under any light from six coefficients a texel.

    PTM_1.2
    PTM_FORMAT_LRGB            or PTM_FORMAT_RGB
    width, height              as words
    6 scales, 6 biases         as words
    bytes, rows from the bottom up

LRGB: six coefficients of every texel, then red, green and blue of every texel. RGB: six
coefficients of every texel for red, then for green, then for blue. A coefficient is
(byte - bias) x scale, of lu^2, lv^2, lu lv, lu, lv and 1, with lu and lv the x and y of the light.
Source: Malzbender, Gelb and Wolters, "Polynomial Texture Maps", 2001; PTM file format 1.2.
"""

from __future__ import annotations

from pathlib import Path
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import BTF
from btfkit.errors import FormatError
from btfkit.io import relit
from btfkit.io.magic import begins

_MAGIC = b"PTM_1."
_VERSION = "PTM_1.2"
# Layers of six coefficients, and whether colours follow them.
_LAYOUTS = {"PTM_FORMAT_LRGB": (1, True), "PTM_FORMAT_RGB": (3, False)}
_WORDS = 2 + 12
# The header is short text: what does not end by then is none.
_MOST_HEAD = 4096


def detect(path: Path) -> bool:
    """Whether a file begins with PTM's first word."""
    return begins(path, _MAGIC)


def read(
    path: Path,
    *,
    transfer: str | None = None,
    cosine: str | None = None,
    sampling: str | None = None,
) -> BTF:
    """A PTM as a BTF of one view; images are evaluated when they are asked for.

    Args:
        path: the file.
        transfer: of the photographs that were fitted; sRGB is assumed.
        cosine: "in" is assumed: photographs hold it.
        sampling: lights it is evaluated at: "bonn81" (default), "bonn151", or an .lp file.

    Raises:
        FormatError: damaged, or one of the compressed kinds.
    """
    found = load(path)
    return relit.assembled(
        path, found, name="ptm", transfer=transfer, cosine=cosine, sampling=sampling,
        said={"kind": found.kind},
    )  # fmt: skip


def load(path: Path) -> PTM:
    """A PTM, to be evaluated at any light.

    Raises:
        FormatError: as `read`.
    """
    with path.open("rb") as file:
        head = file.read(_MOST_HEAD)
    lines, start = _lines(path, head, 2)
    version, kind = lines
    if version != _VERSION:
        raise FormatError(path, f"is {version[:40]!r}; expected {_VERSION}")
    if kind not in _LAYOUTS:
        raise FormatError(
            path, f"kind {kind[:40]!r}; expected {' or '.join(_LAYOUTS)}",
            remedy="save it uncompressed",
        )  # fmt: skip
    words, start = _words(path, head, start, _WORDS)
    try:
        size = relit.sized(path, int(words[0]), int(words[1]))
        scale, bias = (np.array([float(w) for w in words[k : k + 6]]) for k in (2, 8))
    except ValueError as error:
        raise FormatError(path, f"its header holds {error}; expected numbers") from error
    if not (np.isfinite(scale).all() and np.isfinite(bias).all()):
        raise FormatError(path, "a scale or bias is not finite")
    layers, coloured = _LAYOUTS[kind]
    h, w = size
    data = relit.mapped(path, start, (h * w * (6 * layers + 3 * coloured),))
    count = h * w * 6 * layers
    coefficients = data[:count].reshape(layers, h, w, 6)
    colours = data[count:].reshape(h, w, 3) if coloured else None
    return PTM(path, kind, scale, bias, coefficients, colours)


@final
class PTM(relit.Relighting):
    """The coefficients of a PTM, rows as in the file: from the bottom up.

    Attributes:
        kind: the file's word for it.
    """

    def __init__(
        self,
        path: Path,
        kind: str,
        scale: NDArray[np.float64],
        bias: NDArray[np.float64],
        coefficients: NDArray[np.uint8],
        colours: NDArray[np.uint8] | None,
    ) -> None:
        self.path, self.kind = path, kind
        self._scale, self._bias = scale, bias
        self._coefficients, self._colours = coefficients[:, ::-1], colours
        self.size = (coefficients.shape[1], coefficients.shape[2])
        if colours is not None:
            self._colours = colours[::-1]

    def codes(self, light: NDArray[np.float64], rows: slice, cols: slice) -> NDArray[np.float64]:
        u, v = light[0], light[1]
        terms = np.array([u * u, v * v, u * v, u, v, 1.0]) * self._scale
        part = self._coefficients[:, rows, cols].astype(np.float64) - self._bias
        found = np.moveaxis(part @ terms, 0, -1) / 255
        if self._colours is not None:
            found = found * (self._colours[rows, cols] / 255)
        return np.asarray(found)


def _lines(path: Path, head: bytes, count: int) -> tuple[list[str], int]:
    """The first lines, and where the next one begins."""
    found, at = [], 0
    for _ in range(count):
        end = head.find(b"\n", at)
        if end < 0:
            raise FormatError(path, "ends within its header", remedy="copy it again")
        found.append(head[at:end].decode("latin-1").strip())
        at = end + 1
    return found, at


def _words(path: Path, head: bytes, start: int, count: int) -> tuple[list[str], int]:
    """The next words, and where what follows their line begins."""
    found: list[str] = []
    at = start
    while len(found) < count:
        end = head.find(b"\n", at)
        if end < 0:
            raise FormatError(
                path, f"its header ends after {len(found)} of {count} numbers",
                remedy="copy it again",
            )  # fmt: skip
        found += head[at:end].decode("latin-1").split()
        at = end + 1
    if len(found) > count:
        raise FormatError(path, f"{len(found)} numbers in its header; expected {count}")
    return found, at
