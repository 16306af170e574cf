"""Relighting files: coefficients whose sum is an image under any light, seen from above.

What PTM (`btfkit.io.ptm`) and hemispherical harmonics (`btfkit.io.hsh`) share.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from btfkit import colour, directions
from btfkit.btf import BTF
from btfkit.errors import FormatError
from btfkit.io import lp, named
from btfkit.io.brdf import TABLES
from btfkit.textures import Array, Textures

# Texels a side that no camera gives: larger numbers are damage.
_MOST_SIDE = 1 << 16


class Relighting(ABC):
    """A file's coefficients, mapped.

    Attributes:
        path: for messages. size: (h, w).
    """

    path: Path
    size: tuple[int, int]

    @abstractmethod
    def codes(self, light: NDArray[np.float64], rows: slice, cols: slice) -> NDArray[np.float64]:
        """(h, w, 3) code values, 1 the brightest, under one unit light; row 0 on top."""

    def evaluate(self, light: ArrayLike, *, transfer: str = "srgb") -> NDArray[np.float32]:
        """(n, h, w, 3) linear images under lights (n, 3), whichever they are.

        Args:
            light: directions above the horizon, any length.
            transfer: of the photographs that were fitted.
        """
        every = slice(0, self.size[0]), slice(0, self.size[1])
        unit = directions.checked("light", light, upper=True).astype(np.float64)
        return np.stack([self.linear(transfer, d, *every) for d in unit])

    def linear(
        self, transfer: str, light: NDArray[np.float64], rows: slice, cols: slice
    ) -> NDArray[np.float32]:
        """(h, w, 3) linear values of `codes`.

        Raises:
            FormatError: the coefficients lead beyond what a float32 holds.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            found = _decoded(transfer, self.codes(light, rows, cols))
        if not np.isfinite(found).all():
            raise FormatError(
                self.path,
                "its coefficients give values that are no numbers",
                remedy="copy it again",
            )
        return found


def _decoded(transfer: str, codes: NDArray[np.float64]) -> NDArray[np.float32]:
    """Linear values; what a polynomial makes of a light it was not fitted to may lie beyond 0..1,
    and is mirrored, not cut off.
    """
    return np.copysign(colour.decode(transfer, np.abs(codes)), codes).astype(np.float32)


def assembled(
    path: Path,
    relighting: Relighting,
    *,
    name: str,
    transfer: str | None,
    cosine: str | None,
    sampling: str | None,
    said: dict[str, Any],
    **options: tuple[Any, Any],
) -> BTF:
    """The BTF of one view under the lights of a table.

    Args:
        name: of the format. said: what its header tells, for the record.
        sampling: "bonn81" (default), "bonn151", or an .lp file whose lights are taken.
        options: further ones of the format, as `named.assumptions` takes them.
    """
    values, record = named.assumptions(
        transfer=(transfer, "srgb"), cosine=(cosine, "in"), sampling=(sampling, "bonn81"),
        scale=(None, "relative: 1 is the brightest code value, lights of equal power"), **options,
    )  # fmt: skip
    if values["cosine"] not in ("in", "out"):
        raise ValueError(f"cosine {values['cosine']!r}; expected in or out")
    light = _lights(values["sampling"])
    textures = _Textures(relighting, light, values["transfer"], values["cosine"])
    return named.assembled(
        path,
        textures,
        light=light,
        view=np.tile(np.array([[0, 0, 1]], np.float32), (len(light), 1)),
        provenance={
            "source": str(path), "format": name, **said,
            "fitted": "coefficients, evaluated; values may lie beyond 0..1",
            **record,
        },
    )  # fmt: skip


def sized(path: Path, width: int, height: int) -> tuple[int, int]:
    """(h, w) of a header; FormatError where no picture has such a size."""
    if not (0 < width <= _MOST_SIDE and 0 < height <= _MOST_SIDE):
        raise FormatError(path, f"a picture of {width} x {height}; expected 1 to {_MOST_SIDE}")
    return height, width


def mapped(path: Path, start: int, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """Bytes behind a header, which must be all that is left of the file."""
    size, needed = path.stat().st_size, int(np.prod(shape, dtype=np.int64))
    if size - start != needed:
        raise FormatError(
            path, f"{size - start} bytes behind its header; expected {needed}",
            remedy="copy it again",
        )  # fmt: skip
    return np.memmap(path, np.uint8, "r", start, shape)


@final
class _Textures(Textures):
    """Images under a list of lights, each evaluated when it is asked for."""

    def __init__(
        self, relighting: Relighting, light: NDArray[np.float32], transfer: str, cosine: str
    ) -> None:
        self._relighting, self._light = relighting, light.astype(np.float64)
        self._transfer, self._cosine = transfer, cosine
        _decoded(transfer, np.zeros(1))  # refuses what is no transfer
        h, w = relighting.size
        self.shape = (len(light), h, w, 3)
        self._at = slice(0, h), slice(0, w)

    def _read(self, index: int) -> Array:
        relighting, light = self._relighting, self._light[index]
        linear = relighting.linear(self._transfer, light, *self._at)
        factor = 1.0 if self._cosine == "in" else max(light[2], 0.0)
        return np.asarray(linear * np.float32(factor), np.float32)

    def crop(self, rows: slice, cols: slice) -> Textures:
        n, _, _, c = self.shape
        other = object.__new__(_Textures)
        other.__dict__.update(self.__dict__)
        other.shape = (n, rows.stop - rows.start, cols.stop - cols.start, c)
        top, left = self._at[0].start, self._at[1].start
        other._at = (
            slice(top + rows.start, top + rows.stop),
            slice(left + cols.start, left + cols.stop),
        )
        return other


def _lights(sampling: str) -> NDArray[np.float32]:
    if sampling in TABLES:
        return TABLES[sampling]().astype(np.float32)
    table = Path(sampling)
    if table.suffix.lower() != ".lp" or not table.is_file():
        expected = ", ".join([*TABLES, "a file LIGHTS.lp"])
        raise ValueError(f"sampling {sampling!r}; expected one of {expected}")
    text = table.read_text(encoding="utf-8", errors="replace")
    lights = np.array([light for _, light in lp.parse(sampling, text)])
    return directions.checked("light", lights, upper=False)
