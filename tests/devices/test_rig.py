"""The rig through the bus: checks, deadlines, stops, one owner, replay."""

from __future__ import annotations

import errno
import math
import threading
import time

import pytest
import usb.core

from btfkit.devices import DRIVERS, driver, mock
from btfkit.devices import usb as usb_driver
from btfkit.devices.base import Found, PositionError, UnpluggedError
from btfkit.devices.deadline import Watchdog
from btfkit.devices.faults import Faults
from btfkit.devices.firmware import Firmware
from btfkit.devices.recording import Recorder, Replay
from btfkit.devices.twin.log import Twin
from btfkit.devices.twin.world import TwinClock, World
from btfkit.devices.virtual import VirtualBus
from btfkit.devices.wire import messages
from btfkit.devices.wire.link import RefusedError
from btfkit.devices.wire.messages import Command, State, Status
from btfkit.errors import DeviceError, FormatError

SMALL = Twin("print", 64, 48, seed=11)
IDS = (usb_driver.VENDOR, usb_driver.PRODUCT)


def a_rig(*specs: str, seed: int = 11, piece: int | None = None):
    return mock.open_rig(
        Twin("print", 64, 48, seed=seed).setup(), faults=Faults(specs), piece=piece
    )


def a_bus(peripheral, *, serial: str = "S1") -> VirtualBus:
    return VirtualBus(peripheral, ids=IDS, serial=serial)


@pytest.mark.parametrize("name", DRIVERS)
def test_every_driver_finds_and_opens_rigs(name):
    module = driver(name)
    assert callable(module.open_rig)
    assert all(isinstance(each, Found) for each in module.find())


def test_no_other_driver_is_known():
    with pytest.raises(ValueError, match="no driver 'serial'; expected one of usb, mock, gphoto2"):
        driver("serial")


def test_a_move_ends_where_it_was_sent_and_time_passes():
    with a_rig() as rig:
        rig.stage.home()
        before = rig.now()
        rig.stage.move_to(turntable=math.radians(90), light_arm=math.radians(30))
        found = rig.stage.position()
        # Eccentricity 5e-5, homing 3.5e-5 a deviation, resolution 1e-5.
        assert found["turntable"] == pytest.approx(math.radians(90), abs=2e-4)
        assert found["light_arm"] == pytest.approx(math.radians(30), abs=2e-4)
        # 95 degrees at 20 a second, and a second to get up to speed.
        assert rig.now() - before == pytest.approx(95 / 20 + 1, abs=0.1)


@pytest.mark.parametrize(
    ("targets", "message"),
    [
        ({"turntable": 1.0, "light_arm": 9.0}, "light_arm to 515.662°; its limits are -5° to 85°"),
        ({"turntable": 1.0, "shutter": 0.1}, "no axis 'shutter'; this stage has turntable"),
        ({"turntable": math.nan}, "turntable to nan°"),
    ],
)
def test_a_move_beyond_a_limit_is_refused_whole(targets, message):
    with a_rig() as rig:
        rig.stage.home()
        before = rig.stage.position()
        with pytest.raises(DeviceError, match=message):
            rig.stage.move_to(**targets)
        assert rig.stage.position() == before


def test_the_firmware_refuses_what_a_driver_should_not_have_sent():
    with a_rig() as rig:
        with pytest.raises(RefusedError, match="refused move: positions are not known"):
            rig.link.request(Command.MOVE, messages.move({0: 0.1}))
        rig.stage.home()
        with pytest.raises(RefusedError, match=r"axis 0 to 99 .*out_of_range"):
            rig.link.request(Command.MOVE, messages.move({0: 99.0}))
        with pytest.raises(RefusedError, match="malformed"):
            rig.link.request(Command.MOVE, b"abc")
        with pytest.raises(RefusedError, match="light 9"):
            rig.link.request(Command.LAMP, messages.lamp(9))


def test_positions_are_unknown_until_homed():
    with (
        a_rig() as rig,
        pytest.raises(PositionError, match=r"does not know its positions; home it"),
    ):
        rig.stage.position()


@pytest.mark.parametrize(("time_s", "iso"), [(1e-6, 100), (99.0, 100), (math.nan, 100), (0.1, 50)])
def test_an_exposure_that_the_camera_does_not_have_is_refused(time_s, iso):
    with a_rig() as rig, pytest.raises(DeviceError, match=r"the camera (takes|has)"):
        rig.camera.expose(time_s, iso=iso)


def test_there_is_no_other_light():
    with (
        a_rig() as rig,
        pytest.raises(DeviceError, match="no light 'sun'; this rig has lamp, panel"),
    ):
        rig.light.switch("sun")


def test_a_rig_has_one_owner_at_a_time():
    with a_rig() as rig:
        with pytest.raises(DeviceError, match=r"in use by process \d+; wait for it"):
            a_rig().open()
        with pytest.raises(DeviceError, match="is open already"):
            rig.open()
    with a_rig():
        pass


