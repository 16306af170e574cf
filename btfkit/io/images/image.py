"""A decoded picture, with what its file says of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.io.images.profiles import Declared

Array = NDArray[np.float32]


@final
@dataclass(frozen=True, eq=False)
class Image:
    """One upright picture.

    Attributes:
        linear: (h, w, 1 or 3) float32, linear BT.709 where there are three.
        alpha: (h, w) as stored: codes or floats; None where there is none.
        depth: dtype of the colours as stored.
        declared: what the file says that its numbers mean; None where it is silent.
        left_out: what the file holds beside, by name.
        doubt: what a reader cannot know of the colours and a user should; empty without one.
    """

    linear: Array
    alpha: NDArray[Any] | None
    depth: np.dtype[Any]
    declared: Declared | None = None
    left_out: tuple[str, ...] = ()
    doubt: str = ""

    @property
    def coverage(self) -> Array | None:
        """(h, w) alpha as 0..1; None where there is none, or all is 1."""
        if self.alpha is None:
            return None
        codes = self.alpha.dtype.kind == "u"
        top = np.iinfo(self.alpha.dtype).max if codes else 1
        found = (self.alpha / np.float32(top)).astype(np.float32)
        return None if bool((found == 1).all()) else found

    @property
    def said(self) -> dict[str, Any]:
        """What a record has to hold of it; JSON types, empty for a plain picture."""
        found: dict[str, Any] = {}
        declared = self.declared
        if declared is not None:
            found["colour"] = declared.name
            codes = self.depth.kind == "u"
            if codes and declared.curves is not None:
                found["curve"] = True
            if declared.matrix is not None or (found.get("curve") and not declared.srgb):
                found["converted"] = True
        if self.alpha is not None:
            top = np.iinfo(self.alpha.dtype).max if self.alpha.dtype.kind == "u" else 1
            found["alpha_below_1"] = int(np.count_nonzero(self.alpha < top))
        if self.left_out:
            found["left_out"] = list(self.left_out)
        if self.doubt:
            found["doubt"] = self.doubt
        return found
