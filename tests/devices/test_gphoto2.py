"""The driver of cameras by libgphoto2, over a fake of the library."""

import math
import sys

import numpy as np
import pytest
from cameras import Device, Library

from btfkit.devices import gphoto2
from btfkit.devices.base import FrameLostError, UnpluggedError
from btfkit.errors import DeviceError


@pytest.fixture
def device(monkeypatch):
    camera = Device()
    monkeypatch.setitem(sys.modules, "gphoto2", Library(camera))
    return camera


def test_a_camera_is_found_opened_exposed_and_let_go(device):
    assert [(each.serial, each.name) for each in gphoto2.find()] == [
        ("usb:001,005", "Camera usb:001,005")
    ]
    with gphoto2.open_rig() as rig:
        assert device.opened == 1
        assert rig.camera.limits.isos == (100.0, 400.0)
        assert (rig.camera.limits.shortest_s, rig.camera.limits.longest_s) == (1 / 500, 2)
        first = rig.camera.expose(0.5)
        # Nominal times are as good as their names: a sixth of a stop.
        second = rig.camera.expose(1 / 32, iso=400)
        np.testing.assert_array_equal(first.counts, np.full((6, 8), 5200))
        np.testing.assert_array_equal(second.counts, np.full((6, 8), 200 + 40000 // 30))
        assert (second.exposure_s, second.iso) == (1 / 30, 400)
        assert first.serial[0] == second.serial[0]
        assert second.serial[1] == first.serial[1] + 1
        # What has no monitor, thermometer or axis says so.
        assert math.isnan(first.lamp)
        assert math.isnan(first.temperature_c)
        assert rig.stage.position() == {}
        rig.stage.home()
    assert (device.opened, device.deleted) == (0, 2)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda rig: rig.camera.expose(0.1), "exposure of 0.1 s; the nearest that the camera has is 0.0333"),
        (lambda rig: rig.camera.expose(30), "exposure of 30 s; the camera takes 0.002 to 2"),
        (lambda rig: rig.camera.expose(0.5, iso=200), "ISO 200; the camera has 100, 400"),
        (lambda rig: rig.stage.move_to(turntable=1), "no axis 'turntable'"),
        (lambda rig: rig.light.switch("lamp"), "no light 'lamp'"),
    ],
)  # fmt: skip
def test_what_the_camera_has_not_is_refused_and_nothing_changes(device, call, message):
    with gphoto2.open_rig() as rig:
        before = {name: value for name, (value, _) in device.settings.items()}
        with pytest.raises(DeviceError, match=message):
            call(rig)
        assert before == {name: value for name, (value, _) in device.settings.items()}
    assert device.deleted == 0


@pytest.mark.parametrize(
    ("name", "value"),
    [("focusmode", "AF-S"), ("focusmode", "Automatic"), ("expprogram", "P"), ("expprogram", "AV")],
)
def test_a_camera_that_chooses_for_itself_is_refused_and_let_go(device, name, value):
    device.settings[name][0] = value
    with pytest.raises(DeviceError, match=f"{name} is '{value}'.*manual focus"):
        gphoto2.open_rig().open()
    assert device.opened == 0


def test_a_setting_that_does_not_stay_is_named(device):
    device.stuck.add("shutterspeed")
    with (
        gphoto2.open_rig() as rig,
        pytest.raises(DeviceError, match=r"set to 0.5 and stands at 1/30"),
    ):
        rig.camera.expose(0.5)


@pytest.mark.parametrize(
    ("fault", "code", "kind", "message"),
    [
        ("capture", -7, UnpluggedError, "an exposure: the camera is gone"),
        ("file_get", -52, UnpluggedError, "reading the frame: the camera is gone"),
        ("capture", -1, DeviceError, r"an exposure: \[-1\] fault"),
        ("iso", -2, DeviceError, r"setting iso: \[-2\] fault"),
    ],
)
def test_errors_of_the_library_come_as_ours(device, fault, code, kind, message):
    with gphoto2.open_rig() as rig:
        device.faults[fault] = code
        with pytest.raises(kind, match=message):
            rig.camera.expose(0.5, iso=400)
    assert device.opened == 0


def test_a_camera_that_another_program_holds_is_told_with_a_way_out(device):
    device.faults["init"] = -53
    with pytest.raises(DeviceError, match="close other programs that read cameras"):
        gphoto2.open_rig().open()


def test_developed_pictures_and_damaged_files_are_no_frames(device, monkeypatch):
    device.suffix = ".JPG"
    with (
        gphoto2.open_rig() as rig,
        pytest.raises(DeviceError, match=r"DSC_1.JPG: a developed pict"),
    ):
        rig.camera.expose(0.5)
    device.suffix = ".png"
    monkeypatch.setattr("cameras.counts.encode_png", lambda image: b"\x89PNG cut")
    with gphoto2.open_rig() as rig, pytest.raises(FrameLostError, match=r"DSC_1.png came damaged"):
        rig.camera.expose(0.5)


def test_cameras_are_told_apart_by_their_port(monkeypatch):
    monkeypatch.setitem(sys.modules, "gphoto2", Library(ports=("usb:001,005", "usb:001,007")))
    with pytest.raises(DeviceError, match=r"cameras: usb:001,005 .*no port was named"):
        gphoto2.open_rig()
    with pytest.raises(DeviceError, match="'usb:9' is not there"):
        gphoto2.open_rig("usb:9")
    monkeypatch.setitem(sys.modules, "gphoto2", Library(ports=()))
    with pytest.raises(DeviceError, match="no camera on the USB bus"):
        gphoto2.open_rig()


def test_without_the_library_there_is_no_camera_and_a_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "gphoto2", None)
    assert gphoto2.find() == []
    with pytest.raises(DeviceError, match=r"pip install \"btfkit\[gphoto2\]\""):
        gphoto2.open_rig()


def test_a_plan_of_directions_needs_axes_and_says_so(device, tmp_path):
    from btfkit.devices.capture.plan import from_document
    from btfkit.devices.capture.run import measure

    rig = gphoto2.open_rig()
    with pytest.raises(DeviceError, match=r"the rig carries \{\}; directions can be reached with"):
        measure(
            rig, from_document("p", {"views": 1, "lights": 2}), tmp_path / "run", synthetic=False
        )
    assert device.opened == 0