def test_leaving_a_rig_darkens_it_also_after_an_error():
    world = World(SMALL.setup())
    rig = usb_driver.open_rig(backend=a_bus(Firmware(world, Faults())), clock=world.clock)

    def fail():
        with rig:
            rig.light.switch("lamp")
            assert rig.light.reading() > 0.9
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert world.lamp.source == 0


def test_reads_that_end_anywhere_make_the_same_frame():
    frames = []
    for piece in (None, 7, 1000):
        with a_rig(piece=piece) as rig:
            rig.stage.home()
            rig.light.switch("panel")
            frames.append(rig.camera.expose(0.01).counts)
    assert (frames[0] == frames[1]).all()
    assert (frames[0] == frames[2]).all()


def status_of(rig) -> Status:
    return Status.parsed(rig.link.request(Command.STATUS))


def test_stop_slows_down_and_keeps_positions():
    with a_rig() as rig:
        rig.stage.home()
        rig.link.request(Command.MOVE, messages.move({0: 3.0}))
        rig.wait(2.0)
        speed = math.radians(20)
        before = status_of(rig)
        rig.stop()
        rig.wait(5.0)
        after = status_of(rig)
        assert State.HOMED in after.state
        assert State.MOVING not in after.state
        # v^2 / 2 a at full speed, and 1 ms of replies.
        way = after.counter[0] - before.counter[0]
        assert way == pytest.approx(speed**2 / (2 * math.radians(20)), abs=2e-3)
        rig.stage.move_to(turntable=1.0)


def test_an_emergency_stop_darkens_freezes_and_forgets_positions():
    with a_rig() as rig:
        rig.stage.home()
        rig.light.switch("lamp")
        rig.link.request(Command.MOVE, messages.move({0: 3.0}))
        rig.wait(2.0)
        rig.emergency_stop()
        frozen = status_of(rig)
        rig.wait(5.0)
        later = status_of(rig)
        assert State.STOPPED in later.state
        assert State.HOMED not in later.state
        assert later.counter == frozen.counter
        assert later.lamp == 0
        with pytest.raises(PositionError, match="home it"):
            rig.stage.move_to(turntable=1.0)
        with pytest.raises(RefusedError, match="the emergency stop holds until homing"):
            rig.light.switch("lamp")
        rig.stage.home()
        rig.stage.move_to(turntable=1.0)


def test_abort_drops_the_exposure():
    with a_rig() as rig:
        rig.stage.home()
        rig.link.request(Command.EXPOSE, messages.expose(2.0, 100.0))
        assert State.EXPOSING in status_of(rig).state
        rig.abort()
        assert State.EXPOSING not in status_of(rig).state
        rig.camera.expose(0.01)


def test_whoever_waits_for_a_motion_is_told_that_it_was_stopped():
    class StopsAtOnce:
        """A rig whose firmware is stopped by somebody else while it moves."""

        def __init__(self, firmware):
            self._firmware = firmware

        def receive(self, data):
            self._firmware.receive(data)
            if data[3] == Command.MOVE:
                self._firmware._stop(b"")

        def take(self, timeout_s):
            return self._firmware.take(timeout_s)

    world = World(SMALL.setup(blind=True))
    bus = a_bus(StopsAtOnce(Firmware(world, Faults())))
    with usb_driver.open_rig(backend=bus, clock=world.clock) as rig:
        rig.stage.home()
        with pytest.raises(DeviceError, match="the rig was stopped"):
            rig.stage.move_to(turntable=1.0)


def test_a_stop_from_another_thread_does_not_wait_for_the_motion():
    class Slow:
        """A rig of which a motion takes wall time."""

        def __init__(self, firmware):
            self._firmware = firmware
            self.moving = threading.Event()

        def receive(self, data):
            self._firmware.receive(data)
            if data[3] == Command.MOVE:
                self.moving.set()

        def take(self, timeout_s):
            if self.moving.is_set() and not self._firmware._out:
                time.sleep(0.01)
                self._firmware.world.clock.wait(1e-4)
                return b""
            return self._firmware.take(timeout_s)

    world = World(SMALL.setup(blind=True))
    slow = Slow(Firmware(world, Faults()))
    with usb_driver.open_rig(backend=a_bus(slow), clock=world.clock) as rig:
        rig.stage.home()
        stopper = threading.Thread(target=lambda: slow.moving.wait(5) and rig.stop())
        stopper.start()
        with pytest.raises(DeviceError, match="the rig was stopped"):
            rig.stage.move_to(turntable=3.0)
        stopper.join()
        slow.moving.clear()
        assert State.HOMED in status_of(rig).state


def test_an_unplugged_rig_is_said_to_be_gone_and_is_let_go():
    def use():
        with a_rig("unplug:1@9") as rig:
            for _ in range(20):
                rig.light.reading()

    with pytest.raises(UnpluggedError, match=r"gone from the bus .*--resume"):
        use()
    with a_rig():
        pass


