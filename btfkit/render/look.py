"""How radiance is shown: its colours, exposed, over a background."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit.files import whole
from btfkit.render import picture, sheets
from btfkit.render.preview import Rendering


@final
@dataclass(frozen=True)
class Look:
    """How radiance is shown.

    Attributes:
        channels: of the radiance. exposure: stops.
        background: (3,) linear RGB of what nothing covers.
    """

    channels: tuple[str, ...]
    exposure: float
    background: Sequence[float]

    @property
    def to_rgb(self) -> NDArray[np.float32]:
        """(c, 3) from channels to linear RGB."""
        return picture.to_rgb(self.channels)

    def linear(self, seen: Rendering) -> NDArray[np.float32]:
        """(h, w, 3) linear RGB as shown."""
        shown = seen.radiance @ self.to_rgb * np.float32(2.0**self.exposure)
        return shown + (1 - seen.cover[..., None]) * np.asarray(self.background, np.float32)

    def codes(self, seen: Rendering) -> NDArray[np.uint8]:
        """(h, w, 3) 8-bit sRGB."""
        return sheets.codes_of(self.linear(seen))

    def write(self, codes: NDArray[np.uint8], final: Path, *, force: bool) -> None:
        """Write 8-bit sRGB (h, w, 3) as PNG or JPEG, whole or not at all."""
        from PIL import Image

        with whole(final, force=force) as partial:
            Image.fromarray(codes).save(partial, quality=95)
