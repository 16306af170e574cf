"""A camera by libgphoto2 (python-gphoto2): a rig of a camera alone, without axes, lamp or monitor.

The camera has to stand at manual exposure and manual focus and to give RAW: what it would choose
for itself changes from frame to frame, and half of its errors come from choosing.
"""

from __future__ import annotations

import importlib
import math
import secrets
import time
from collections.abc import Callable, Mapping
from pathlib import PurePosixPath
from typing import Any, TypeVar, final

import numpy as np

from btfkit import counts
from btfkit.devices.base import (
    Camera,
    CameraLimits,
    Exposure,
    Found,
    FrameLostError,
    Light,
    Rig,
    Stage,
    UnpluggedError,
)
from btfkit.devices.deadline import Watchdog
from btfkit.errors import DeviceError, FormatError

T = TypeVar("T")

_MISSING = 'python-gphoto2 is missing: pip install "btfkit[gphoto2]"'
# A shutter time counts as the one that was asked for within a sixth of a stop.
_STOPS = 1 / 6
# libgphoto2's numbers for: no such device, claimed by another program, gone from the bus.
_UNKNOWN_PORT, _CLAIMED, _GONE = -5, -53, (-7, -52, -105)
# Names of settings over makes of cameras, and what they must not say.
_REFUSED = {
    ("focusmode", "autofocusdrive"): ("AF", "Automatic", "AI"),
    ("expprogram", "autoexposuremode", "autoexposuremodedial"): ("P", "Auto", "AV", "TV", "A", "S"),
}


def find() -> list[Found]:
    """The cameras that libgphoto2 sees, by their port; empty where there is none, or no library."""
    library = _library()
    if library is None:
        return []
    seen = _told(library, "looking for cameras", library.Camera.autodetect)
    return [Found(str(port), str(name)) for name, port in seen.items()]


def open_rig(serial: str | None = None) -> Rig:
    """The camera at a port, or the only one there is; not opened yet.

    Raises:
        DeviceError: none, several, or not that one.
    """
    library = _library()
    if library is None:
        raise DeviceError("no camera can be driven", remedy=_MISSING)
    cameras = find()
    listing = ", ".join(f"{each.serial} ({each.name})" for each in cameras)
    chosen = [each for each in cameras if serial in (None, each.serial)]
    if not cameras:
        raise DeviceError("no camera on the USB bus", remedy="plug it in and switch it on")
    if len(chosen) != 1:
        asked = "no port was named" if serial is None else f"{serial!r} is not there"
        raise DeviceError(f"cameras: {listing}; {asked}", remedy="--device gphoto2:PORT")
    return GphotoRig(chosen[0], library)


@final
class GphotoRig(Rig):
    """A camera, and nothing else that could be driven."""

    def __init__(self, found: Found, library: Any) -> None:
        super().__init__(found.serial, Watchdog(f"camera {found.serial}"))
        self._found, self._library = found, library
        self._device: Any = None
        self.description: Mapping[str, Any] = {"name": found.name, "axes": [], "carries": {}}

    def wait(self, seconds: float) -> None:
        time.sleep(seconds)

    def now(self) -> float:
        return time.monotonic()

    def _begin(self) -> None:
        device = self._library.Camera()
        ports = self._library.PortInfoList()
        self._ask("reading ports", ports.load)
        index = self._ask("finding the port", lambda: ports.lookup_path(self._found.serial))
        self._ask("choosing the port", lambda: device.set_port_info(ports[index]))
        self._ask("opening the camera", device.init)
        self._device = device
        try:
            settings = _Settings(device, self._ask)
            _refuse_choosing(settings)
            self.stage = _NoStage({}, self._watchdog)
            self.light = _NoLight((), self._watchdog)
            self.camera = GphotoCamera(settings, self._library, self._watchdog)
        except BaseException:
            self._end()
            raise

    def _end(self) -> None:
        device, self._device = self._device, None
        if device is not None:
            self._ask("closing the camera", device.exit)

    def _stop(self) -> None:
        """There is nothing that moves."""

    def _abort(self) -> None:
        """An exposure that has begun ends by itself; libgphoto2 cannot break it off."""

    def _emergency_stop(self) -> None:
        """There is neither lamp nor driver to switch off."""

    def _ask(self, what: str, call: Callable[[], T]) -> T:
        return _told(self._library, what, call)


