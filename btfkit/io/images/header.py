"""What the header of a picture in code values declares, whatever its format."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

from btfkit.io.images.profiles import Declared


@final
@dataclass(frozen=True)
class Header:
    """One picture of a file, as its header says.

    Attributes:
        h, w: as stored, before `orientation`.
        colours: 1 or 3 once palettes are looked up and inks mixed.
        bits: of a sample: 8 and 16 are codes, 32 and 64 floats; `floats` tells half from 16.
        floats: whether samples are floating point: linear.
        alpha: whether one more sample holds the cover.
        premultiplied: whether colours were multiplied by alpha.
        orientation: EXIF, 1 to 8.
        declared: what the colours mean; None where the file does not say.
        end: bytes behind it are none of the picture's; None for all.
        page: which picture of the file it is.
        doubt: what cannot be known of the colours; empty without one.
    """

    h: int
    w: int
    colours: int
    bits: int
    floats: bool = False
    alpha: bool = False
    premultiplied: bool = False
    orientation: int = 1
    declared: Declared | None = None
    end: int | None = None
    page: int = 0
    doubt: str = ""
