"""The libraries that decode and encode pictures, loaded when they are first needed."""

from __future__ import annotations

import functools
from typing import Any


@functools.cache
def opencv() -> Any:
    """OpenCV, which writes no errors of its own beside ours."""
    import cv2

    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    return cv2


@functools.cache
def openimageio() -> Any:
    """OpenImageIO without threads of its own: whoever reads many pictures reads them side by side.

    Its pools do not live on in a forked process, where a decoder would wait for them for ever.
    """
    import OpenImageIO as oiio

    oiio.attribute("threads", 1)
    oiio.attribute("exr_threads", -1)
    return oiio
