"""Cameras, stages and lights of a rig, and the engine that runs a measurement."""

from __future__ import annotations

import importlib
from typing import Any

# Name of a driver -> its module; `btfkit capture --device NAME` takes these.
DRIVERS: dict[str, str] = {
    "usb": "btfkit.devices.usb",
    "mock": "btfkit.devices.mock",
    "gphoto2": "btfkit.devices.gphoto2",
}


def driver(name: str) -> Any:
    """The module of a driver.

    Raises:
        ValueError: there is none of that name.
    """
    if name not in DRIVERS:
        raise ValueError(f"no driver {name!r}; expected one of {', '.join(DRIVERS)}")
    return importlib.import_module(DRIVERS[name])
