"""Image libraries in forked processes: their pools of threads do not live on there."""

from __future__ import annotations

import functools
import os
import sys
from typing import Any


@functools.cache
def guard() -> None:
    """From now on the libraries that are loaded work without threads in forked children.

    A child has only the thread that forked; a library that waits for its pool waits for ever.
    """
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=_alone)


def _alone() -> None:
    # Only what is loaded: a child shall not load a library in order to hold it back.
    modules: dict[str, Any] = sys.modules
    if "cv2" in modules:
        modules["cv2"].setNumThreads(0)
    if "OpenImageIO" in modules:
        modules["OpenImageIO"].attribute("threads", 1)
        modules["OpenImageIO"].attribute("exr_threads", -1)
