"""The USB end of the wire: two bulk endpoints through pyusb."""

from __future__ import annotations

import errno
import functools
import importlib
from collections.abc import Callable
from typing import Any, TypeVar, final

import usb.core
import usb.util

from btfkit.devices.base import UnpluggedError
from btfkit.devices.clock import Clock
from btfkit.devices.wire.link import Transport
from btfkit.devices.wire.packets import MOST_PAYLOAD, OVERHEAD
from btfkit.errors import DeviceError

T = TypeVar("T")

ENDPOINT_OUT, ENDPOINT_IN = 0x01, 0x81
# A whole reply, in packets of 512 bytes.
_READ_BYTES = -(-(MOST_PAYLOAD + OVERHEAD) // 512) * 512
_WRITE_MS = 1000
_UDEV = "install the udev rule of docs/capture.md"


@final
class Bulk(Transport):
    """Two bulk endpoints through pyusb."""

    def __init__(self, device: Any, clock: Clock) -> None:
        self._device = device
        self._clock = clock

    def claim(self) -> None:
        """Take the interface, and drop what an earlier owner left unread."""
        self._tried(self._device.set_configuration)
        self._tried(lambda: usb.util.claim_interface(self._device, 0))
        self.recover()

    def release(self) -> None:
        usb.util.dispose_resources(self._device)

    def write(self, data: bytes) -> None:
        sent = self._tried(lambda: self._device.write(ENDPOINT_OUT, data, _WRITE_MS))
        if sent is not None and sent != len(data):
            raise DeviceError(f"{sent} of {len(data)} bytes were sent to the rig")

    def read(self, timeout_s: float) -> bytes:
        # libusb takes 0 for ever.
        timeout = max(1, round(timeout_s * 1000))
        found = self._tried(lambda: self._device.read(ENDPOINT_IN, _READ_BYTES, timeout))
        return b"" if found is None else bytes(found)

    def recover(self) -> None:
        for endpoint in (ENDPOINT_OUT, ENDPOINT_IN):
            self._tried(functools.partial(self._device.clear_halt, endpoint))
        for _ in range(16):
            if not self.read(0.001):
                break

    def now(self) -> float:
        return self._clock.now()

    def _tried(self, call: Callable[[], T]) -> T | None:
        """What `call` returns; None after a time-out or a halt, which is cleared."""
        try:
            return call()
        except usb.core.USBTimeoutError:
            return None
        except usb.core.USBError as error:
            if error.errno == errno.EPIPE:
                self._device.clear_halt(ENDPOINT_IN)
                self._device.clear_halt(ENDPOINT_OUT)
                return None
            if error.errno in (errno.ENODEV, errno.EIO, errno.ENOENT):
                raise UnpluggedError(
                    f"the rig is gone from the bus ({error.strerror})",
                    remedy="plug it in again, then start again with --resume",
                ) from error
            if error.errno == errno.EACCES:
                raise DeviceError("this user may not open the rig", remedy=_UDEV) from error
            if error.errno == errno.EBUSY:
                raise DeviceError("another program has claimed the rig") from error
            raise DeviceError(f"USB: {error}") from error


def libusb() -> Any:
    """libusb as a wheel brings it, or the system's; None where there is neither."""
    import usb.backend.libusb1

    try:
        package = importlib.import_module("libusb_package")
    except ImportError:
        return usb.backend.libusb1.get_backend()
    return package.get_libusb1_backend()
