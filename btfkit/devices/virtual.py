"""A USB bus in this process: what libusb would show of a rig that is a Python object.

Descriptors, claims, time-outs, halted endpoints, an unplugged device and reads that end in the
middle of a packet take the driver through the same code as real hardware does.
"""

from __future__ import annotations

import array
import errno
from types import SimpleNamespace
from typing import Any, Protocol, final

import usb.backend
import usb.core

from btfkit.devices.faults import Faults

_PACKET = 512
# Names of string descriptors.
_MANUFACTURER, _PRODUCT, _SERIAL = 1, 2, 3


class Peripheral(Protocol):
    """What sits behind the endpoints."""

    def receive(self, data: bytes) -> None:
        """Bytes from the computer."""

    def take(self, timeout_s: float) -> bytes:
        """Bytes for the computer; b"" after the time-out."""


@final
class VirtualBus(usb.backend.IBackend):  # type: ignore[misc]
    """A pyusb backend with one device.

    Args:
        peripheral: what sits behind it.
        ids: vendor and product number. serial, product: its strings.
        faults: "stall" and "unplug" are this side's; with `piece` reads end after so many bytes.

    Attributes:
        plugged: False once the device has left the bus.
    """

    def __init__(
        self,
        peripheral: Peripheral,
        *,
        ids: tuple[int, int],
        serial: str,
        product: str = "btfkit twin",
        faults: Faults | None = None,
        piece: int | None = None,
    ) -> None:
        self._peripheral = peripheral
        self._ids = ids
        self._strings = {_MANUFACTURER: "btfkit", _PRODUCT: product, _SERIAL: serial}
        self._faults = faults or Faults()
        self._piece = piece
        self._held = b""
        self._halted: set[int] = set()
        self._claimed = False
        self._configured = 0
        self.plugged = True

    def enumerate_devices(self) -> Any:
        return iter(["twin"] if self.plugged else [])

    def get_parent(self, dev: Any) -> None:
        return None

    def get_device_descriptor(self, dev: Any) -> Any:
        vendor, product = self._ids
        return SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=0x200, bDeviceClass=0, bDeviceSubClass=0,
            bDeviceProtocol=0, bMaxPacketSize0=64, idVendor=vendor, idProduct=product,
            bcdDevice=0x100, iManufacturer=_MANUFACTURER, iProduct=_PRODUCT,
            iSerialNumber=_SERIAL, bNumConfigurations=1, bus=1, address=1, port_number=1,
            port_numbers=(1,), speed=3,
        )  # fmt: skip

    def get_configuration_descriptor(self, dev: Any, config: int) -> Any:
        self._only(config)
        return SimpleNamespace(
            bLength=9, bDescriptorType=2, wTotalLength=32, bNumInterfaces=1,
            bConfigurationValue=1, iConfiguration=0, bmAttributes=0x80, bMaxPower=250,
            extra_descriptors=[],
        )  # fmt: skip

    def get_interface_descriptor(self, dev: Any, intf: int, alt: int, config: int) -> Any:
        self._only(intf, alt, config)
        return SimpleNamespace(
            bLength=9, bDescriptorType=4, bInterfaceNumber=0, bAlternateSetting=0,
            bNumEndpoints=2, bInterfaceClass=0xFF, bInterfaceSubClass=0, bInterfaceProtocol=1,
            iInterface=0, extra_descriptors=[],
        )  # fmt: skip

    def get_endpoint_descriptor(self, dev: Any, ep: int, intf: int, alt: int, config: int) -> Any:
        self._only(intf, alt, config)
        if ep not in (0, 1):
            raise IndexError(ep)
        return SimpleNamespace(
            bLength=7, bDescriptorType=5, bEndpointAddress=(0x01, 0x81)[ep], bmAttributes=2,
            wMaxPacketSize=_PACKET, bInterval=0, bRefresh=0, bSynchAddress=0,
            extra_descriptors=[],
        )  # fmt: skip

    def open_device(self, dev: Any) -> str:
        self._there()
        return "handle"

    def close_device(self, dev_handle: Any) -> None:
        self._claimed = False

    def get_configuration(self, dev_handle: Any) -> int:
        return self._configured

    def set_configuration(self, dev_handle: Any, config_value: int) -> None:
        self._there()
        self._configured = config_value

    def set_interface_altsetting(self, dev_handle: Any, intf: int, altsetting: int) -> None:
        self._there()

    def claim_interface(self, dev_handle: Any, intf: int) -> None:
        self._there()
        if self._claimed:
            raise usb.core.USBError("Resource busy", -6, errno.EBUSY)
        self._claimed = True

    def release_interface(self, dev_handle: Any, intf: int) -> None:
        self._claimed = False

    def bulk_write(self, dev_handle: Any, ep: int, intf: int, data: Any, timeout: int) -> int:
        self._ready(ep)
        if self._faults.strikes("unplug"):
            self.plugged = False
            self._there()
        self._peripheral.receive(bytes(data))
        return len(data)

    def bulk_read(self, dev_handle: Any, ep: int, intf: int, buff: Any, timeout: int) -> int:
        self._ready(ep)
        if self._faults.strikes("stall"):
            self._halted.add(ep)
            self._ready(ep)
        if not self._held:
            self._held = self._peripheral.take(timeout / 1000)
        if not self._held:
            raise usb.core.USBTimeoutError("Operation timed out", -7, errno.ETIMEDOUT)
        count = min(len(self._held), len(buff) * buff.itemsize, self._piece or len(self._held))
        buff[:count] = array.array("B", self._held[:count])
        self._held = self._held[count:]
        return count

    def ctrl_transfer(
        self,
        dev_handle: Any,
        bmRequestType: int,  # noqa: N803  pyusb's names
        bRequest: int,  # noqa: N803
        wValue: int,  # noqa: N803
        wIndex: int,  # noqa: N803
        data: Any,
        timeout: int,
    ) -> int:
        self._there()
        kind, index = wValue >> 8, wValue & 0xFF
        if (bmRequestType, bRequest, kind) != (0x80, 6, 3):
            raise usb.core.USBError("Pipe error", -9, errno.EPIPE)
        # Language 0x0409, or a string in UTF-16.
        body = b"\x09\x04" if index == 0 else self._strings[index].encode("utf-16-le")
        found = (bytes([len(body) + 2, 3]) + body)[: len(data) * data.itemsize]
        data[: len(found)] = array.array("B", found)
        return len(found)

    def clear_halt(self, dev_handle: Any, ep: int) -> None:
        self._there()
        self._halted.discard(ep)

    def reset_device(self, dev_handle: Any) -> None:
        self._there()
        self._halted.clear()

    def is_kernel_driver_active(self, dev_handle: Any, intf: int) -> bool:
        return False

    def _ready(self, ep: int) -> None:
        self._there()
        if ep in self._halted:
            raise usb.core.USBError("Pipe error", -9, errno.EPIPE)

    def _there(self) -> None:
        if not self.plugged:
            raise usb.core.USBError(
                "No such device (it may have been disconnected)", -4, errno.ENODEV
            )

    def _only(self, *numbers: int) -> None:
        if any(numbers):
            raise IndexError(numbers)