@final
class GphotoCamera(Camera):
    """Exposures by name: the shutter times and speeds that the camera lists."""

    def __init__(self, settings: _Settings, library: Any, watchdog: Watchdog) -> None:
        self._settings, self._library = settings, library
        self._times = {t: c for c in settings.choices("shutterspeed") if (t := _seconds(c))}
        self._isos = {float(c): c for c in settings.choices("iso") if c.isdigit()}
        if not self._times or not self._isos:
            raise DeviceError(
                "the camera lists no shutter times or speeds",
                remedy="turn its dial to manual exposure (M)",
            )
        limits = CameraLimits(min(self._times), max(self._times), tuple(sorted(self._isos)))
        super().__init__({}, limits, watchdog)
        # No two sessions share a number, nor two exposures of one.
        self._boot, self._frame = secrets.randbits(31), 0

    def _expose(self, exposure_s: float, iso: float) -> Exposure:
        nearest = min(self._times, key=lambda t: abs(math.log2(t / exposure_s)))
        if abs(math.log2(nearest / exposure_s)) > _STOPS:
            raise DeviceError(
                f"exposure of {exposure_s:g} s; the nearest that the camera has is {nearest:g} s",
                remedy="ask for one of its own times",
            )
        self._settings.put("iso", self._isos[iso])
        self._settings.put("shutterspeed", self._times[nearest])
        began = time.monotonic()
        name, data = self._settings.captured(self._library)
        middle = began + nearest / 2
        self._frame += 1
        if PurePosixPath(name).suffix.lower() in (".jpg", ".jpeg"):
            raise DeviceError(
                f"the camera gave {name}: a developed picture, not counts",
                remedy="set its image quality to RAW alone",
            )
        try:
            image = counts.read(name, data)
        except FormatError as error:
            raise FrameLostError(f"{name} came damaged: {error}") from error
        # What has no monitor and no thermometer says so.
        return Exposure(
            np.asarray(image, np.uint16), (self._boot, self._frame), nearest, iso, {}, {},
            math.nan, math.nan, middle,
        )  # fmt: skip


@final
class _Settings:
    """A camera's settings by name, put and read back."""

    def __init__(self, device: Any, ask: Callable[[str, Callable[[], Any]], Any]) -> None:
        self._device, self._ask = device, ask
        self._names = set(ask("listing settings", device.list_config).keys())

    def has(self, name: str) -> bool:
        """Whether the camera has a setting."""
        return name in self._names

    def value(self, name: str) -> str:
        """What a setting says."""
        widget = self._ask(f"reading {name}", lambda: self._device.get_single_config(name))
        return str(widget.get_value())

    def choices(self, name: str) -> list[str]:
        """What a setting may say; empty where the camera has none of that name."""
        if not self.has(name):
            return []
        widget = self._ask(f"reading {name}", lambda: self._device.get_single_config(name))
        return [str(each) for each in widget.get_choices()]

    def put(self, name: str, value: str) -> None:
        """Set, and read back: some cameras take a value without a word and keep another."""
        if self.value(name) == value:
            return
        widget = self._ask(f"reading {name}", lambda: self._device.get_single_config(name))
        widget.set_value(value)
        self._ask(f"setting {name}", lambda: self._device.set_single_config(name, widget))
        kept = self.value(name)
        if kept != value:
            raise DeviceError(
                f"{name} was set to {value} and stands at {kept}",
                remedy="turn the camera's dial to manual exposure (M)",
            )

    def captured(self, library: Any) -> tuple[str, bytes]:
        """Name and bytes of one picture, which is taken off the camera."""
        at = self._ask("an exposure", lambda: self._device.capture(library.GP_CAPTURE_IMAGE))
        file = self._ask(
            "reading the frame",
            lambda: self._device.file_get(at.folder, at.name, library.GP_FILE_TYPE_NORMAL),
        )
        data = bytes(self._ask("reading the frame", file.get_data_and_size))
        # Cards fill up after some thousand frames.
        self._ask("deleting the frame", lambda: self._device.file_delete(at.folder, at.name))
        return str(at.name), data


@final
class _NoStage(Stage):
    """No axes: there is nothing to home or to move."""

    def _home(self) -> None:
        """There is no switch to find."""

    def _move(self, targets: Mapping[str, float]) -> None:
        """Never asked for an axis: every name is refused."""

    def _position(self) -> dict[str, float]:
        return {}


@final
class _NoLight(Light):
    """No lamp that could be switched, and no monitor."""

    def _switch(self, source: str | None) -> None:
        """None is lit and none can be."""

    def _reading(self) -> float:
        return math.nan


def _refuse_choosing(settings: _Settings) -> None:
    """Refuse a camera that chooses focus or exposure itself."""
    for names, refused in _REFUSED.items():
        for name in filter(settings.has, names):
            said = settings.value(name)
            if any(said == word or said.startswith((f"{word}-", f"{word} "))
                   for word in refused):  # fmt: skip
                raise DeviceError(
                    f"the camera's {name} is {said!r}: it would choose for itself",
                    remedy="set it to manual focus and manual exposure",
                )


def _seconds(choice: str) -> float | None:
    """A shutter time as cameras spell it: 1/30, 0.5, 2, 30s; None for bulb and the like."""
    text = choice.strip().rstrip('s"')
    try:
        above, _, below = text.partition("/")
        value = float(above) / float(below or 1)
    except (ValueError, ZeroDivisionError):
        return None
    return value if math.isfinite(value) and value > 0 else None


def _library() -> Any:
    try:
        return importlib.import_module("gphoto2")
    except ImportError:
        return None


def _told(library: Any, what: str, call: Callable[[], T]) -> T:
    """A call's answer, or its error as ours."""
    try:
        return call()
    except library.GPhoto2Error as error:
        code = getattr(error, "code", 0)
        if code in _GONE:
            raise UnpluggedError(f"{what}: the camera is gone ({error})") from error
        remedies = {
            _CLAIMED: "close other programs that read cameras (gvfs, a photo manager)",
            _UNKNOWN_PORT: "look at btfkit info for the camera's port",
        }
        raise DeviceError(f"{what}: {error}", remedy=remedies.get(code)) from error
