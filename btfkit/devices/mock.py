"""The rig `mock`: the USB driver over the twin's firmware, in this process."""

from __future__ import annotations

from btfkit.devices import usb
from btfkit.devices.base import Found, Rig
from btfkit.devices.faults import Faults
from btfkit.devices.firmware import Firmware, Log
from btfkit.devices.twin.world import Setup, World
from btfkit.devices.virtual import VirtualBus


def serial(setup: Setup) -> str:
    """The twin's serial number: of what is drawn for it."""
    return f"TWIN{setup.seed}"


def find() -> list[Found]:
    """The twin, which is always there; it is named by its sensor."""
    return [Found(f"{Setup.width}x{Setup.height}", "btfkit twin")]


def open_rig(
    setup: Setup,
    *,
    faults: Faults | None = None,
    log: Log | None = None,
    piece: int | None = None,
) -> Rig:
    """A twin behind a bus of its own; not opened yet.

    Args:
        setup: what kind of twin. faults: what goes wrong.
        log: told what really was at each exposure.
        piece: bytes after which reads end, None for as many as there are.
    """
    world = World(setup)
    bus = VirtualBus(
        Firmware(world, faults or Faults(), log),
        ids=(usb.VENDOR, usb.PRODUCT),
        serial=serial(setup),
        faults=faults,
        piece=piece,
    )
    return usb.open_rig(serial(setup), backend=bus, clock=world.clock)