def test_a_halted_endpoint_is_cleared_and_the_request_repeated():
    with a_rig("stall:1@5") as rig:
        for _ in range(10):
            rig.light.reading()
        assert rig.link.repeats == 1


def test_the_bus_behaves_as_libusb_does():
    bus = a_bus(Firmware(World(SMALL.setup(blind=True)), Faults()), serial="ABC")
    device = usb.core.find(idVendor=IDS[0], idProduct=IDS[1], backend=bus)
    assert (device.serial_number, device.product, device.manufacturer) == (
        "ABC", "btfkit twin", "btfkit"
    )  # fmt: skip
    device.set_configuration()
    endpoints = [e.bEndpointAddress for e in device.get_active_configuration()[(0, 0)]]
    assert endpoints == [0x01, 0x81]
    with pytest.raises(usb.core.USBTimeoutError) as timed_out:
        device.read(0x81, 512, 5)
    assert timed_out.value.errno == errno.ETIMEDOUT
    with pytest.raises(usb.core.USBError) as busy:
        bus.claim_interface("other", 0)
    assert busy.value.errno == errno.EBUSY
    bus._halted.add(0x81)
    with pytest.raises(usb.core.USBError) as halted:
        device.read(0x81, 512, 5)
    assert halted.value.errno == errno.EPIPE
    device.clear_halt(0x81)
    bus.plugged = False
    with pytest.raises(usb.core.USBError) as gone:
        device.write(0x01, b"x")
    assert gone.value.errno == errno.ENODEV


def test_a_rig_is_found_by_its_serial_number():
    bus = a_bus(Firmware(World(SMALL.setup(blind=True)), Faults()), serial="ABC")
    assert [each.serial for each in usb_driver.find(bus)] == ["ABC"]
    with pytest.raises(DeviceError, match="rigs on the bus: ABC; 'XYZ' is not there"):
        usb_driver.open_rig("XYZ", backend=bus)
    bus.plugged = False
    with pytest.raises(DeviceError, match="no rig on the USB bus; plug it in"):
        usb_driver.open_rig("ABC", backend=bus)


def talk(rig) -> list:
    """A short session."""
    with rig:
        rig.stage.home()
        rig.light.switch("panel")
        rig.stage.move_to(turntable=0.2)
        frame = rig.camera.expose(0.01)
        return [frame.axes, frame.serial, frame.lamp, frame.counts.tolist()]


def test_recorded_traffic_replays_byte_for_byte(tmp_path):
    world = World(SMALL.setup())
    recorder = Recorder(Firmware(world, Faults()))
    first = talk(usb_driver.open_rig(backend=a_bus(recorder), clock=world.clock))
    recorder.save(tmp_path / "session.txt")
    replay = Replay.of(tmp_path / "session.txt")
    again = talk(usb_driver.open_rig(backend=a_bus(replay), clock=TwinClock()))
    assert again == first
    assert replay.over


def test_another_byte_than_the_recorded_one_is_refused():
    world = World(SMALL.setup(blind=True))
    recorder = Recorder(Firmware(world, Faults()))
    with usb_driver.open_rig(backend=a_bus(recorder), clock=world.clock) as rig:
        rig.stage.home()
        rig.stage.move_to(turntable=0.2)
    rig = usb_driver.open_rig(backend=a_bus(Replay(recorder.lines)), clock=TwinClock())

    def differ():
        with rig:
            rig.stage.home()
            rig.stage.move_to(turntable=0.3)

    with pytest.raises(DeviceError, match=r"line .* of the recording: .* was sent; expected >"):
        differ()
    with pytest.raises(FormatError, match="line 2 is '> xy'"):
        Replay(["> 00", "> xy"])
    with pytest.raises(DeviceError, match="the recording is over; a read came after it"):
        Replay([]).take(1.0)


def test_a_deadline_holds_where_the_call_beneath_does_not_return():
    watchdog, hangs = Watchdog("camera"), threading.Event()
    began = time.monotonic()
    with pytest.raises(DeviceError, match=r"camera: a read has not returned within 0\.05 s"):
        watchdog.run("a read", hangs.wait, deadline_s=0.05)
    assert time.monotonic() - began < 5
    with pytest.raises(DeviceError, match="a read did not return; the device is out of reach"):
        watchdog.run("another", lambda: 1, deadline_s=1)
    hangs.set()


def test_a_watchdog_hands_on_results_and_errors():
    watchdog = Watchdog("x")
    assert (
        watchdog.run("a sum", lambda: watchdog.run("inner", lambda: 2, deadline_s=1), deadline_s=5)
        == 2
    )
    with pytest.raises(KeyError):
        watchdog.run("a look-up", lambda: {}["a"], deadline_s=5)
    watchdog.close()
