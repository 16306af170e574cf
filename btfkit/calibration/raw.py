"""RAW photographs developed linearly: by their own black and white levels, nothing sharpened."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from btfkit import colour
from btfkit.calibration.demosaic import demosaic, sites
from btfkit.calibration.merge import Merged
from btfkit.counts import RawFile

Array = NDArray[np.float32]
Floats = NDArray[np.float64]


def developed(file: RawFile) -> Array:
    """(h, w, 3) the camera's own colours: 0 at its black level, 1 where a colour saturates.

    Saturated pixels stay 1: a lamp in a sphere is one.
    """
    number = sites(file.cfa, file.mosaic.shape)
    black = file.black[number]
    share = np.minimum((file.mosaic - black) / (file.white - black), 1).astype(np.float32)
    nothing = np.zeros(share.shape, np.uint8)
    # The filter reads detail from the other colours, which it takes to be of like size.
    found = demosaic(Merged(share, nothing.astype(np.float32), nothing), file.cfa,
                     balance=1 / file.balance)  # fmt: skip
    return np.minimum(found.radiance, 1)


def to_bt709(file: RawFile) -> Floats | None:
    """(3, 3) from the camera's own colours to linear BT.709; None where its colours are unknown.

    Of a white both give 1, with the white balance that the camera has set. Source: the matrices
    that LibRaw knows a camera or a DNG by.
    """
    known = file.to_rgb
    if not np.abs(known).sum() > 0:
        if not np.abs(file.from_xyz).sum() > 0:
            return None
        from_rgb = file.from_xyz @ np.linalg.inv(colour.XYZ_TO_RGB)
        known = np.linalg.inv(from_rgb / from_rgb.sum(axis=1, keepdims=True))
    return np.asarray(known * file.balance)
