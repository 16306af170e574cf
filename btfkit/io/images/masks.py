"""A mask: which texels count, however it is drawn."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from btfkit.errors import FormatError
from btfkit.io import images


def read_mask(name: str, data: bytes) -> tuple[NDArray[np.bool_], str]:
    """(h, w) bool, and how it was taken.

    Where alpha differs, or is 0, and colours do not differ, alpha is the mask; else the colours
    are, and of alpha only where it is 0. Anything but 0 counts, be the bright value 1, 100 or 255;
    of a JPEG, whose blocks ring, what is above half of its brightest value.

    Raises:
        FormatError: no picture, or one in which nothing counts.
    """
    image = images.decode(name, data, transfer="linear")
    bright = np.nan_to_num(image.linear.max(axis=2))
    alpha = image.alpha
    held = alpha is not None and np.ptp(alpha) > 0
    if alpha is not None and np.ptp(bright) == 0 and (held or not alpha.any()):
        mask, how = alpha > 0, "alpha other than 0"
    elif data.startswith(b"\xff\xd8"):
        mask, how = bright > bright.max() / 2, "brighter than half of the brightest (JPEG)"
    else:
        mask, how = bright > 0, "colour other than 0"
        if alpha is not None and held:
            mask, how = mask & (alpha > 0), "colour and alpha other than 0"
    if not mask.any():
        raise FormatError(
            name, "the mask is 0 everywhere: nothing would be valid",
            remedy="draw what counts brighter than 0, or remove the mask",
        )  # fmt: skip
    return np.asarray(mask, bool), how
